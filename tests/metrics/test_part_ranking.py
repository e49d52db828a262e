"""How well a reward ranks parts of trajectories."""

from __future__ import annotations

import math

import numpy as np
import pytest

from zest_rl.metrics.part_ranking import part_accuracy


def test_the_true_reward_ranks_all_parts_right_its_negative_none_and_noise_half() -> None:
    rng = np.random.default_rng(0)
    true = [rng.random(30).cumsum().astype(np.float32) for _ in range(12)]
    assert part_accuracy(true, true, 10) == 1.0
    assert part_accuracy([2 * each + 5 for each in true], true, 10) == 1.0
    assert part_accuracy([-each for each in true], true, 10) == 0.0
    noise = [rng.random(30).astype(np.float32) for _ in range(12)]
    assert part_accuracy(noise, true, 10) == pytest.approx(0.5, abs=0.1)


def test_parts_that_are_equally_good_do_not_count_and_equal_predictions_are_wrong() -> None:
    flat = [np.zeros(20, np.float32)] * 3
    assert math.isnan(part_accuracy(flat, flat, 5))
    true = [np.full(20, i, np.float32) for i in range(3)]
    assert part_accuracy(flat, true, 5) == 0.0


def test_parts_are_as_long_as_the_shortest_trajectory_at_most() -> None:
    true = [np.full(n, n, np.float32) for n in (4, 9, 12)]
    assert part_accuracy(true, true, 50) == 1.0
