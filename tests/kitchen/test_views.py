from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from zest_rl.errors import BadInput
from zest_rl.kitchen.env import KitchenEnv
from zest_rl.kitchen.scene import N_QPOS, N_ROBOT_QPOS
from zest_rl.kitchen.tasks import TASKS
from zest_rl.kitchen.views import Views, canonical_states, scene_pair
from zest_rl.simulation.rendering import StateRenderer
from zest_rl.simulation.views import state_keys

VIEWS = Views("micro", n_views=2, size=96, tolerance=1e-2)
MICROWAVE = 22
"""Place of the microwave's joint in qpos."""


@pytest.fixture(scope="module")
def start() -> np.ndarray:
    """(30,) the kitchen's start state, far enough from the grid's edges that the tests' small changes stay within."""
    qpos = KitchenEnv("micro").start_qpos.copy()
    return np.round(qpos / VIEWS.tolerance) * VIEWS.tolerance


@pytest.fixture(scope="module")
def renderer() -> Iterator[StateRenderer]:
    with VIEWS.renderer() as renderer:
        yield renderer


def moved(qpos: np.ndarray, joint: int, by: float) -> np.ndarray:
    other = qpos.copy()
    other[joint] += by
    return other


def keys(states: list[np.ndarray], views: Views = VIEWS) -> list[bytes]:
    return state_keys(canonical_states(np.stack(states), views))


# --- which states are one ---


def test_states_that_agree_after_rounding_share_a_key_and_their_frames_are_equal_bit_for_bit(
    start: np.ndarray, renderer: StateRenderer
) -> None:
    states = [moved(start, MICROWAVE, by) for by in (-0.3, -0.304, -0.296, -0.31)]
    assert keys(states)[0] == keys(states)[1] == keys(states)[2] != keys(states)[3]
    frames = [renderer.render(state) for state in canonical_states(np.stack(states), VIEWS)]
    np.testing.assert_array_equal(frames[0], frames[1])
    np.testing.assert_array_equal(frames[0], frames[2])
    assert (frames[0] != frames[3]).any()
    assert (renderer.render(states[0]) != renderer.render(states[1])).any(), "unrounded, they can be told apart"


def test_a_canonical_state_is_its_own_canonical_state() -> None:
    states = np.random.default_rng(0).normal(size=(50, N_QPOS))
    for tolerance in (0.0, 1e-3, 1e-2, 0.3):
        once = canonical_states(states, Views("micro", tolerance=tolerance))
        assert state_keys(canonical_states(once, Views("micro", tolerance=tolerance))) == state_keys(once)
        assert np.abs(once - states)[:, N_ROBOT_QPOS:].max() <= tolerance / 2 + 1e-12


def test_tolerance_zero_tells_all_different_states_apart(start: np.ndarray) -> None:
    exact = Views("micro", tolerance=0)
    states = [start, moved(start, MICROWAVE, 1e-15), moved(start, MICROWAVE, 0.0)]
    assert keys(states, exact)[0] == keys(states, exact)[2] != keys(states, exact)[1]


def test_the_robots_joints_matter_only_while_it_is_shown(start: np.ndarray) -> None:
    states = [start, *(moved(start, joint, 0.5) for joint in range(N_ROBOT_QPOS))]
    assert len(set(keys(states))) == 1
    shown = Views("micro", robot=True, tolerance=VIEWS.tolerance)
    assert len(set(keys(states, shown))) == len(states)
    np.testing.assert_allclose(canonical_states(states[3][None], shown)[0], states[3], atol=VIEWS.tolerance)


def test_every_joint_of_an_object_matters(start: np.ndarray) -> None:
    states = [start, *(moved(start, joint, 0.5) for joint in range(N_ROBOT_QPOS, N_QPOS))]
    assert len(set(keys(states))) == len(states)


@pytest.mark.parametrize("tolerance", [0.0, 1e-3])
def test_minus_zero_and_zero_are_one_state(tolerance: float) -> None:
    states = [np.zeros(N_QPOS), np.full(N_QPOS, -0.0), np.full(N_QPOS, -tolerance / 10)]
    assert len(set(keys(states, Views("micro", tolerance=tolerance)))) == 1


def test_rounding_leaves_the_given_states_alone(start: np.ndarray) -> None:
    states = np.stack([start])
    canonical_states(states, VIEWS)
    np.testing.assert_array_equal(states[0], start)


# --- which views are one ---


def test_the_fingerprint_names_all_that_a_frame_depends_on() -> None:
    others = [
        Views("sdoor", n_views=2, size=96, tolerance=1e-2),
        Views("micro", n_views=3, size=96, tolerance=1e-2),
        Views("micro", n_views=2, size=64, tolerance=1e-2),
        Views("micro", n_views=2, size=96, tolerance=1e-3),
        Views("micro", n_views=2, size=96, tolerance=1e-2, robot=True),
    ]
    assert len({views.fingerprint() for views in (VIEWS, *others)}) == 1 + len(others)
    assert Views("micro", n_views=2, size=96, tolerance=1e-2).fingerprint() == VIEWS.fingerprint()


def test_the_scene_pair_differs_by_the_tasks_joint_alone(start: np.ndarray, renderer: StateRenderer) -> None:
    before, after = scene_pair(renderer, start, TASKS["micro"])
    assert before.shape == after.shape == (2, 96, 96, 3)
    np.testing.assert_array_equal(before, renderer.render(start))
    opened = start.copy()
    opened[MICROWAVE] = TASKS["micro"].goal
    np.testing.assert_array_equal(after, renderer.render(opened))
    assert (before != after).any(axis=(1, 2, 3)).all(), "every view sees the task"


# --- refusals ---


@pytest.mark.parametrize("tolerance", [-1e-3, float("nan"), float("inf")])
def test_a_tolerance_that_is_no_grid_is_refused(tolerance: float) -> None:
    with pytest.raises(BadInput, match=f"tolerance must be a finite number >= 0 .* got {tolerance}"):
        Views("micro", tolerance=tolerance)


def test_views_of_an_unknown_task_are_refused_with_the_nearest() -> None:
    with pytest.raises(BadInput, match="unknown task 'mirco'; did you mean 'micro'"):
        Views("mirco")


def test_views_without_a_camera_or_a_pixel_are_refused() -> None:
    with pytest.raises(BadInput, match="number of views must be 1 to 1000, got 0"):
        Views("micro", n_views=0).fingerprint()
    with pytest.raises(BadInput, match="size must be 1 to 4096 pixels, got 0"):
        Views("micro", size=0).fingerprint()
