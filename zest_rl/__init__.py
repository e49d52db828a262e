"""A picture or a sentence as the reward function for offline robot learning.

goal spec + frames → embeddings → scores → relabeled dataset → trainer → policy → evaluation → report.

One stage is one room (a folder) and leaves one artifact on disk. The method is ZeST (Cui et al., "Can Foundation
Models Perform Zero-Shot Task Specification For Robot Manipulation?", L4DC 2022). Importing this package imports nothing
heavy; import the module of the stage you need.
"""

import importlib
import sys
from types import ModuleType
from typing import Any

__version__ = "0.1.0"


class _Kitchen(ModuleType):
    """``zest_rl.envs``, which the env_spec of every kitchen dataset names; it is `zest_rl.kitchen.env`."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(importlib.import_module("zest_rl.kitchen.env"), name)


sys.modules["zest_rl.envs"] = _Kitchen("zest_rl.envs")
