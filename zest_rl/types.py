"""The data that passes between stages: frozen, with shapes per field, checked where it is built.

Alignment, drawn once; everything else links to here. An episode of T actions has T + 1 observations and frames::

    frame     x_0      x_1      x_2    …    x_T
    obs       o_0      o_1      o_2    …    o_T
    action        a_0      a_1      …   a_{T-1}
    reward        r_0      r_1      …   r_{T-1}        r_t = φ(x_{t+1}), the score of the frame *after* a_t
    delta                ψ(x_t) − ψ(x_0), always against x_0 of the same episode

So ``rewards = scores[1:]``: the score of x_0 (which is 0 for delta features) belongs to no action.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zest_rl.errors import BadInput

Frame = NDArray[np.uint8]  # (H, W, 3) RGB
FloatArray = NDArray[np.float32]


def _check_shape(what: str, array: NDArray[Any], shape: tuple[int | None, ...], dtype: type) -> None:
    fits = array.ndim == len(shape) and all(
        want is None or want == got for want, got in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype != dtype:
        wanted = "(" + ", ".join("?" if n is None else str(n) for n in shape) + ")"
        raise BadInput(
            f"{what} must have shape {wanted} and dtype {np.dtype(dtype).name}, "
            f"got shape {array.shape} and dtype {array.dtype}"
        )


def check_finite(what: str, array: NDArray[Any]) -> NDArray[Any]:
    """Return an array (n, …) that holds numbers alone.

    Raises:
        BadInput: NaN or infinity, of which the first row is named.
    """
    if not np.isfinite(array).all():
        bad = np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(axis=1))
        raise BadInput(
            f"{what} must be finite, but {len(bad)} of {len(array)} rows hold NaN or infinity "
            f"(the first at index {bad[0]}); repair or drop the episode before using the dataset"
        )
    return array


@dataclass(frozen=True)
class Episode:
    """What a trainer may see of one episode. There is deliberately no ground truth in it."""

    obs: FloatArray
    """(T+1, obs_dim) float32."""
    actions: FloatArray
    """(T, act_dim) float32, in [-1, 1] for the kitchen."""
    rewards: FloatArray
    """(T,) float32; ZeST scores in a relabeled dataset."""
    terminated: bool
    """The last step ended the task (True) or only met the horizon (False)."""

    def __post_init__(self) -> None:
        n_steps = len(self.actions)
        if n_steps == 0:
            raise BadInput("an episode must have at least 1 step, got 0; drop empty episodes from the dataset")
        _check_shape("obs", self.obs, (n_steps + 1, None), np.float32)
        _check_shape("actions", self.actions, (n_steps, None), np.float32)
        _check_shape("rewards", self.rewards, (n_steps,), np.float32)
        for what, array in (("obs", self.obs), ("actions", self.actions), ("rewards", self.rewards)):
            check_finite(what, array)

    def __len__(self) -> int:
        return len(self.actions)


@dataclass(frozen=True)
class GroundTruth:
    """What judges one episode, kept apart from `Episode`: for evaluation and reports only."""

    rewards: FloatArray
    """(T,) float32: in the kitchen, clipped progress of the task's joint in [0, 1]; elsewhere, the dataset's own."""
    success: bool | None
    """The goal was reached at some step; None where nothing tells it."""

    @property
    def episode_return(self) -> float:
        """Sum over the episode."""
        return float(self.rewards.sum(dtype=np.float64))


@dataclass(frozen=True)
class EpisodeResult:
    """One evaluated episode."""

    seed: int
    """Seed of the environment's reset; equal seeds give equal starts to every policy."""
    gt_return: float
    """Sum of the ground-truth rewards."""
    success: bool | None
    """None where the environment does not tell it."""
    n_steps: int
    zest_return: float | None = None
    """Sum of the online ZeST scores; None when the policy was not scored online."""
