from __future__ import annotations

import numpy as np
import pytest

from zest_rl.kitchen.tasks import TASKS
from zest_rl.kitchen.toys import toy_pictures
from zest_rl.rewards.goals import TOYS, read_goal


@pytest.mark.parametrize("name", TASKS)
def test_a_toy_is_shown_before_and_after_from_the_same_sides(name: str) -> None:
    starts, goals = toy_pictures(TASKS[name])
    assert len(starts) == len(goals) == 24
    for start, goal in zip(starts, goals, strict=True):
        assert start.shape == goal.shape == (224, 224, 3)
        changed = (start != goal).any(axis=-1)
        assert 0.005 < changed.mean() < 0.5, "the object changes, the wall does not"
        np.testing.assert_array_equal(start[0], goal[0])
    assert len({frame.tobytes() for frame in (*starts, *goals)}) == 48


def test_toys_are_a_goal_of_every_task_and_render_alike_each_time() -> None:
    goal = read_goal(TOYS, TASKS["micro"])
    assert not goal.per_view
    assert goal.fingerprint() == read_goal(TOYS, TASKS["micro"]).fingerprint()
    assert goal.fingerprint() != read_goal(TOYS, TASKS["sdoor"]).fingerprint()
