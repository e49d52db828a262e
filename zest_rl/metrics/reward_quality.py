"""Quality of a reward before anything is trained on it: pure functions of scores, states and ground truth.

Ground truth judges a reward and never makes one; figures that need none say so. Every figure comes with a 95 %
bootstrap interval over episodes. Scores are those of the frames after each action, (T,) per episode: the rewards of an
episode when these are levels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from zest_rl.errors import BadInput
from zest_rl.metrics.statistics import Estimate, Values, over_episodes, paired, rank_correlation
from zest_rl.types import FloatArray

SATURATED_BAND = 0.05
"""Scores this near (as a share of their range) to the lowest or highest one count as saturated."""


def _check_pairs(what: str, scores: Sequence[NDArray[np.generic]], others: Sequence[NDArray[np.generic]]) -> None:
    if not scores:
        raise BadInput("a reward can be judged on at least 1 episode, got 0; use a dataset with episodes")
    for i, (score, other) in enumerate(zip(scores, others, strict=True)):
        if score.ndim != 1 or len(score) == 0 or len(other) != len(score):
            raise BadInput(
                f"episode {i} must have (T >= 1,) scores and as many {what}, got {score.shape} and {len(other)}"
            )


def _mean_over_episodes(values: Sequence[float]) -> Estimate:
    """Average a figure over the episodes that have one; NaN if there are none."""
    array = np.array(values)
    return over_episodes(lambda i: float(array[i].mean()) if len(array) else float("nan"), len(array))


def _against_time(
    scores: Sequence[FloatArray], figure: Callable[[FloatArray, NDArray[np.int_]], float], *, least: int
) -> Estimate:
    """Average a figure of score and step over the episodes of at least so many frames; of constant scores it is 0."""
    _check_pairs("scores", scores, scores)
    long = (score for score in scores if len(score) >= least)
    return _mean_over_episodes([0.0 if np.ptp(s) == 0 else float(figure(s, np.arange(len(s)))) for s in long])


def _mean_over_frames(shares: Values, scores: Sequence[NDArray[np.generic]]) -> Estimate:
    """Average a figure of each episode (N,), weighted by its number of frames."""
    lengths = np.array([len(score) for score in scores])
    return over_episodes(lambda i: float(np.average(shares[i], weights=lengths[i])), len(scores))


def returns_of(scores: Sequence[FloatArray]) -> Values:
    """Sum of each episode's scores: (N,) float64."""
    return np.array([score.sum(dtype=np.float64) for score in scores])


def value_order(scores: Sequence[FloatArray]) -> Estimate:
    """Value-order correlation: Spearman's ρ of score and time in an episode, averaged over episodes. No ground truth.

    1 is a score that rises at every step (Ma et al. 2024, https://arxiv.org/abs/2411.04549). Episodes whose scores are
    constant have no order and count as 0. Those of one step are left out; NaN if there are no others.
    """
    return _against_time(scores, rank_correlation, least=2)


def order_in_time(score: FloatArray) -> float:
    """Spearman's ρ of score (T,) and time in one episode, as in `value_order`; 0 for constant scores or one step."""
    return 0.0 if np.ptp(score) == 0 else rank_correlation(score, np.arange(len(score)))


