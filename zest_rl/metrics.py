"""Statistics of returns and scores: normalized returns, robust means, intervals. Pure NumPy / SciPy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from zest_rl.errors import BadInput

Values = NDArray[np.float64]
Statistic = Callable[[Values], float]
N_RESAMPLES = 10_000


@dataclass(frozen=True)
class Estimate:
    """A number with its 95 % interval."""

    value: float
    low: float
    high: float


def normalized_return(returns: Values, minimum: float, expert: float) -> Values:
    """100 × (G − G_min) / (G_expert − G_min); 0 is the robot doing nothing, 100 the expert.

    Raises:
        BadInput: the two references are equal or swapped.
    """
    if not expert > minimum:
        raise BadInput(f"the expert's return must be above the minimum, got {expert} and {minimum}")
    return 100.0 * (np.asarray(returns, dtype=np.float64) - minimum) / (expert - minimum)


def mean(values: Values) -> float:
    """Arithmetic mean."""
    return float(np.mean(values))


def iqm(values: Values) -> float:
    """Interquartile mean: the mean of the middle half (Agarwal et al. 2021)."""
    return float(stats.trim_mean(values, 0.25, axis=None))


def bootstrap(
    groups: Sequence[Values], statistic: Statistic = mean, *, seed: int = 0, n_resamples: int = N_RESAMPLES
) -> Estimate:
    """95 % percentile bootstrap over two levels: training seeds, then episodes within a seed.

    Resampling whole seeds keeps the spread between trainings in the interval; resampling episodes alone would leave
    it out. With one group (a dataset, or a single seed) only episodes are resampled.

    Args:
        groups: one (N_i,) array per training seed.
        statistic: of all values together.
        seed: of the resampling.
        n_resamples: number of bootstrap samples.

    Raises:
        BadInput: there is no value.
    """
    if not groups or any(len(group) == 0 for group in groups):
        raise BadInput("an interval needs at least 1 value per group")
    rng = np.random.default_rng(seed)
    samples = np.empty(n_resamples)
    for i in range(n_resamples):
        chosen = rng.integers(len(groups), size=len(groups))
        samples[i] = statistic(np.concatenate([rng.choice(groups[g], size=len(groups[g])) for g in chosen]))
    low, high = np.quantile(samples, [0.025, 0.975])
    return Estimate(statistic(np.concatenate(list(groups))), float(low), float(high))


def spearman(a: Values, b: Values, *, seed: int = 0, n_resamples: int = 1000) -> Estimate:
    """Spearman's rank correlation of two (N,) arrays, with a percentile bootstrap over the N pairs.

    NaN where one of the two is constant.
    """
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if a.shape != b.shape or a.ndim != 1 or len(a) < 3:
        raise BadInput(
            f"a rank correlation needs two equally long lists of at least 3 values, got {a.shape}, {b.shape}"
        )

    def rho(x: Values, y: Values) -> float:
        if np.ptp(x) == 0 or np.ptp(y) == 0:
            return float("nan")
        return float(stats.spearmanr(x, y).statistic)

    value = rho(a, b)
    if np.isnan(value):
        return Estimate(value, value, value)
    rng = np.random.default_rng(seed)
    draws = (rng.integers(len(a), size=len(a)) for _ in range(n_resamples))
    low, high = np.nanquantile([rho(a[i], b[i]) for i in draws], [0.025, 0.975])
    return Estimate(value, float(low), float(high))


def wilson(n_successes: int, n: int) -> Estimate:
    """Success rate with the 95 % Wilson score interval."""
    if n < 1:
        raise BadInput("a success rate needs at least 1 episode")
    interval = stats.binomtest(n_successes, n).proportion_ci(method="wilson")
    return Estimate(n_successes / n, float(interval.low), float(interval.high))
