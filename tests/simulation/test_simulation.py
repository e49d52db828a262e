"""A toy model, no kitchen: a slider and a hinge that lifts a coupled block, drawn from a ring of views."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import imageio.v2 as imageio
import mujoco
import numpy as np
import pytest

from zest_rl.errors import BadInput
from zest_rl.simulation.rendering import Camera, StateRenderer, in_sight
from zest_rl.simulation.scene import Scene, compile_for_drawing
from zest_rl.simulation.videos import write_mp4
from zest_rl.simulation.views import each_once, on_grid, ring

TOY = """
<mujoco>
  <worldbody>
    <light pos="0 -1 3"/>
    <body name="robot"><joint name="arm" type="hinge" axis="0 0 1"/><geom size=".05"/></body>
    <body pos=".2 0 0"><joint name="slider" type="slide" axis="1 0 0"/><geom type="box" size=".1 .1 .1"/></body>
    <body pos="-.3 0 0"><joint name="block" type="slide" axis="0 0 1"/><geom type="box" size=".05 .05 .05"/></body>
  </worldbody>
  <equality><joint joint1="slider" joint2="block" polycoef="0 2 0 0 0"/></equality>
</mujoco>
"""
ROUND = {"azimuths": (0.0, 90.0), "distances": (1.0, 2.0), "elevations": (-20.0,)}


@pytest.fixture(scope="module")
def scene() -> Scene:
    """The toy without its robot: of a state (arm, slider, block) the last two are drawn."""
    spec = mujoco.MjSpec.from_string(TOY)
    spec.delete(spec.body("robot"))
    return Scene(compile_for_drawing(spec, size=48), n_qpos=3, visible=slice(1, 3))


@pytest.fixture(scope="module")
def renderer(scene: Scene) -> Iterator[StateRenderer]:
    with StateRenderer(scene, ring((0.0, 0.0, 0.0), 3, **ROUND), size=48) as opened:
        yield opened


def test_frames_show_what_is_left_in_the_scene_and_nothing_else(renderer: StateRenderer) -> None:
    frames = renderer.render(np.array([0.0, 0.1, 0.0]))
    assert frames.shape == (3, 48, 48, 3)
    np.testing.assert_array_equal(renderer.render(np.array([1.0, 0.1, 0.0])), frames, "the arm is not there")
    assert (renderer.render(np.array([0.0, 0.2, 0.0])) != frames).any(axis=(1, 2, 3)).all()


def test_what_is_coupled_to_a_joint_moves_along(scene: Scene) -> None:
    state = np.array([0.5, 0.0, 0.0])
    np.testing.assert_allclose(scene.with_joint(state, "slider", 0.4), [0.5, 0.4, 0.2])
    np.testing.assert_array_equal(state, [0.5, 0.0, 0.0])


@pytest.mark.parametrize("qpos", [np.zeros(2), np.zeros((1, 3))])
def test_a_state_of_another_length_is_refused(renderer: StateRenderer, qpos: np.ndarray) -> None:
    with pytest.raises(BadInput, match=r"qpos must have shape \(3,\), one state of the model"):
        renderer.render(qpos)


def test_a_ring_spreads_azimuths_and_takes_distances_and_elevations_in_turn() -> None:
    cameras = ring((1.0, 2.0, 3.0), 3, **ROUND)
    assert [camera.azimuth for camera in cameras] == [0, 45, 90]
    assert [camera.distance for camera in cameras] == [1, 2, 1]
    assert {(camera.lookat, camera.elevation) for camera in cameras} == {((1.0, 2.0, 3.0), -20.0)}
    assert ring((0.0, 0.0, 0.0), 1, **ROUND)[0].azimuth == 45


def test_a_camera_without_a_distance_or_with_nan_is_refused() -> None:
    for lookat, distance in (((0.0, 0.0, 0.0), 0.0), ((0.0, float("nan"), 0.0), 1.0)):
        with pytest.raises(BadInput, match="finite numbers and a distance above 0 m"):
            Camera(lookat, distance, 0.0, 0.0)


@pytest.mark.parametrize(
    ("centre", "seen"),
    [
        ((2, 0, 0), True),
        ((0, 0, 0), True),  # around the eye
        ((-1, 0, 0), False),
        ((2, 2.6, 0), True),  # at 45° the frame ends at y = ±2
        ((2, -2.6, 0), True),
        ((2, 2.9, 0), False),
        ((2, -2.9, 0), False),
        ((2, 0, 1.5), True),  # and at z = -2 and z = 1
        ((2, 0, 1.7), False),
        ((2, 0, -2.6), True),
        ((2, 0, -2.9), False),
    ],
)
def test_a_camera_sees_spheres_that_reach_into_its_frame(centre: tuple[float, ...], seen: bool) -> None:
    camera = mujoco.MjvGLCamera()
    camera.forward[:], camera.up[:] = (1, 0, 0), (0, 0, 1)
    camera.frustum_near, camera.frustum_bottom, camera.frustum_top, camera.frustum_width = 0.1, -0.1, 0.05, 0.1
    assert in_sight(camera, np.array([centre]), np.array([0.5])) == seen
    camera.orthographic = 1
    assert in_sight(camera, np.array([centre]), np.array([0.5])), "nothing is left out where no sight is a pyramid"


def test_a_geom_that_was_enlarged_is_seen_as_far_as_it_reaches(scene: Scene) -> None:
    up = Camera((0.0, 0.0, 3.0), 1.0, 90.0, 0.0)  # looks over both blocks
    with StateRenderer(scene, (up,), size=48) as renderer:
        assert renderer.render(np.zeros(3)).max() == 0
        scene.model.geom_size[0, 2], before = 4, scene.model.geom_size[0, 2]
        assert renderer.render(np.zeros(3)).max() > 0
        scene.model.geom_size[0, 2] = before


def test_states_on_a_grid_keep_what_is_visible_and_appear_once_in_their_order() -> None:
    states = on_grid(np.array([[9.0, 0.24], [8.0, 0.26], [7.0, -0.01], [6.0, 0.2]]), slice(1, 2), 0.1)
    np.testing.assert_allclose(states, [[0, 0.2], [0, 0.3], [0, 0], [0, 0.2]])
    np.testing.assert_allclose(each_once(states), [[0, 0.2], [0, 0.3], [0, 0]])


def test_a_video_is_written_whole_or_not_at_all(renderer: StateRenderer, tmp_path: Path) -> None:
    frames = [renderer.render(np.array([0.0, share, 0.0]))[0] for share in (0.0, 0.1, 0.2)]
    write_mp4(tmp_path / "toy.mp4", frames, fps=10)
    assert len(imageio.mimread(tmp_path / "toy.mp4")) == 3
    with pytest.raises(ValueError, match="same"):
        write_mp4(tmp_path / "odd.mp4", [frames[0], frames[1][:24]], fps=10)
    assert [path.name for path in tmp_path.iterdir()] == ["toy.mp4"]
