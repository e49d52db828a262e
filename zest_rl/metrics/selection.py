"""Goal and action selection: how well a score finds the frames of a dataset that reach a goal. Pure functions.

Cui et al. 2022, §4. Candidates are frames of a dataset; I(x) says which of them satisfy the goal by ground truth, which
judges a score here and never makes one; μ is their number.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from zest_rl.errors import BadInput
from zest_rl.metrics.statistics import Estimate, Values, over_episodes

Measure = Callable[[Values, NDArray[np.bool_]], float]
"""Scores (M,) and which candidates satisfy the goal (M,) → a number."""
TOP_N = 25
"""N of the paper's tables."""


def _check(scores: Values, satisfies: NDArray[np.bool_]) -> tuple[Values, NDArray[np.bool_]]:
    scores, satisfies = np.asarray(scores, dtype=np.float64), np.asarray(satisfies, dtype=bool)
    if scores.ndim != 1 or scores.shape != satisfies.shape:
        raise BadInput(
            f"scores and satisfied goals must be equally long lists, got shapes {scores.shape} and {satisfies.shape}"
        )
    if not satisfies.any():
        raise BadInput("no candidate satisfies the goal, so nothing can be found; give a dataset with successes")
    return scores, satisfies


def top_n_success(scores: Values, satisfies: NDArray[np.bool_], n: int = TOP_N) -> float:
    """Share of the N highest-scoring candidates that satisfy the goal, in [0, 1] (§4.1). Chance is `goal_frame_ratio`.

    Candidates with equal scores share the places that they compete for, so that their order does not matter.

    Args:
        scores: (M,) of the candidates.
        satisfies: (M,) bool, which of them satisfy the goal.
        n: how many are picked; at most μ, else even a perfect score could not reach 1.

    Raises:
        BadInput: lengths differ, no candidate satisfies the goal, or `n` is not in [1, μ].
    """
    scores, satisfies = _check(scores, satisfies)
    if not 1 <= n <= satisfies.sum():
        raise BadInput(
            f"N must be between 1 and the number of candidates that satisfy the goal ({satisfies.sum()}), got {n}; "
            "take fewer, or a dataset with more successes"
        )
    last = np.sort(scores)[-n]
    above, equal = scores > last, scores == last
    return float((satisfies[above].sum() + (n - above.sum()) * satisfies[equal].mean()) / n)


def top_up_to(scores: Values, satisfies: NDArray[np.bool_], n: int = TOP_N) -> float:
    """`top_n_success` with N lowered to μ where μ is smaller, as it may be among resampled candidates."""
    return top_n_success(scores, satisfies, min(n, int(np.sum(satisfies))))


def goal_frame_ratio(satisfies: NDArray[np.bool_]) -> float:
    """Share of the candidates that satisfy the goal: the expected result of picking at random."""
    return float(np.mean(satisfies))


def dataset_total_variation(scores: Values, satisfies: NDArray[np.bool_]) -> float:
    """DTV = (1/M) Σ_i | I(x_i)/μ − φ_i / Σ_j φ_j | (Eq. 3); 0 is best, 2/M the maximum.

    The paper does not say how negative scores become a distribution: here all are shifted so that the lowest is 0.
    Scores that are all equal count as the uniform distribution.

    Args:
        scores: (M,) of the candidates.
        satisfies: (M,) bool, which of them satisfy the goal.

    Raises:
        BadInput: lengths differ, or no candidate satisfies the goal.
    """
    scores, satisfies = _check(scores, satisfies)
    shifted = scores - scores.min()
    if shifted.sum() == 0:
        shifted = np.ones_like(shifted)
    return float(np.abs(satisfies / satisfies.sum() - shifted / shifted.sum()).mean())


def relative_variation(scores: Values, satisfies: NDArray[np.bool_]) -> float:
    """`dataset_total_variation` over its maximum: in [0, 1], and comparable between datasets of different sizes."""
    return dataset_total_variation(scores, satisfies) * len(np.asarray(scores)) / 2


def draw_others(n: int, seed: int) -> NDArray[np.intp]:
    """Draw for each of n >= 2 trajectories another one: (n,) indices, none its own."""
    return (np.arange(n) + np.random.default_rng(seed).integers(1, n, size=n)) % n


def over_trajectories(
    measure: Measure,
    scores: Values,
    satisfies: NDArray[np.bool_],
    trajectory: NDArray[np.intp],
    *,
    n_resamples: int = 1000,
) -> Estimate:
    """Estimate a measure, averaged over R ways of scoring, with a 95 % bootstrap interval over trajectories.

    Whole trajectories are resampled, because the frames of one are correlated.

    Args:
        measure: such as `top_n_success`; resamples for which it raises `BadInput` are left out.
        scores: (R, M) of the candidates, for instance by R samples of the goal's pictures.
        satisfies: (M,) bool.
        trajectory: (M,) of each candidate.
        n_resamples: number of bootstrap samples.
    """
    names, group = np.unique(trajectory, return_inverse=True)
    members = [np.flatnonzero(group.reshape(-1) == i) for i in range(len(names))]

    def measured(chosen: NDArray[np.intp]) -> float:
        frames = np.concatenate([members[i] for i in chosen])
        try:
            return float(np.mean([measure(row[frames], satisfies[frames]) for row in scores]))
        except BadInput:
            return float("nan")

    for row in scores:
        measure(row, satisfies)  # raises where the whole set, not a resample, is at fault
    return over_episodes(measured, len(names), n_resamples=n_resamples)
