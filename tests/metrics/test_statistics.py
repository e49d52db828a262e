from __future__ import annotations

import warnings

import numpy as np
import pytest
from scipy import stats

from zest_rl.errors import BadInput
from zest_rl.metrics.statistics import (
    bootstrap,
    iqm,
    mean,
    normalized_return,
    rank_correlation,
    representative,
    spearman,
    wilson,
)


def test_the_normalized_return_is_0_for_doing_nothing_and_100_for_the_expert() -> None:
    got = normalized_return(np.array([2.0, 10.0, 6.0, 0.0, 12.0]), minimum=2.0, expert=10.0)
    np.testing.assert_allclose(got, [0, 100, 50, -25, 125])
    assert got.dtype == np.float64


@pytest.mark.parametrize(("minimum", "expert"), [(1.0, 1.0), (2.0, 1.0), (0.0, float("nan"))])
def test_references_that_are_equal_swapped_or_missing_are_refused(minimum: float, expert: float) -> None:
    with pytest.raises(BadInput, match="expert's return must be above the minimum"):
        normalized_return(np.zeros(2), minimum, expert)


def test_the_interquartile_mean_is_the_mean_of_the_middle_half() -> None:
    values = np.random.default_rng(0).normal(size=40)
    assert iqm(values) == pytest.approx(np.sort(values)[10:30].mean(), rel=1e-12)
    assert iqm(np.array([0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1000.0, 1000.0])) == 1.0


def test_a_bootstrap_interval_holds_the_true_mean_about_95_times_in_100() -> None:
    rng = np.random.default_rng(0)
    n_trials, held = 300, 0
    for trial in range(n_trials):
        estimate = bootstrap([rng.exponential(3.0, size=60)], seed=trial, n_resamples=300)
        held += estimate.low <= 3.0 <= estimate.high
    assert 0.89 <= held / n_trials <= 0.985


def test_a_bootstrap_of_one_group_has_the_width_that_the_standard_error_predicts() -> None:
    values = np.random.default_rng(1).normal(50.0, 10.0, size=400)
    estimate = bootstrap([values], n_resamples=4000)
    assert estimate.value == pytest.approx(values.mean())
    assert estimate.high - estimate.low == pytest.approx(2 * 1.96 * values.std() / np.sqrt(400), rel=0.06)


def test_the_interval_is_wider_when_trainings_differ_than_their_pooled_episodes_suggest() -> None:
    rng = np.random.default_rng(2)
    groups = [rng.normal(center, 1.0, size=50) for center in (20.0, 50.0, 80.0)]
    by_seed, pooled = bootstrap(groups, n_resamples=2000), bootstrap([np.concatenate(groups)], n_resamples=2000)
    assert by_seed.value == pytest.approx(pooled.value)
    assert by_seed.high - by_seed.low > 2.5 * (pooled.high - pooled.low)


def test_seeds_are_resampled_whole_and_within_their_task_alone() -> None:
    seeds = [np.full(3, 1.0), np.full(3, 2.0)]
    estimate = bootstrap(seeds, n_resamples=500)
    assert (estimate.value, estimate.low, estimate.high) == (1.5, 1.0, 2.0)
    of_two_tasks = bootstrap(seeds[:1], seeds[1:], n_resamples=500)
    assert (of_two_tasks.value, of_two_tasks.low, of_two_tasks.high) == (1.5, 1.5, 1.5)


def test_a_bootstrap_repeats_with_its_seed_and_takes_any_statistic() -> None:
    values = [np.random.default_rng(3).normal(size=30)]
    first = bootstrap(values, statistic=iqm, seed=5, n_resamples=200)
    assert first == bootstrap(values, statistic=iqm, seed=5, n_resamples=200)
    assert first != bootstrap(values, statistic=iqm, seed=6, n_resamples=200)
    assert first.value == iqm(values[0]) != mean(values[0])


@pytest.mark.parametrize(
    "tasks",
    [
        [],
        [[]],
        [[np.array([])]],
        [[np.ones(3), np.array([])]],
        [[np.ones(3), np.ones(2)]],
        [[np.ones(3)], [np.ones(2)]],
        [[np.ones(3)], [np.ones(3)] * 2],
    ],
)
def test_an_interval_of_nothing_or_of_unequal_parts_is_refused(tasks: list[list[np.ndarray]]) -> None:
    with pytest.raises(BadInput, match="as many training seeds for every task, and as many values"):
        bootstrap(*tasks)


