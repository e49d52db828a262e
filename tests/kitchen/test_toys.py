from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from zest_rl.kitchen.env import KitchenEnv
from zest_rl.kitchen.tasks import TASKS
from zest_rl.kitchen.toys import toy_pictures
from zest_rl.kitchen.views import Views
from zest_rl.rewards.goals import TOYS, read_goal
from zest_rl.rewards.scorer import ScorerConfig
from zest_rl.rewards.state_scorer import StateScorer


@pytest.mark.parametrize("name", TASKS)
def test_a_toy_is_shown_before_and_after_from_the_same_sides(name: str) -> None:
    starts, goals = toy_pictures(TASKS[name])
    assert len(starts) == len(goals) == 48
    for start, goal in zip(starts, goals, strict=True):
        assert start.shape == goal.shape == (224, 224, 3)
        changed = (start != goal).any(axis=-1)
        assert 0.005 < changed.mean() < 0.7, "the object changes, the wall does not"
        np.testing.assert_array_equal(start[0], goal[0])
    assert len({frame.tobytes() for frame in (*starts, *goals)}) == 96


def test_toys_are_a_goal_of_every_task_and_render_alike_each_time() -> None:
    goal = read_goal(TOYS, TASKS["micro"])
    assert not goal.per_view
    assert goal.fingerprint() == read_goal(TOYS, TASKS["micro"]).fingerprint()
    assert goal.fingerprint() != read_goal(TOYS, TASKS["sdoor"]).fingerprint()


@pytest.mark.parametrize("name", TASKS)
def test_toys_score_the_kitchen_higher_half_way_to_the_goal_and_doors_highest_at_it(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path))
    views, task, start = Views(name), TASKS[name], KitchenEnv(name).start_qpos
    scene = views.shared_renderer().scene
    states = np.array([scene.with_joint(start, task.joint, share * task.goal) for share in (0, 0.5, 1)])
    scorer = StateScorer.build(ScorerConfig(TOYS), views, start, n_workers=1)
    scores = scorer.score_episode(states)
    assert 0 == scores[0] < scores[1], scores
    assert scores[2] > (0.8 if "knob" in name else 1) * scores[1], scores
