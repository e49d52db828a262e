"""Simulator states of third-party environments, rebuilt from observations by a function of their package."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable, Mapping
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from zest_rl.data.observations import entries, is_numbers
from zest_rl.errors import ZestError

ENTRY_POINTS = "zest_rl.state_renderers"
"""Group of the entry points: environment id → function from an episode's numbers, (T+1, …) by their paths below
``observations`` and ``infos``, to qpos (T+1, nq). Its module registers the environment with Gymnasium."""


def registered(env_id: str) -> importlib.metadata.EntryPoint | None:
    """Return the entry point of the function for an environment; an installed package is trusted."""
    return next((e for e in importlib.metadata.entry_points(group=ENTRY_POINTS) if e.name == env_id), None)


def load(entry: importlib.metadata.EntryPoint) -> Callable[[Mapping[str, NDArray[Any]]], NDArray[Any]]:
    """Return the function.

    Raises:
        ZestError: its module cannot be imported, or has no such function.
    """
    try:
        function: Callable[[Mapping[str, NDArray[Any]]], NDArray[Any]] = entry.load()
    except Exception as error:  # anything that third-party code raises
        raise ZestError(
            f"{entry.value}, which is registered for {entry.name}, cannot be loaded ({type(error).__name__}: {error})"
        ) from error
    return function


def rebuild(entry: importlib.metadata.EntryPoint, episode: h5py.Group, n_rows: int) -> NDArray[np.float64]:
    """Return qpos (T+1, nq) of an episode in a Minari dataset.

    Raises:
        ZestError: the function fails, or its result is not finite or has another shape.
    """
    build = load(entry)
    parts = [entries(episode[part], part) for part in ("observations", "infos") if part in episode]
    numbers = {path: node[()] for part in parts for path, node in part.items() if is_numbers(node)}
    try:
        qpos = np.asarray(build(numbers), np.float64)
        if qpos.ndim != 2 or len(qpos) != n_rows or not np.isfinite(qpos).all():
            raise ValueError(f"qpos must be finite and of shape ({n_rows}, nq), got {qpos.shape}")
    except Exception as error:  # anything that third-party code raises
        raise ZestError(
            f"{entry.value}, which is registered for {entry.name}, failed ({type(error).__name__}: {error})"
        ) from error
    return qpos
