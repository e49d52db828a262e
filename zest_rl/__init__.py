"""A picture or a sentence as the reward function for offline robot learning.

goal spec + frames → embeddings → scores → relabeled dataset → trainer → policy → evaluation → report.

One stage is one room (a folder) and leaves one artifact on disk. The method is ZeST (Cui et al., "Can Foundation
Models Perform Zero-Shot Task Specification For Robot Manipulation?", L4DC 2022). The names in ``__all__`` are loaded
when they are first used: importing this package imports nothing heavy.
"""

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from zest_rl.analysis.curves import Curve, score
    from zest_rl.api import (
        collect,
        curate,
        evaluate,
        explore,
        export,
        inspect,
        load_policy,
        open_dataset,
        push,
        relabel,
        report,
        train,
        with_rewards,
    )
    from zest_rl.embedders import load_embedder

__all__ = [
    "Curve", "collect", "curate", "evaluate", "explore", "export", "inspect", "load_embedder", "load_policy",
    "open_dataset", "push", "relabel", "report", "score", "train", "with_rewards",
]  # fmt: skip
__version__ = "0.1.0"
__path__ = [*__path__, f"{__path__[0]}/kitchen/aliases"]  # modules that datasets on disk name by an earlier name

_MODULES = {"Curve": "analysis.curves", "score": "analysis.curves", "load_embedder": "embedders"}
"""Modules of the public names that are not of `zest_rl.api`."""
_ROOMS_AND_VERBS = ("explore", "export", "report")


def _after_mujoco() -> None:
    """Load Triton safely where a script loaded MuJoCo before; see `zest_rl.runtime.load_order`."""
    if "mujoco" in sys.modules:
        importlib.import_module("zest_rl.runtime.load_order")


class _CallableRoom(ModuleType):
    """A room with the name of a verb: the folder `zest_rl.export`, and the function."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        api = importlib.import_module("zest_rl.api")
        return getattr(api, self.__name__.rpartition(".")[2])(*args, **kwargs)


class _Package(ModuleType):
    """This package; the import system sets a room as its attribute once that is loaded."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name in _ROOMS_AND_VERBS:
            value.__class__ = _CallableRoom
        super().__setattr__(name, value)


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    _after_mujoco()
    if name in _ROOMS_AND_VERBS:
        return importlib.import_module(f"zest_rl.{name}")
    return getattr(importlib.import_module(f"zest_rl.{_MODULES.get(name, 'api')}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


sys.modules[__name__].__class__ = _Package
_after_mujoco()