def share_explained_by_step(scores: Sequence[FloatArray]) -> Estimate:
    """Share of the scores' variance that the step number alone explains, in [0, 1]. No ground truth.

    Near 1 the reward is a clock: whatever the robot does, the score at step t is the same. An episode's scores are
    predicted by the mean of the *other* episodes at the same step, compared with their mean over all steps:
    1 − Σ squared error / Σ squared distance, at least 0. NaN for constant scores, and for a single episode.
    """
    _check_pairs("scores", scores, scores)
    length = max(map(len, scores))
    padded = np.full((len(scores), length), np.nan)
    for row, score in zip(padded, scores, strict=True):
        row[: len(score)] = score
    present = np.isfinite(padded)
    filled = np.where(present, padded, 0.0)
    others = present.sum(axis=0) - present  # how many other episodes have this step
    by_step = np.divide(filled.sum(axis=0) - filled, others, out=np.zeros_like(filled), where=others > 0)
    lengths = present.sum(axis=1)
    by_all = (filled.sum() - filled.sum(axis=1)) / np.maximum(lengths.sum() - lengths, 1)
    compared = present & (others > 0)
    error = np.where(compared, (filled - by_step) ** 2, 0.0).sum(axis=1)
    distance = np.where(compared, (filled - by_all[:, None]) ** 2, 0.0).sum(axis=1)

    def share(i: NDArray[np.intp]) -> float:
        if distance[i].sum() <= np.finfo(np.float32).eps ** 2 * (filled[i] ** 2).sum():
            return float("nan")
        return float(max(0.0, 1 - error[i].sum() / distance[i].sum()))

    return over_episodes(share, len(scores))


def linear_trend_r2(scores: Sequence[FloatArray]) -> Estimate:
    """R² of a linear trend of score over time (Pearson's ρ²), averaged over episodes. No ground truth.

    Episodes whose scores are constant count as 0. Those of one or two steps, through which every line goes, are left
    out; NaN if there are no others.
    """
    return _against_time(scores, lambda score, time: np.corrcoef(score, time)[0, 1] ** 2, least=3)


def share_saturated(scores: Sequence[FloatArray]) -> Estimate:
    """Share of frames that score within `SATURATED_BAND` of the dataset's lowest or highest score. No ground truth.

    NaN for constant scores.
    """
    _check_pairs("scores", scores, scores)
    pooled = np.concatenate(scores)
    low, high = float(pooled.min()), float(pooled.max())
    if low == high:
        return Estimate(float("nan"), float("nan"), float("nan"))
    scaled = [(score - low) / (high - low) for score in scores]
    shares = np.array([((s < SATURATED_BAND) | (s > 1 - SATURATED_BAND)).mean() for s in scaled])
    return _mean_over_frames(shares, scores)


def share_unchanged(still: Sequence[NDArray[np.bool_]]) -> Estimate:
    """Share of unchanged frames: of the frames after the first, (T,) per episode, those equal to it. No ground truth.

    Averaged over episodes.
    """
    return _mean_over_episodes([episode.mean() for episode in still])


def share_fallen(scores: Sequence[FloatArray]) -> Estimate:
    """Share of the episodes whose last frame scores lower than their first: they end farther from the goal.

    Args:
        scores: (T+1,) per episode, of x_0 … x_T.
    """
    return _mean_over_episodes([float(episode[-1] < episode[0]) for episode in scores])


def share_contradictory(scores: Sequence[FloatArray], states: Sequence[NDArray[np.float64]]) -> Estimate:
    """Share of frames whose score differs from that of an equal state (T, nq) in the same episode. No ground truth.

    0 for any reward that is a function of the current and the first frame alone.
    """
    _check_pairs("states", scores, states)
    shares = []
    for score, episode in zip(scores, states, strict=True):
        _, first, group = np.unique(episode, axis=0, return_index=True, return_inverse=True)
        shares.append(float((score != score[first][group.reshape(-1)]).mean()))
    return _mean_over_frames(np.array(shares), scores)


def kendall(returns: Values, truth: Values) -> Estimate:
    """Kendall's τ-b of two (N,) arrays; NaN where one of them is constant."""
    from scipy import stats

    a, b = paired(returns, truth)
    return over_episodes(lambda i: float(stats.kendalltau(a[i], b[i]).statistic), len(a))


def pairwise_accuracy(returns: Values, truth: Values) -> Estimate:
    """Share of pairs of episodes that the returns order as the true returns (N,) do; .5 is chance.

    Pairs with equal true returns are left out, equal returns count one half. NaN when all true returns are equal.
    """
    a, b = paired(returns, truth)
    agree = (np.sign(a[:, None] - a) * np.sign(b[:, None] - b)).astype(np.int8)

    def accuracy(i: NDArray[np.intp]) -> float:
        chosen = agree[np.ix_(i, i)][b[i][:, None] != b[i]]
        return float((1 + chosen.mean()) / 2) if len(chosen) else float("nan")

    return over_episodes(accuracy, len(a))


