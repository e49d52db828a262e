from __future__ import annotations

from dataclasses import FrozenInstanceError
from typing import Any

import numpy as np
import pytest

from zest_rl.errors import BadInput, ZestError, nearest
from zest_rl.types import Episode, EpisodeResult, GroundTruth


def episode(n_steps: int = 3, **changes: Any) -> Episode:
    fields: dict[str, Any] = {
        "obs": np.zeros((n_steps + 1, 5), np.float32),
        "actions": np.zeros((n_steps, 2), np.float32),
        "rewards": np.zeros(n_steps, np.float32),
        "terminated": False,
    }
    return Episode(**{**fields, **changes})


def test_the_length_of_an_episode_is_its_number_of_actions() -> None:
    assert len(episode(7)) == 7


def test_an_episode_cannot_be_changed() -> None:
    with pytest.raises(FrozenInstanceError):
        episode().terminated = True  # type: ignore[misc]


def test_an_episode_without_steps_is_refused() -> None:
    with pytest.raises(BadInput, match="at least 1 step, got 0; drop empty episodes"):
        episode(0)


@pytest.mark.parametrize(
    ("field", "value", "rule"),
    [
        ("obs", np.zeros((3, 5), np.float32), r"obs must have shape \(4, \?\) and dtype float32, got shape \(3, 5\)"),
        ("obs", np.zeros((4, 5)), r"obs must have .* dtype float32, got .* dtype float64"),
        ("obs", np.zeros(4, np.float32), r"obs must have shape \(4, \?\)"),
        ("actions", np.zeros(3, np.float32), r"actions must have shape \(3, \?\)"),
        ("actions", np.zeros((3, 2), np.int64), r"actions must have .* got .* dtype int64"),
        ("rewards", np.zeros(4, np.float32), r"rewards must have shape \(3\) .* got shape \(4,\)"),
        ("rewards", np.zeros((3, 1), np.float32), r"rewards must have shape \(3\)"),
        ("rewards", np.zeros(3), r"rewards must have .* dtype float32, got .* float64"),
    ],
)
def test_a_wrong_shape_or_dtype_is_named_with_what_was_expected(field: str, value: Any, rule: str) -> None:
    with pytest.raises(BadInput, match=rule):
        episode(**{field: value})


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("field", ["obs", "actions", "rewards"])
def test_numbers_that_are_not_finite_are_counted_and_located(field: str, bad: float) -> None:
    array = getattr(episode(), field).copy()
    array[1:3] = bad
    with pytest.raises(BadInput, match=rf"{field} must be finite, but 2 of {len(array)} rows .* first at index 1"):
        episode(**{field: array})


def test_an_episode_holds_no_ground_truth() -> None:
    assert set(Episode.__dataclass_fields__) == {"obs", "actions", "rewards", "terminated"}


def test_the_ground_truth_return_is_summed_in_double_precision() -> None:
    rewards = np.full(100_000, 0.1, np.float32)
    assert GroundTruth(rewards, False).episode_return == pytest.approx(100_000 * float(np.float32(0.1)), rel=1e-12)


def test_an_episode_that_was_not_scored_online_has_no_zest_return() -> None:
    assert EpisodeResult(seed=1, gt_return=2.0, success=True, n_steps=3).zest_return is None


def test_bad_input_is_both_a_zest_error_and_a_value_error() -> None:
    assert issubclass(BadInput, ZestError)
    assert issubclass(BadInput, ValueError)


def test_the_nearest_name_is_suggested_and_all_are_listed() -> None:
    assert nearest("mirco", ["sdoor", "micro"]) == "did you mean 'micro'? valid: micro, sdoor"
    assert nearest("zzzz", ["micro"]) == "valid: micro"
    assert nearest("x", []) == "valid: (none)"
