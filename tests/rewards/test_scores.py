from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zest_rl.errors import BadInput
from zest_rl.rewards.scores import (
    LOGIT_SCALE,
    PROJECTED,
    ZERO_DELTA,
    change_beside_goal,
    check_names,
    pair_starts,
    score_classifier,
    score_delta,
    score_projection,
    score_raw,
    score_views,
    zero_deltas,
)

Vector = Sequence[float]
Case = tuple[np.ndarray, np.ndarray, np.ndarray]

FEATURES = pytest.mark.parametrize("features", ["delta", "raw"])
SIMILARITIES = pytest.mark.parametrize("similarity", ["cos", "l2"])


# --- the formulas of the paper, one number at a time ---


def cos(a: Vector, b: Vector) -> float:
    lengths = math.hypot(*a) * math.hypot(*b)
    return sum(x * y for x, y in zip(a, b, strict=True)) / lengths if lengths else 0.0


def alpha(a: Vector, b: Vector, similarity: str) -> float:
    return cos(a, b) if similarity == "cos" else -math.dist(a, b)


def minus(a: Vector, b: Vector) -> Vector:
    return [x - y for x, y in zip(a, b, strict=True)]


def naive(case: Case, features: str, similarity: str) -> list[float]:
    frames, starts, goals = (array.tolist() for array in case)
    n_views = len(frames[0])
    scores = []
    for frame in frames:
        total = 0.0
        for view in range(n_views):
            own_starts, own_goals = (s[view] if isinstance(s[0][0], list) else s for s in (starts, goals))
            for goal in own_goals:
                if features == "raw":
                    value = alpha(frame[view], goal, similarity)
                else:
                    start = max(own_starts, key=lambda s: cos(s, goal))
                    value = alpha(minus(frame[view], frames[0][view]), minus(goal, start), similarity)
                total += value / len(own_goals) / n_views
        scores.append(total)
    return scores


@st.composite
def cases(draw: st.DrawFn) -> Case:
    """(T+1, V, D) frames of which some repeat, and S starts and K goals, for all views or for each its own."""
    n, n_views, dim, n_starts, n_goals = (draw(st.integers(low, 5)) for low in (1, 1, 2, 1, 1))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    distinct = rng.normal(size=(n, n_views, dim))
    frames = distinct[rng.integers(0, n, size=draw(st.integers(1, 8)))]
    shapes = [(n_views,) if draw(st.booleans()) else () for _ in range(2)]
    starts, goals = (rng.normal(size=(*v, m, dim)) for v, m in zip(shapes, (n_starts, n_goals), strict=True))
    return frames.astype(np.float32), starts.astype(np.float32), goals.astype(np.float32)


@FEATURES
@SIMILARITIES
@given(case=cases())
def test_scores_are_those_of_a_plain_loop_over_the_formulas(case: Case, features: str, similarity: str) -> None:
    scores = score_views(*case, features, similarity)  # type: ignore[arg-type]
    np.testing.assert_allclose(scores, naive(case, features, similarity), atol=1e-5)
    assert scores.shape == (len(case[0]),)
    assert scores.dtype == np.float32


def unit(vector: Vector) -> Vector:
    length = math.hypot(*vector)
    return [x / length for x in vector]


def naive_peer(features: str, x: Vector, start: Vector, goal: Vector) -> float:
    if features == "classifier":
        odds = [math.exp(LOGIT_SCALE * (cos(x, side) - 1)) for side in (start, goal)]
        return odds[1] / sum(odds)
    x, start, goal = unit(x), unit(start), unit(goal)
    away, way = minus(x, goal), minus(goal, start)
    if not any(way):
        return 1 - math.hypot(*[(1 - PROJECTED) * a for a in away]) ** 2 / 2
    share = sum(a * w for a, w in zip(away, way, strict=True)) / math.hypot(*way) ** 2
    rest = [PROJECTED * share * w + (1 - PROJECTED) * a for a, w in zip(away, way, strict=True)]
    return 1 - math.hypot(*rest) ** 2 / 2


