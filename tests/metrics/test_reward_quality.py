"""Figures that judge a reward: equal to naive loops, right on rewards that are plainly good or bad."""

from __future__ import annotations

import itertools
import math
from functools import partial

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy import stats

from zest_rl.errors import BadInput
from zest_rl.metrics import reward_quality

N, T = 12, 20
RISING = np.arange(T, dtype=np.float32)
small = st.lists(st.integers(0, 4), min_size=3, max_size=9)


def noise(seed: int, n: int = N, length: int = T) -> list[np.ndarray]:
    return list(np.random.default_rng(seed).normal(size=(n, length)).astype(np.float32))


def equal(got: float, expected: float) -> bool:
    return math.isclose(got, expected, abs_tol=1e-9) or (math.isnan(got) and math.isnan(expected))


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two bootstrap samples: the values do not depend on them."""
    monkeypatch.setattr(reward_quality, "over_episodes", partial(reward_quality.over_episodes, n_resamples=2))


one_patch_for_all_examples = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


# --- against naive loops ---


@pytest.mark.usefixtures("quick")
@one_patch_for_all_examples
@given(small, st.data())
def test_pairwise_accuracy_equals_a_loop_over_pairs(returns: list[int], draw: st.DataObject) -> None:
    truth = draw.draw(st.lists(st.integers(0, 3), min_size=len(returns), max_size=len(returns)))
    points = []
    for i, j in itertools.combinations(range(len(returns)), 2):
        if truth[i] != truth[j]:
            points.append(
                0.5 if returns[i] == returns[j] else float((returns[i] > returns[j]) == (truth[i] > truth[j]))
            )
    expected = np.mean(points) if points else math.nan
    got = reward_quality.pairwise_accuracy(np.array(returns, float), np.array(truth, float))
    assert equal(got.value, expected)


@pytest.mark.usefixtures("quick")
@one_patch_for_all_examples
@given(small, st.data())
def test_average_precision_equals_a_loop_over_thresholds(returns: list[int], draw: st.DataObject) -> None:
    success = draw.draw(st.lists(st.booleans(), min_size=len(returns), max_size=len(returns)))
    area, recall = 0.0, 0.0
    for threshold in sorted(set(returns), reverse=True):
        picked = [won for value, won in zip(returns, success, strict=True) if value >= threshold]
        now = sum(picked) / sum(success) if any(success) else math.nan
        area, recall = area + (now - recall) * sum(picked) / len(picked), now
    got = reward_quality.average_precision(np.array(returns, float), np.array(success))
    assert equal(got.value, area if any(success) else math.nan)


@pytest.mark.usefixtures("quick")
@one_patch_for_all_examples
@given(small, st.data())
def test_precision_at_k_equals_the_mean_over_all_choices_among_equal_returns(
    returns: list[int], draw: st.DataObject
) -> None:
    n = len(returns)
    success = draw.draw(st.lists(st.booleans(), min_size=n, max_size=n))
    k = draw.draw(st.integers(1, n))
    limit = sorted(returns, reverse=True)[k - 1]
    above = [i for i in range(n) if returns[i] > limit]
    at_limit = [i for i in range(n) if returns[i] == limit]
    shares = [
        sum(success[i] for i in (*above, *chosen)) / k for chosen in itertools.combinations(at_limit, k - len(above))
    ]
    got = reward_quality.precision_at(k, np.array(returns, float), np.array(success))
    assert equal(got.value, float(np.mean(shares)))


@pytest.mark.usefixtures("quick")
@one_patch_for_all_examples
@given(st.integers(0, 100))
def test_epic_distance_is_that_of_pearson_s_correlation_over_all_transitions(seed: int) -> None:
    a, b = noise(seed), noise(seed + 1)
    rho = stats.pearsonr(np.concatenate(a), np.concatenate(b)).statistic
    assert reward_quality.epic_distance(a, b).value == pytest.approx(math.sqrt((1 - rho) / 2), abs=1e-6)


@pytest.mark.usefixtures("quick")
@one_patch_for_all_examples
@given(st.integers(0, 100))
def test_the_share_told_by_the_step_equals_a_loop_over_the_other_episodes(seed: int) -> None:
    scores = [score[: 5 + i] + 0.3 * RISING[: 5 + i] for i, score in enumerate(noise(seed))]  # of different lengths
    error = distance = 0.0
    for i, score in enumerate(scores):
        others = scores[:i] + scores[i + 1 :]
        overall = np.mean(np.concatenate(others))
        for t, value in enumerate(score):
            at_step = [other[t] for other in others if len(other) > t]
            if at_step:
                error += (value - np.mean(at_step)) ** 2
                distance += (value - overall) ** 2
    assert reward_quality.share_explained_by_step(scores).value == pytest.approx(max(0, 1 - error / distance), abs=1e-5)


@pytest.mark.usefixtures("quick")
@one_patch_for_all_examples
@given(st.integers(0, 100))
def test_kendall_and_value_order_are_scipy_s(seed: int) -> None:
    a, b = np.random.default_rng(seed).normal(size=(2, N))
    assert reward_quality.kendall(a, b).value == pytest.approx(stats.kendalltau(a, b).statistic)
    scores = noise(seed)
    expected = np.mean([stats.spearmanr(score, np.arange(T)).statistic for score in scores])
    assert reward_quality.value_order(scores).value == pytest.approx(expected)


def test_contradictions_equal_a_loop_over_equal_states() -> None:
    states = [np.array([[0.0], [1.0], [0.0], [1.0], [2.0]]), np.array([[0.0], [0.0]])]
    scores = [np.array([0.1, 0.5, 0.1, 0.6, 0.9], np.float32), np.array([0.2, 0.3], np.float32)]
    assert reward_quality.share_contradictory(scores, states).value == pytest.approx(2 / 7)  # .6 for .5, .3 for .2


# --- good and bad rewards ---


def test_a_perfect_reward_reaches_the_best_values() -> None:
    truth = noise(0)
    scores = [3 * episode + 1 for episode in truth]
    returns, true_returns = reward_quality.returns_of(scores), reward_quality.returns_of(truth)
    assert reward_quality.kendall(returns, true_returns).value == pytest.approx(1)
    assert reward_quality.pairwise_accuracy(returns, true_returns).value == 1
    assert reward_quality.average_precision(returns, true_returns > np.median(true_returns)).value == 1
    assert reward_quality.epic_distance(scores, truth).value == pytest.approx(0, abs=1e-3)
    assert reward_quality.epic_distance([-score for score in scores], truth).value == pytest.approx(1, abs=1e-3)


def test_a_clock_is_told_by_the_step_and_noise_is_not() -> None:
    assert reward_quality.share_explained_by_step([RISING] * N).value == 1
    assert reward_quality.share_explained_by_step(noise(0, n=200)).value < 0.05
    assert reward_quality.value_order([RISING] * N).value == 1
    assert reward_quality.value_order([-RISING] * N).value == -1
    assert reward_quality.value_order([np.zeros(T, np.float32)] * N).value == 0


def test_saturation_counts_both_ends() -> None:
    score = np.array([0, 1, 1, 1, 0.5, 1, 1, 1, 1, 0.97], np.float32)
    assert reward_quality.share_saturated([score] * 3).value == pytest.approx(0.9)


def test_episodes_that_end_lower_than_they_began_are_counted() -> None:
    score = np.array([0, 0.5, 0.1], np.float32)
    assert reward_quality.share_fallen([score, score[::-1], -score, 0 * score]).value == pytest.approx(2 / 4)


def test_frames_equal_to_the_first_show_nothing() -> None:
    still = np.array([True, True, False, True])
    assert reward_quality.share_unchanged([still, still[:2]]).value == pytest.approx((3 / 4 + 1) / 2)


def test_a_score_proportional_to_time_is_straight_whatever_its_slope_start_and_length() -> None:
    lines = [slope * np.arange(n) + start for slope, n, start in ((0.1, 10, 0.0), (1.0, 30, 5.0), (-0.3, 7, 1.0))]
    assert reward_quality.linear_trend_r2([line.astype(np.float32) for line in lines]).value == pytest.approx(1)
    step = (np.arange(30) >= 15).astype(np.float32)
    assert reward_quality.linear_trend_r2([step]).value == pytest.approx(np.corrcoef(step, np.arange(30))[0, 1] ** 2)
    assert reward_quality.linear_trend_r2([np.ones(5, np.float32), np.ones(1, np.float32)]).value == 0


def test_an_undefined_figure_is_nan_and_not_a_number_that_looks_good() -> None:
    constant = [np.ones(T, np.float32)] * N
    truth = noise(0)
    for estimate in (
        reward_quality.share_explained_by_step(constant),
        reward_quality.share_saturated(constant),
        reward_quality.epic_distance(constant, truth),
        reward_quality.kendall(reward_quality.returns_of(constant), reward_quality.returns_of(truth)),
        reward_quality.pairwise_accuracy(reward_quality.returns_of(truth), np.ones(N)),
        reward_quality.average_precision(reward_quality.returns_of(truth), np.zeros(N, bool)),
        reward_quality.value_order([np.zeros(1, np.float32)] * N),
        reward_quality.linear_trend_r2([RISING[:2]] * N),
    ):
        assert math.isnan(estimate.value)
        assert math.isnan(estimate.low)
    assert reward_quality.value_order([RISING, np.zeros(1, np.float32)]).value == 1, "one step has no order"


def test_every_interval_holds_its_value() -> None:
    for seed in range(5):
        scores, truth = noise(seed), noise(seed + 10)
        mixed = [0.5 * a + b for a, b in zip(scores, truth, strict=True)]
        returns, true_returns = reward_quality.returns_of(mixed), reward_quality.returns_of(truth)
        states = [np.round(score)[:, None] for score in scores]
        for estimate in (
            reward_quality.value_order(mixed),
            reward_quality.share_explained_by_step(mixed),
            reward_quality.share_explained_by_step([score + 0.1 * RISING for score in mixed]),
            reward_quality.share_saturated(mixed),
            reward_quality.share_unchanged([episode > 0 for episode in mixed]),
            reward_quality.linear_trend_r2(mixed),
            reward_quality.share_contradictory(mixed, states),
            reward_quality.kendall(returns, true_returns),
            reward_quality.pairwise_accuracy(returns, true_returns),
            reward_quality.average_precision(returns, true_returns > 0),
            reward_quality.epic_distance(mixed, truth),
        ):
            assert estimate.low <= estimate.value <= estimate.high


def test_epic_distance_does_not_depend_on_scale_or_offset() -> None:
    scores, truth = noise(0), noise(1)
    expected = reward_quality.epic_distance(scores, truth).value
    for scale, offset in ((1e-9, 0), (1e6, 0), (1, 300)):
        scaled = [(scale * episode.astype(np.float64) + offset).astype(np.float64) for episode in truth]
        assert reward_quality.epic_distance(scores, scaled).value == pytest.approx(expected, abs=1e-6)


def test_intervals_narrow_with_more_episodes() -> None:
    few, many = (reward_quality.value_order([RISING + 8 * e for e in noise(0, n=n)]) for n in (10, 200))
    assert many.high - many.low < few.high - few.low


# --- bad input ---


def test_lists_that_do_not_fit_are_refused() -> None:
    with pytest.raises(BadInput, match="at least 1 episode, got 0"):
        reward_quality.value_order([])
    with pytest.raises(BadInput, match=r"episode 0 must have \(T >= 1,\) scores and as many ground-truth rewards"):
        reward_quality.epic_distance([RISING], [RISING[:-1]])
    with pytest.raises(BadInput, match="equally long lists of at least 3 values"):
        reward_quality.kendall(np.ones(2), np.ones(2))
    with pytest.raises(BadInput, match="equally long lists of at least 1 value"):
        reward_quality.average_precision(np.ones(3), np.ones(2, bool))
