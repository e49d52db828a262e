"""Goal and action selection on frames of a real dataset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from read_dataset import read
from tiny_dataset import COLLECTED

from zest_rl.analysis.frame_selection import FramePool, draw_pool, score_pool
from zest_rl.data.reader import Dataset
from zest_rl.errors import BadInput
from zest_rl.kitchen.tasks import TASKS
from zest_rl.kitchen.views import Views
from zest_rl.rewards.scorer import ScorerConfig
from zest_rl.rewards.state_scorer import StateScorer

VIEWS = Views("micro", n_views=1, size=96, tolerance=0.05)
CONFIG = ScorerConfig("same-scene")
MICRO = TASKS["micro"]


@pytest.fixture
def pool(collected: str) -> FramePool:
    """Forty frames of the tiny dataset."""
    return draw_pool([collected], 40)


def test_frames_are_drawn_with_their_trajectory_its_start_and_its_task(pool: FramePool) -> None:
    episodes = read(COLLECTED, Dataset.states)
    assert len(pool.states) == len(pool.trajectory) == 40
    assert pool.task == ("micro",) * len(episodes)
    for state, trajectory in zip(pool.states, pool.trajectory, strict=True):
        assert (episodes[trajectory][1:] == state).all(axis=1).any()
    np.testing.assert_array_equal(pool.starts, [episode[0] for episode in episodes])
    again = draw_pool([COLLECTED], 40)
    np.testing.assert_array_equal(again.states, pool.states)
    assert not np.array_equal(draw_pool([COLLECTED], 40, seed=1).states, pool.states)
    assert len(draw_pool([COLLECTED], 10**6).states) == sum(len(episode) - 1 for episode in episodes)


def test_satisfied_goals_are_those_of_the_recorded_ground_truth(collected: str) -> None:
    every = draw_pool([collected], 10**6)
    truth = np.concatenate([episode.rewards for episode in read(collected, Dataset.truth)])
    np.testing.assert_array_equal(every.satisfies(MICRO), truth >= 0.999)
    assert every.satisfies(MICRO).any()
    assert not every.satisfies(TASKS["sdoor"]).any(), "nobody touched the sliding door"
    np.testing.assert_array_equal(every.does(TASKS["sdoor"]), every.satisfies(MICRO))  # opening is opening
    assert not every.does(TASKS["knob2"]).any(), "turning on is something else"


def test_the_context_is_of_the_same_or_always_of_another_trajectory(pool: FramePool) -> None:
    same = pool.contexts("same", 0)
    np.testing.assert_array_equal(same, pool.starts[pool.trajectory])
    for seed in range(5):
        other = pool.contexts("different", seed)
        assert (other != same).any(axis=1).all()
        assert all((pool.starts == row).all(axis=1).any() for row in other)
    with pytest.raises(BadInput, match="unknown context 'none'"):
        pool.contexts("none", 0)  # type: ignore[arg-type]
    alone = replace(pool, starts=pool.starts[:1], trajectory=np.zeros_like(pool.trajectory))
    with pytest.raises(BadInput, match="needs at least 2 trajectories"):
        alone.contexts("different", 0)


def test_scores_are_the_scorer_s_and_find_the_open_door(pool: FramePool) -> None:
    scores = score_pool(pool, CONFIG, VIEWS, n_workers=1)
    scorer = StateScorer.build(CONFIG, VIEWS, pool.starts[0], n_workers=1)
    expected = [
        scorer.score_episode(np.stack([pool.starts[i], state]))[-1]
        for i, state in zip(pool.trajectory, pool.states, strict=True)
    ]
    np.testing.assert_allclose(scores, [expected], atol=1e-6)
    reached = pool.satisfies(MICRO)
    assert scores[0, reached].mean() > scores[0, ~reached].mean()


def test_repeats_draw_other_goals(pool: FramePool) -> None:
    config = replace(CONFIG, goal="drawings")
    rows = score_pool(pool, config, VIEWS, n_repeats=3, n_goals=1, n_workers=1)
    assert rows.shape == (3, 40)
    assert len({row.tobytes() for row in rows}) > 1
    with pytest.raises(BadInput, match=r"pictures, 99 cannot be drawn of them"):
        score_pool(pool, config, VIEWS, n_goals=99, n_workers=1)


def test_an_action_is_seen_from_the_views_of_the_trajectory_s_own_task(pool: FramePool) -> None:
    of_another_task = replace(VIEWS, task="sdoor")
    scores = score_pool(pool, CONFIG, of_another_task, ask="actions", n_workers=1)
    goal = StateScorer.build(CONFIG, of_another_task, pool.starts[0], n_workers=1).scorer
    seen = StateScorer.of(replace(goal, views=VIEWS), n_workers=1)
    expected = seen.score_pairs(pool.contexts("same", 0), pool.states)
    np.testing.assert_allclose(scores, [expected], atol=1e-6)
    assert np.ptp(scores) > 0


def test_the_verbs_tell_how_much_better_than_chance_a_goal_is(
    collected: str, zest: Callable[..., dict[str, Any]]
) -> None:
    small = ("--views", 1, "--tolerance", 0.05, "--n-frames", 60, "--top", 5, "--n-workers", 1)
    goals = zest("select", "goals", collected, *small)
    assert (goals["task"], goals["n_candidates"], goals["top"]) == ("micro", 60, 5)
    assert goals["goal_frame_ratio"] == goals["n_satisfying"] / 60
    assert goals["top_n_success"]["ci95"][0] <= goals["top_n_success"]["value"] <= goals["top_n_success"]["ci95"][1]
    assert goals["times_random"] == pytest.approx(goals["top_n_success"]["value"] / goals["goal_frame_ratio"])
    actions = zest("select", "actions", collected, "--task", "ldoor", *small)
    assert (actions["select"], actions["n_satisfying"]) == ("actions", goals["n_satisfying"])


def test_x_0_of_another_trajectory_matters_where_starts_differ(
    pool: FramePool, capsys: pytest.CaptureFixture[str]
) -> None:
    from zest_rl import cli

    assert pool.start_alike(VIEWS), "the robot is hidden"
    assert not pool.start_alike(replace(VIEWS, robot=True, tolerance=1e-3))
    ajar = pool.starts.copy()
    ajar[1:, 22] = [-0.1, -0.2, -0.3]  # the microwave
    for starts, equal in ((pool.starts, True), (ajar, False)):
        moved = replace(pool, starts=starts)
        same, other = (score_pool(moved, CONFIG, VIEWS, context=c, n_workers=1) for c in ("same", "different"))
        assert np.allclose(same, other) == equal
    words = ("--views", "1", "--tolerance", "0.05", "--n-frames", "60", "--top", "5", "--n-workers", "1")
    assert cli.main(["select", "goals", COLLECTED, "--context", "different", "--n-repeats", "1", *words]) == 0
    err = capsys.readouterr().err
    told = "x_0 of another one changes nothing; try --show-robot"
    assert 0 <= err.find(told) < err.index("rendering and embedding: 100/100"), "told before the work"


def test_what_cannot_be_selected_from_is_refused(collected: str, capsys: pytest.CaptureFixture[str]) -> None:
    from zest_rl import cli

    assert cli.main(["select", "goals", collected, "--task", "sdoor", "--n-frames", "20"]) == 2
    assert "only 0 of 20 candidates satisfy the goal of 'sdoor'" in capsys.readouterr().err
    with pytest.raises(BadInput, match="at least 1 dataset, each once, and 1 frame of each, got none and 5"):
        draw_pool([], 5)
    with pytest.raises(BadInput, match="each once"):
        draw_pool([collected, collected], 5)
    for wrong in ("--top", "--n-repeats", "--n-frames", "--views"):
        assert cli.main(["select", "goals", collected, wrong, "0"]) == 2
        assert "must be at least 1" in capsys.readouterr().err