@pytest.mark.parametrize("features", ["projection", "classifier"])
@given(case=cases())
def test_rewards_to_compare_with_are_those_of_a_plain_loop(case: Case, features: str) -> None:
    frames, starts, goals = (array.astype(np.float64) for array in case)
    expected = np.zeros(len(frames))
    for view in range(frames.shape[1]):
        own_starts, own_goals = (rows[view] if rows.ndim == 3 else rows for rows in (starts, goals))
        for goal in own_goals.tolist():
            start = max(own_starts.tolist(), key=lambda s: cos(s, goal))
            for t, frame in enumerate(frames[:, view].tolist()):
                value = naive_peer(features, frame, start, goal)
                expected[t] += value / len(own_goals) / frames.shape[1]
    scores = score_views(*case, features)  # type: ignore[arg-type]
    np.testing.assert_allclose(scores, expected, atol=1e-4)


@given(case=cases())
def test_progress_is_the_share_of_the_distances_of_all_views_and_goals_together(case: Case) -> None:
    frames, _, goals = (array.astype(np.float64) for array in case)
    distances = np.zeros(len(frames))
    for view in range(frames.shape[1]):
        for goal in (goals[view] if goals.ndim == 3 else goals).tolist():
            distances += [math.dist(frame, goal) for frame in frames[:, view].tolist()]
    np.testing.assert_allclose(score_views(*case, "progress"), 1 - distances / distances[0], atol=1e-4)


def test_a_view_that_hardly_shows_the_goal_hardly_counts_for_progress() -> None:
    blind = np.array([[1, 0, 0], [1, 3e-5, 0], [1, 9e-5, 0]], np.float32)
    clear = np.array([[0, 0, 0], [0.5, 0, 0], [1, 0, 0]], np.float32)
    goals = np.array([[[1, 1e-5, 0]], [[1, 0, 0]]], np.float32)
    scores = score_views(np.stack([blind, clear], axis=1), goals, goals, "progress")
    np.testing.assert_allclose(scores, [0, 0.5, 1], atol=1e-3)


def test_rewards_to_compare_with_end_best_at_the_goal() -> None:
    start, goal = np.array([[1.0, 0.2, 0.1]], np.float32), np.array([[0.1, 1.0, 0.3]], np.float32)
    frames = np.concatenate([start, (start + goal) / 2, goal])
    assert score_views(frames[:, None], start, goal, "progress") == pytest.approx([0, 0.5, 1])
    assert score_classifier(frames, start, goal)[[0, 2]] == pytest.approx([0, 1], abs=1e-6)
    projected = score_projection(frames, start, goal)
    assert (np.diff(projected) > 0).all()
    assert projected[-1] == pytest.approx(1)
    assert score_views(goal[:, None], start, goal, "progress") == [0], "an episode that starts at the goal"


def test_the_projections_alpha_goes_from_the_plain_distance_to_the_way_alone() -> None:
    start, goal, aside = np.eye(3, dtype=np.float32)
    frames = np.stack([start, aside, goal])
    plain = score_projection(frames, start[None], goal[None], alpha=0.0)
    assert plain == pytest.approx([cos(frame, goal) for frame in frames.tolist()]), "1 − ½ ‖x − g‖² of unit vectors"
    way = score_projection(frames, start[None], goal[None], alpha=1.0)
    assert way == pytest.approx([0, 0.75, 1]), "half-way: what is aside of the way does not count"
    assert (score_projection(frames, start[None], goal[None]) == score_views(
        frames[:, None], start[None], goal[None], "projection"
    )).all()  # fmt: skip
    with pytest.raises(BadInput, match=r"alpha must be in \[0, 1\], got 1.5"):
        score_projection(frames, start[None], goal[None], alpha=1.5)


@FEATURES
@given(case=cases())
def test_cosines_lie_in_minus_one_to_one_and_negative_distances_at_or_below_zero(case: Case, features: str) -> None:
    assert np.abs(score_views(*case, features, "cos")).max() <= 1  # type: ignore[arg-type]
    assert score_views(*case, features, "l2").max() <= 0  # type: ignore[arg-type]


