"""A picture or a sentence as the reward function for offline robot learning.

goal spec + frames → embeddings → scores → relabeled dataset → trainer → policy → evaluation → report.

One stage is one room (a folder) and leaves one artifact on disk. The method is ZeST (Cui et al., "Can Foundation
Models Perform Zero-Shot Task Specification For Robot Manipulation?", L4DC 2022). Importing this package imports nothing
heavy; import the module of the stage you need.
"""

__version__ = "0.1.0"
__path__ = [*__path__, f"{__path__[0]}/kitchen/aliases"]  # modules that datasets on disk name by an earlier name
