"""Cameras around an object, and the grid on which states with equal frames are one.

States are rounded to a grid and the *rounded* state is rendered, so a frame is a function of its key, whichever episode
reaches it first.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from zest_rl.errors import BadInput
from zest_rl.simulation.rendering import Camera

MAX_VIEWS = 1000
"""Cameras of a ring: about three to a degree; each state's frames of all of them are in memory at once."""


def ring(
    lookat: tuple[float, float, float],
    n_views: int,
    *,
    azimuths: tuple[float, float],
    distances: Sequence[float],
    elevations: Sequence[float],
) -> tuple[Camera, ...]:
    """Return cameras around a point, chosen without any ground truth.

    Args:
        lookat: the point, in metres.
        n_views: how many.
        azimuths: the first and the last, in degrees, with the others evenly between; a single view is in the middle.
        distances: in metres; the cameras cycle through them.
        elevations: in degrees, negative looks down; the cameras cycle through them.

    Raises:
        BadInput: `n_views` is not in 1 … `MAX_VIEWS`.
    """
    if not 1 <= n_views <= MAX_VIEWS:
        raise BadInput(f"the number of views must be 1 to {MAX_VIEWS}, got {n_views}")
    spread = np.linspace(*azimuths, n_views) if n_views > 1 else [sum(azimuths) / 2]
    return tuple(
        Camera(lookat, distances[i % len(distances)], float(azimuth), elevations[i % len(elevations)])
        for i, azimuth in enumerate(spread)
    )


def on_grid(qpos: NDArray[np.float64], visible: slice | NDArray[np.bool_], tolerance: float) -> NDArray[np.float64]:
    """Round states to a grid and zero what no frame depends on: (N, nq) → (N, nq); equal rows have equal frames.

    Args:
        qpos: (N, nq) states.
        visible: the entries that a frame depends on.
        tolerance: of the grid, in rad or m; 0: no rounding.
    """
    states = np.zeros_like(qpos, dtype=np.float64)
    states[:, visible] = qpos[:, visible]
    if tolerance > 0:
        states = np.round(states / tolerance) * tolerance
    return states + 0.0  # −0.0 and 0.0 are one state


def each_once(states: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distinct rows in the order in which they first appear: (N, nq) → (U, nq)."""
    first, _ = distinct(states)
    return np.asarray(states[np.sort(first)])


def distinct(states: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return where each distinct row first appears, in the order of ``np.unique``, and which of these each row is.

    Columns that do not vary, most of them in an episode, do not take part in sorting.
    """
    varies = np.ptp(states, axis=0) > 0
    varies[0] = True
    _, first, inverse = np.unique(states[:, varies], axis=0, return_index=True, return_inverse=True)
    return first, np.asarray(inverse).reshape(-1)


def state_keys(states: NDArray[np.float64]) -> list[bytes]:
    """Return one key per row of states on a grid."""
    return [row.tobytes() for row in np.ascontiguousarray(states)]