@FEATURES
@given(case=cases(), frame_scale=st.floats(1e-6, 1e6), goal_scale=st.floats(1e-6, 1e6))
def test_cosine_scores_do_not_depend_on_the_length_of_embeddings(
    case: Case, features: str, frame_scale: float, goal_scale: float
) -> None:
    frames, starts, goals = (array.astype(np.float64) for array in case)
    scaled = score_views(frame_scale * frames, goal_scale * starts, goal_scale * goals, features)  # type: ignore[arg-type]
    np.testing.assert_allclose(scaled, score_views(*case, features), atol=1e-5)  # type: ignore[arg-type]


@given(case=cases())
def test_frames_equal_to_the_first_score_exactly_zero(case: Case) -> None:
    frames, starts, goals = case
    scores = score_views(frames, starts, goals)
    assert scores[0] == 0
    assert not scores[(frames == frames[0]).all(axis=(1, 2))].any()


@given(case=cases())
def test_repeating_a_goal_or_a_view_changes_nothing(case: Case) -> None:
    frames, starts, goals = case
    once = score_views(frames, starts, goals)
    np.testing.assert_allclose(score_views(frames, starts, np.concatenate([goals, goals], axis=-2)), once, atol=1e-6)
    views = [np.concatenate([array, array]) if array.ndim == 3 else array for array in (starts, goals)]
    np.testing.assert_allclose(score_views(np.concatenate([frames, frames], axis=1), *views), once, atol=1e-6)


# --- what the numbers mean ---


def test_an_episode_that_ends_as_the_goal_does_ends_with_the_best_score() -> None:
    episode = np.random.default_rng(0).normal(size=(6, 16)).astype(np.float32)
    start, goal = episode[:1], episode[-1:]
    assert score_delta(episode, start, goal)[-1] == pytest.approx(1)
    assert score_raw(episode, goal)[-1] == pytest.approx(1)
    assert score_delta(episode, start, goal, "l2")[-1] == score_raw(episode, goal, "l2")[-1] == 0
    assert score_delta(episode, goal, start)[-1] == pytest.approx(-1)


def test_delta_scores_ignore_what_the_scene_looks_like_and_raw_scores_do_not() -> None:
    rng = np.random.default_rng(1)
    episode, start, goal, scene = (rng.normal(size=(n, 8)) for n in (5, 1, 1, 1))
    np.testing.assert_allclose(score_delta(episode + scene, start, goal), score_delta(episode, start, goal), atol=1e-6)
    assert np.abs(score_raw(episode + scene, goal) - score_raw(episode, goal)).max() > 0.1


def test_a_change_below_the_threshold_has_no_direction_and_one_above_it_has() -> None:
    x_0 = np.array([100.0, 0.0])
    steps = np.array([0.0, 0.9, 1.1]) * ZERO_DELTA * 100
    episode = x_0 + steps[:, None] * np.array([0.0, 1.0])
    assert score_delta(episode, x_0[None], np.array([[100.0, 5.0]])).tolist() == [0, 0, 1]
    assert zero_deltas(episode).tolist() == [True, True, False]


def test_a_goal_equal_to_its_start_gives_no_direction_to_go() -> None:
    episode = np.random.default_rng(2).normal(size=(4, 3))
    assert not score_delta(episode, np.ones((1, 3)), np.ones((2, 3))).any()


def test_each_goal_is_paired_with_the_start_of_the_nearest_direction_not_the_nearest_point() -> None:
    starts = np.array([[0.0, 1.0], [10.0, 0.0], [-1.0, 0.0]])
    goals = np.array([[1.0, 0.4], [0.1, 7.0], [-3.0, -1.0], [1.0, 0.0]])
    assert pair_starts(starts, goals).tolist() == [1, 0, 2, 1]
    assert np.linalg.norm(starts - goals[0], axis=1).argmin() == 0


# --- refusals ---

