"""How well a reward ranks parts of trajectories: the paper's test of a learned reward. Pure functions on arrays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from zest_rl.types import FloatArray

MARGIN = 0.01
"""True sums of two parts that differ by at most this, per step, are a tie, which no reward can rank."""


def part_accuracy(
    predicted: Sequence[FloatArray], true: Sequence[FloatArray], length: int = 50, n_parts: int = 10, seed: int = 0
) -> float:
    """Return the share of pairs of parts whose sums of predicted rewards are in the order of the true ones.

    All parts of all trajectories are compared with one another, ties of the true sums left out; equal predictions count
    as wrong. NaN where all are ties.

    Args:
        predicted: (T,) rewards of each trajectory.
        true: (T,) ground truth of each.
        length: steps of a part, in a row; at most those of the shortest trajectory.
        n_parts: of each trajectory, drawn at random.
        seed: of the draws.
    """
    length, rng = min(length, *map(len, true)), np.random.default_rng(seed)
    starts = [rng.integers(len(rewards) - length + 1, size=n_parts) for rewards in true]
    by_prediction, by_truth = (_sums(rewards, starts, length) for rewards in (predicted, true))
    first, second = np.triu_indices(len(by_truth), 1)
    difference = by_truth[first] - by_truth[second]
    told = np.abs(difference) > MARGIN * length
    right = (by_prediction[first] - by_prediction[second]) * difference > 0
    return float(right[told].mean()) if told.any() else float("nan")


def _sums(rewards: Sequence[FloatArray], starts: Sequence[NDArray[np.int64]], length: int) -> NDArray[np.float64]:
    return np.array([
        each[start : start + length].sum(dtype=np.float64)
        for each, of_each in zip(rewards, starts, strict=True)
        for start in of_each
    ])  # fmt: skip
