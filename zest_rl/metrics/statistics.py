"""Statistics of returns and scores: normalized returns, robust means, intervals. Pure NumPy."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zest_rl.errors import BadInput

Values = NDArray[np.float64]
Statistic = Callable[[Values], Values]
N_RESAMPLES, BLOCK = 10_000, 200
"""Bootstrap samples, and how many are in memory at a time."""
Z_95 = 1.959963984540054
"""The 97.5 % quantile of the normal distribution."""
MIN_EPISODES_TO_RANK = 3
"""With fewer, a rank correlation means nothing."""


@dataclass(frozen=True)
class Estimate:
    """A number with its 95 % interval."""

    value: float
    low: float
    high: float

    def as_json(self) -> dict[str, float | list[float]]:
        """The form that it has in the result of a verb."""
        return {"value": self.value, "ci95": [self.low, self.high]}


def normalized_return(returns: Values, minimum: float, expert: float) -> Values:
    """100 × (G − G_min) / (G_expert − G_min); 0 is the robot doing nothing, 100 the expert.

    Raises:
        BadInput: the two references are equal or swapped.
    """
    if not expert > minimum:
        raise BadInput(f"the expert's return must be above the minimum, got {expert} and {minimum}")
    return 100.0 * (np.asarray(returns, dtype=np.float64) - minimum) / (expert - minimum)


def mean(values: Values) -> Values:
    """Arithmetic mean over the last axis."""
    return np.asarray(np.mean(values, axis=-1))


def iqm(values: Values) -> Values:
    """Interquartile mean over the last axis: the mean of the middle half (Agarwal et al. 2021)."""
    values = np.asarray(values)
    n_cut = values.shape[-1] // 4
    middle = np.partition(values, (n_cut, values.shape[-1] - n_cut - 1), axis=-1)[..., n_cut : values.shape[-1] - n_cut]
    return np.asarray(middle.mean(axis=-1))


def bootstrap(
    *tasks: Sequence[Values], statistic: Statistic = mean, seed: int = 0, n_resamples: int = N_RESAMPLES
) -> Estimate:
    """95 % percentile bootstrap over two levels: training seeds, then episodes within a seed; stratified by task.

    Resampling whole seeds keeps the spread between trainings in the interval; resampling episodes alone would leave
    it out. With one seed (or a dataset) only episodes are resampled. Tasks are not resampled: the interval is about
    these tasks (Agarwal et al. 2021, https://arxiv.org/abs/2108.13264).

    Args:
        tasks: for each task one (N,) array per training seed; equally many seeds and episodes for all tasks.
        statistic: over the last axis, of all values together.
        seed: of the resampling.
        n_resamples: number of bootstrap samples.

    Raises:
        BadInput: there is no value, or the numbers of seeds or episodes differ.
    """
    sizes = {(len(groups), *map(len, groups)) for groups in tasks}
    if len(sizes) != 1 or len(set(map(len, tasks[0]))) != 1 or len(tasks[0][0]) == 0:
        raise BadInput(
            "an interval needs as many training seeds for every task, and as many values (at least 1) for every seed, "
            f"got {[[len(group) for group in groups] for groups in tasks]}; evaluate all runs on as many episodes"
        )
    values = np.asarray(tasks, dtype=np.float64)  # (tasks, seeds, N)
    n_tasks, n_seeds, n = values.shape
    rng = np.random.default_rng(seed)
    task = np.arange(n_tasks)[:, None, None]
    samples = []
    for start in range(0, n_resamples, BLOCK):
        size = min(BLOCK, n_resamples - start)
        chosen = rng.integers(n_seeds, size=(size, n_tasks, n_seeds, 1))
        picked = values[task, chosen, rng.integers(n, size=(size, *values.shape))]
        samples.append(statistic(picked.reshape(size, -1)))
    low, high = np.quantile(np.concatenate(samples), [0.025, 0.975])
    return Estimate(float(statistic(values.ravel())), float(low), float(high))


def over_episodes(
    statistic: Callable[[NDArray[np.intp]], float], n: int, *, seed: int = 0, n_resamples: int = 1000
) -> Estimate:
    """Estimate a statistic of n episodes, with a 95 % percentile bootstrap over them.

    Args:
        statistic: of the episodes with these indices, (n,), some more than once; NaN where it is undefined.
        n: number of episodes.
        seed: of the resampling.
        n_resamples: number of bootstrap samples; those on which the statistic is undefined are left out.
    """
    value = statistic(np.arange(n))
    if np.isnan(value):
        return Estimate(value, value, value)
    rng = np.random.default_rng(seed)
    draws = (rng.integers(n, size=n) for _ in range(n_resamples))
    drawn = np.array([statistic(draw) for draw in draws])
    drawn = drawn[~np.isnan(drawn)]
    low, high = np.quantile(drawn, [0.025, 0.975]) if len(drawn) else (np.nan, np.nan)
    return Estimate(value, float(low), float(high))


def paired(a: Values, b: Values) -> tuple[Values, Values]:
    """Return two values per episode as float64 arrays (N,).

    Raises:
        BadInput: they are not equally long lists of at least 3 values.
    """
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if a.shape != b.shape or a.ndim != 1 or len(a) < 3:
        raise BadInput(
            f"a rank correlation needs two equally long lists of at least 3 values, got {a.shape}, {b.shape}"
        )
    return a, b


def rank_correlation(a: NDArray[Any], b: NDArray[Any]) -> float:
    """Spearman's rank correlation of two finite (N,) arrays, as SciPy's, whose import takes a second."""
    return float(np.corrcoef(_ranks(a), _ranks(b))[1, 0])


def _ranks(values: NDArray[Any]) -> Values:
    """Rank values from 1; equal ones share the mean of their ranks."""
    _, where, counts = np.unique(values, return_inverse=True, return_counts=True)
    ranks: Values = (np.cumsum(counts) - (counts - 1) / 2)[where]
    return ranks


def spearman(a: Values, b: Values, *, seed: int = 0, n_resamples: int = 1000) -> Estimate:
    """Spearman's rank correlation of two (N,) arrays, with a percentile bootstrap over the N pairs.

    NaN where one of the two is constant.
    """
    a, b = paired(a, b)

    def rho(i: NDArray[np.intp]) -> float:
        if np.ptp(a[i]) == 0 or np.ptp(b[i]) == 0:
            return float("nan")
        return rank_correlation(a[i], b[i])

    return over_episodes(rho, len(a), seed=seed, n_resamples=n_resamples)


def wilson(n_successes: int, n: int) -> Estimate:
    """Success rate with the 95 % Wilson score interval."""
    if n < 1:
        raise BadInput("a success rate needs at least 1 episode")
    rate, z2 = n_successes / n, Z_95**2
    centre, scale = (2 * n * rate + z2) / (2 * (n + z2)), Z_95 / (2 * (n + z2))
    half = scale * math.sqrt(4 * n * rate * (1 - rate) + z2)
    return Estimate(rate, centre - half if n_successes else 0.0, centre + half if n_successes < n else 1.0)


def representative(returns: Values) -> dict[str, int]:
    """Return the indices of the best, the median and the worst episode by return; ties go to the earlier one."""
    order = np.argsort(-np.asarray(returns), kind="stable")
    return {"best": int(order[0]), "median": int(order[len(order) // 2]), "worst": int(order[-1])}