FRAMES, ONE = np.ones((4, 3), np.float32), np.ones((1, 3), np.float32)
NAN = np.array([[1.0, np.nan, 0.0]], np.float32)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ((FRAMES[0], ONE, ONE), r"frame_embeddings must have shape \(N >= 1, D\), got \(3,\)"),
        ((FRAMES[:0], ONE, ONE), r"frame_embeddings must have shape \(N >= 1, D\), got \(0, 3\)"),
        ((FRAMES, ONE[:0], ONE), r"start_embeddings must have shape \(N >= 1, D\), got \(0, 3\)"),
        ((FRAMES, ONE, ONE[:, :2]), r"goal_embeddings must have the frames' dimension D = 3, got 2; .*same embedder"),
        ((FRAMES, ONE[:, :2], ONE), r"start_embeddings must have the frames' dimension D = 3, got 2"),
        ((NAN, ONE, ONE), "frame_embeddings must be finite, got NaN or infinity"),
        ((FRAMES, NAN, ONE), "start_embeddings must be finite"),
        ((FRAMES, ONE, ONE * np.inf), "goal_embeddings must be finite"),
    ],
)
def test_arrays_that_do_not_fit_are_refused_by_name(arrays: Case, message: str) -> None:
    with pytest.raises(BadInput, match=message):
        score_delta(*arrays)


def test_raw_scores_and_pairs_refuse_such_arrays_too() -> None:
    with pytest.raises(BadInput, match="goal_embeddings must have the frames' dimension D = 3, got 2"):
        score_raw(FRAMES, ONE[:, :2])
    with pytest.raises(BadInput, match="start_embeddings must have the frames' dimension D = 3, got 2"):
        score_delta(FRAMES, ONE[:, :2], ONE)
    with pytest.raises(BadInput, match="frame_embeddings must be finite"):
        zero_deltas(NAN)


def test_views_that_do_not_fit_are_refused() -> None:
    with pytest.raises(BadInput, match=r"must have shape \(T\+1, V >= 1, D\), got \(4, 3\)"):
        score_views(FRAMES, ONE, ONE)
    with pytest.raises(BadInput, match=r"must have shape \(T\+1, V >= 1, D\), got \(4, 0, 3\)"):
        score_views(np.ones((4, 0, 3), np.float32), ONE, ONE)
    with pytest.raises(BadInput, match="goal_embeddings must hold one set for each of the 1 views, got 2"):
        score_views(FRAMES[:, None], ONE, np.ones((2, 1, 3), np.float32))


def test_an_unknown_feature_or_similarity_is_refused_with_the_nearest_right_one() -> None:
    with pytest.raises(BadInput, match="unknown features 'deltas'; did you mean 'delta'"):
        score_views(FRAMES[:, None], ONE, ONE, "deltas")  # type: ignore[arg-type]
    with pytest.raises(BadInput, match="unknown similarity 'cosine'; did you mean 'cos'"):
        score_delta(FRAMES, ONE, ONE, "cosine")  # type: ignore[arg-type]
    with pytest.raises(BadInput, match="unknown similarity 'cosine'; did you mean 'cos'"):
        check_names("raw", "cosine")
    with pytest.raises(BadInput, match="features 'progress' bring a similarity of their own, got 'l2'"):
        score_views(FRAMES[:, None], ONE, ONE, "progress", "l2")


def test_a_change_is_measured_beside_the_goals() -> None:
    rng = np.random.default_rng(0)
    starts, goals = (rng.normal(size=(3, 8)).astype(np.float32) for _ in range(2))
    ends = rng.normal(size=(5, 2, 8)).astype(np.float32)
    size, cosine = change_beside_goal(ends, starts, goals)
    changes = goals - starts[pair_starts(starts.astype(float), goals.astype(float))]
    moved = ends[:, 1] - ends[:, 0]
    expected = np.median(np.linalg.norm(moved, axis=1)) / np.median(np.linalg.norm(changes, axis=1))
    assert size == pytest.approx(expected)
    unit = [rows / np.linalg.norm(rows, axis=1, keepdims=True) for rows in (moved, changes)]
    assert cosine == pytest.approx(np.median((unit[0] @ unit[1].T).mean(axis=1)), abs=1e-6)