def test_spearman_equals_the_rank_correlation_computed_by_hand_and_lies_in_its_interval() -> None:
    rng = np.random.default_rng(4)
    a = rng.normal(size=50)
    b = a + rng.normal(size=50)
    estimate = spearman(a, b)
    ranks = [np.argsort(np.argsort(x)) for x in (a, b)]
    assert estimate.value == pytest.approx(np.corrcoef(ranks)[0, 1], abs=1e-12)
    assert -1 < estimate.low < estimate.value < estimate.high < 1


@pytest.mark.parametrize("decimals", [16, 1])
def test_a_rank_correlation_is_scipy_s_with_ties_and_without(decimals: int) -> None:
    a, b = np.round(np.random.default_rng(decimals).normal(size=(2, 200)), decimals)
    assert rank_correlation(a, b) == pytest.approx(stats.spearmanr(a, b).statistic, rel=1e-12)


def test_spearman_sees_order_alone() -> None:
    a = np.arange(20.0)
    estimate = spearman(a, np.exp(a))
    assert estimate.value == pytest.approx(1.0)
    assert estimate.low == pytest.approx(1.0)
    assert spearman(a, -a).value == pytest.approx(-1.0)


@pytest.mark.parametrize("constant_first", [True, False])
def test_spearman_of_a_constant_is_nan_without_a_warning(constant_first: bool) -> None:
    pair = (np.ones(5), np.arange(5.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        estimate = spearman(*(pair if constant_first else pair[::-1]))
    assert np.isnan([estimate.value, estimate.low, estimate.high]).all()


def test_spearman_with_ties_survives_resamples_that_are_constant() -> None:
    estimate = spearman(np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.0, 1.0, 2.0, 3.0]))
    assert np.isfinite([estimate.value, estimate.low, estimate.high]).all()


@pytest.mark.parametrize(("a", "b"), [(np.ones(2), np.ones(2)), (np.ones(4), np.ones(5)), (np.ones((3, 2)),) * 2])
def test_spearman_refuses_lists_that_are_short_or_do_not_fit(a: np.ndarray, b: np.ndarray) -> None:
    with pytest.raises(BadInput, match="two equally long lists of at least 3 values"):
        spearman(a, b)


@pytest.mark.parametrize(("k", "n"), [(0, 50), (50, 50), (37, 50), (1, 2)])
def test_the_wilson_interval_follows_its_formula(k: int, n: int) -> None:
    z, rate = stats.norm.ppf(0.975), k / n
    center = (rate + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(rate * (1 - rate) / n + z**2 / (4 * n**2))
    estimate = wilson(k, n)
    assert estimate.value == rate
    assert (estimate.low, estimate.high) == pytest.approx((center - half, center + half), abs=1e-9)
    assert 0 <= estimate.low <= rate <= estimate.high <= 1


def test_means_intervals_and_rank_correlations_are_those_of_scipy_to_the_bit() -> None:
    rng = np.random.default_rng(0)
    for n in (3, 10, 50, 101):
        values, others = rng.normal(size=(2, n)).round(1)
        assert iqm(values) == stats.trim_mean(values, 0.25)
        assert spearman(values, others, n_resamples=1).value == stats.spearmanr(values, others).statistic
        interval = stats.binomtest(n // 3, n).proportion_ci(method="wilson")
        assert (wilson(n // 3, n).low, wilson(n // 3, n).high) == (interval.low, interval.high)


def test_a_success_rate_of_no_episodes_is_refused() -> None:
    with pytest.raises(BadInput, match="at least 1 episode"):
        wilson(0, 0)


@pytest.mark.parametrize(
    ("returns", "expected"),
    [
        ([3.0, 9.0, 1.0, 5.0, 4.0], {"best": 1, "median": 4, "worst": 2}),
        ([2.0, 7.0, 7.0, 2.0], {"best": 1, "median": 0, "worst": 3}),
        ([1.0, 2.0], {"best": 1, "median": 0, "worst": 0}),
        ([5.0], {"best": 0, "median": 0, "worst": 0}),
    ],
)
def test_best_median_and_worst_are_ranks_of_the_return(returns: list[float], expected: dict[str, int]) -> None:
    assert representative(np.array(returns)) == expected
