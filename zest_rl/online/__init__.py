"""Training in the environment, on a reward: a dataset, its environment and a reward → a run folder."""
