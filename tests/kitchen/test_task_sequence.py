"""Several tasks performed one after another in the real kitchen."""

from __future__ import annotations

import numpy as np
import pytest

from zest_rl.errors import BadInput
from zest_rl.kitchen.env import progress_of
from zest_rl.kitchen.task_sequence import perform
from zest_rl.kitchen.tasks import SUCCESS_PROGRESS, TASKS


def test_experts_do_one_task_after_another_without_a_reset() -> None:
    performance = perform(("knob3", "sdoor"), seed=3)
    for task, done_at in performance.done_at.items():
        progress = progress_of(TASKS[task], performance.states)
        assert np.argmax(progress >= SUCCESS_PROGRESS) == done_at
    turned = performance.states[performance.done_at["knob3"]]
    assert progress_of(TASKS["sdoor"], turned) < 0.1
    jumps = np.abs(np.diff(performance.states, axis=0)).max(axis=1)
    assert jumps[performance.done_at["knob3"]] < 2 * np.quantile(jumps, 0.9), "the second starts where the first ends"


@pytest.mark.parametrize("tasks", [("micro",), ("micro", "micro"), ()])
def test_one_task_or_the_same_twice_is_no_episode_of_several(tasks: tuple[str, ...]) -> None:
    with pytest.raises(BadInput, match="2 or more different tasks, got "):
        perform(tasks, seed=0)