def average_precision(returns: Values, success: NDArray[np.bool_]) -> Estimate:
    """Area under the precision-recall curve of predicting success (N,) bool by return; chance is their share.

    Σ over thresholds of (R_k − R_{k−1}) · P_k, equal returns at one threshold. NaN without a success.
    """
    returns, labels = np.asarray(returns, dtype=np.float64), np.asarray(success, dtype=bool)
    if returns.shape != labels.shape or returns.ndim != 1 or len(returns) == 0:
        raise BadInput(
            f"returns and successes must be equally long lists of at least 1 value, got {returns.shape}, {labels.shape}"
        )

    def area(i: NDArray[np.intp]) -> float:
        order = i[np.argsort(-returns[i], kind="stable")]
        if not labels[i].any():
            return float("nan")
        last_of_equals = np.append(np.flatnonzero(np.diff(returns[order])), len(order) - 1)
        hits = np.cumsum(labels[order])[last_of_equals]
        return float((np.diff(hits, prepend=0) / hits[-1] * hits / (last_of_equals + 1)).sum())

    return over_episodes(area, len(returns))


def precision_at(k: int, returns: Values, success: NDArray[np.bool_]) -> Estimate:
    """Share of successes (N,) bool among the k episodes with the highest returns; chance is their share of all.

    Of equal returns at the limit each counts for the share that is still to be chosen among them.
    """
    returns, labels = np.asarray(returns, dtype=np.float64), np.asarray(success, dtype=bool)
    if returns.shape != labels.shape or returns.ndim != 1 or not 1 <= k <= len(returns):
        raise BadInput(
            f"k must be from 1 to the number of returns, and there must be as many successes, got {k}, "
            f"{returns.shape}, {labels.shape}"
        )

    def share(i: NDArray[np.intp]) -> float:
        limit = np.sort(returns[i])[-k]
        above, equal = returns[i] > limit, returns[i] == limit
        return float((labels[i][above].sum() + (k - above.sum()) * labels[i][equal].mean()) / k)

    return over_episodes(share, len(returns))


def epic_distance(scores: Sequence[FloatArray], truth: Sequence[FloatArray]) -> Estimate:
    """EPIC distance of two rewards on the dataset's transitions, in [0, 1]; 0: equal up to scale and offset.

    √((1 − ρ) / 2), ρ Pearson's correlation over all transitions (Gleave et al. 2021, https://arxiv.org/abs/2006.13900).
    Both rewards depend on the next state alone, so the canonical shaping of that paper is a constant, to which the
    correlation is invariant. NaN where one reward is constant.

    Args:
        scores: (T,) per episode.
        truth: (T,) per episode, the ground-truth rewards.
    """
    _check_pairs("ground-truth rewards", scores, truth)
    pooled = [np.asarray(np.concatenate(rewards), dtype=np.float64) for rewards in (scores, truth)]
    offsets, largest = [values.mean() for values in pooled], [np.abs(values).max() for values in pooled]
    sums = np.empty((len(scores), 6))
    for row, score, reward in zip(sums, scores, truth, strict=True):
        a, b = score - offsets[0], reward - offsets[1]
        row[:] = len(a), a.sum(), b.sum(), (a * a).sum(), (b * b).sum(), (a * b).sum()

    def distance(i: NDArray[np.intp]) -> float:
        n, a, b, aa, bb, ab = sums[i].sum(axis=0)
        variances = np.array([aa / n - (a / n) ** 2, bb / n - (b / n) ** 2])
        if (variances <= np.finfo(np.float32).eps ** 2 * np.square(largest)).any():
            return float("nan")
        rho = (ab / n - a * b / n**2) / np.sqrt(variances.prod())
        return float(np.sqrt(np.clip((1 - rho) / 2, 0, 1)))

    return over_episodes(distance, len(scores))
