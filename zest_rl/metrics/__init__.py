"""Pure functions: statistics of returns, quality of a reward, quality of a selection of frames."""
