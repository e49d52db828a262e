"""Top-N success and total variation: equal to naive loops, right at their ends."""

from __future__ import annotations

import itertools
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zest_rl.errors import BadInput
from zest_rl.metrics.selection import (
    dataset_total_variation,
    goal_frame_ratio,
    over_trajectories,
    relative_variation,
    top_n_success,
    top_up_to,
)


@st.composite
def pools(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """Scores with ties, and which candidates satisfy the goal: at least one."""
    scores = draw(st.lists(st.integers(-3, 3), min_size=2, max_size=7))
    satisfies = draw(st.lists(st.booleans(), min_size=len(scores), max_size=len(scores)).filter(any))
    return np.array(scores, float) / 4, np.array(satisfies)


@given(pools(), st.data())
def test_top_n_success_is_the_mean_over_all_orders_of_equal_scores(
    pool: tuple[np.ndarray, np.ndarray], data: st.DataObject
) -> None:
    scores, satisfies = pool
    n = data.draw(st.integers(1, int(satisfies.sum())))
    orders = [
        order
        for order in itertools.permutations(range(len(scores)))
        if all(scores[i] >= scores[j] for i, j in itertools.pairwise(order))
    ]
    expected = np.mean([satisfies[list(order[:n])].mean() for order in orders])
    assert top_n_success(scores, satisfies, n) == pytest.approx(expected)


@given(pools())
def test_total_variation_equals_a_loop_over_candidates(pool: tuple[np.ndarray, np.ndarray]) -> None:
    scores, satisfies = pool
    lowest = min(scores)
    phi = [score - lowest for score in scores]
    if sum(phi) == 0:
        phi = [1.0] * len(scores)
    total = 0.0
    for score, satisfied in zip(phi, satisfies, strict=True):
        total += abs((1 / sum(satisfies) if satisfied else 0) - score / sum(phi))
    assert dataset_total_variation(scores, satisfies) == pytest.approx(total / len(scores))
    assert 0 <= relative_variation(scores, satisfies) <= 1 + 1e-9


def test_a_perfect_score_and_its_opposite_are_the_ends() -> None:
    satisfies = np.array([True, True, False, False, False])
    perfect = satisfies.astype(float)
    assert top_n_success(perfect, satisfies, 2) == 1
    assert top_n_success(-perfect, satisfies, 2) == 0
    assert relative_variation(perfect, satisfies) == 0
    assert relative_variation(-perfect, satisfies) == pytest.approx(1)
    assert top_n_success(np.zeros(5), satisfies, 2) == goal_frame_ratio(satisfies) == 0.4


def test_scores_are_compared_up_to_scale_and_offset() -> None:
    rng = np.random.default_rng(0)
    scores, satisfies = rng.normal(size=50), rng.random(50) < 0.3
    for measure in (partial(top_n_success, n=5), dataset_total_variation):
        assert measure(7 * scores - 3, satisfies) == pytest.approx(measure(scores, satisfies))


def test_whole_trajectories_are_resampled_and_repeats_averaged() -> None:
    rng = np.random.default_rng(0)
    trajectory = np.repeat(np.arange(20), 10)
    satisfies = np.isin(trajectory, np.arange(8))  # all frames of a trajectory agree
    scores = satisfies + rng.normal(size=(3, len(trajectory)))
    top = partial(top_n_success, n=10)
    found = over_trajectories(top, scores, satisfies, trajectory, n_resamples=200)
    assert found.value == pytest.approx(np.mean([top(row, satisfies) for row in scores]))
    assert found.low <= found.value <= found.high
    by_frame = over_trajectories(top, scores, satisfies, np.arange(len(trajectory)), n_resamples=200)
    ratio = over_trajectories(lambda _, s: goal_frame_ratio(s), scores, satisfies, trajectory, n_resamples=200)
    ratio_by_frame = over_trajectories(
        lambda _, s: goal_frame_ratio(s), scores, satisfies, np.arange(len(trajectory)), n_resamples=200
    )
    assert by_frame.value == found.value
    assert ratio.high - ratio.low > 2 * (ratio_by_frame.high - ratio_by_frame.low)


def test_resamples_with_few_satisfied_goals_are_kept() -> None:
    rng = np.random.default_rng(0)
    trajectory = np.repeat(np.arange(12), 4)
    satisfies = trajectory < 6
    scores = rng.normal(size=(1, len(trajectory))) + satisfies
    n = int(satisfies.sum())
    found = over_trajectories(partial(top_up_to, n=n), scores, satisfies, trajectory, n_resamples=300)
    strict = over_trajectories(partial(top_n_success, n=n), scores, satisfies, trajectory, n_resamples=300)
    assert found.value == strict.value == top_n_success(scores[0], satisfies, n)
    assert found.low < strict.low, "resamples with fewer satisfied goals are the unlucky ones"


def test_more_places_than_the_goal_can_fill_are_refused() -> None:
    satisfies = np.array([True, True, False])
    for n in (0, 3):
        with pytest.raises(
            BadInput, match=rf"between 1 and the number of candidates that satisfy the goal \(2\), got {n}"
        ):
            top_n_success(np.arange(3.0), satisfies, n)
    with pytest.raises(BadInput, match="no candidate satisfies the goal"):
        dataset_total_variation(np.arange(3.0), np.zeros(3, bool))
    with pytest.raises(BadInput, match="equally long lists"):
        top_n_success(np.arange(3.0), satisfies[:2], 1)
