"""Frames of the real kitchen: what they show, that they repeat, and what is refused."""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from zest_rl.errors import BadInput
from zest_rl.kitchen.env import KitchenEnv
from zest_rl.kitchen.scene import (
    N_QPOS,
    N_ROBOT_QPOS,
    RenderConfig,
    gl_backend,
    open_renderer,
    relevant_qpos,
    task_cameras,
)
from zest_rl.kitchen.tasks import RING, TASKS, Task
from zest_rl.runtime.artifacts import hash_arrays
from zest_rl.runtime.gl import select_gl_backend
from zest_rl.simulation import rendering
from zest_rl.simulation.framing import hidden_views, object_geoms, seen_shares
from zest_rl.simulation.rendering import Camera, Canvas, StateRenderer

KITCHEN_XML = Path("envs", "assets", "kitchen_franka", "kitchen_assets", "kitchen_env_model.xml")
OVERVIEW = Camera(lookat=(-0.2, 0.4, 2.0), distance=2.0, azimuth=70.0, elevation=-30.0)  # kitchen and robot
HASH_FRAMES = """
import numpy as np
from zest_rl.kitchen.scene import *
from zest_rl.runtime.artifacts import hash_arrays
with open_renderer(RenderConfig(size=64), task_cameras(TASKS["micro"], 3)) as renderer:
    print(select_gl_backend(), hash_arrays(renderer.render(np.zeros(N_QPOS))))
"""


def kitchen_xml() -> Path:
    package = importlib.util.find_spec("gymnasium_robotics")
    assert package is not None
    assert package.origin is not None
    return Path(package.origin).parent / KITCHEN_XML


@pytest.fixture(scope="module")
def physics() -> mujoco.MjModel:
    """The model that the simulator steps."""
    return mujoco.MjModel.from_xml_path(str(kitchen_xml()))


@pytest.fixture(scope="module")
def start(physics: mujoco.MjModel) -> NDArray[np.float64]:
    """The kitchen with everything closed and the robot at rest, (30,)."""
    return np.array(physics.key_qpos[0])


@pytest.fixture(scope="module")
def renderer() -> Iterator[StateRenderer]:
    with open_renderer(RenderConfig(size=64), task_cameras(TASKS["micro"], 3)) as opened:
        yield opened


def psnr(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.astype(float) - b) ** 2)))


def in_another_process(environ: dict[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    inherited = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    return subprocess.run(
        [sys.executable, "-c", HASH_FRAMES], env=inherited | (environ or {}), capture_output=True, text=True, timeout=60
    )


def test_the_qpos_layout_is_the_one_of_the_physics_model(physics: mujoco.MjModel) -> None:
    robot = [physics.joint(i).qposadr[0] for i in range(physics.njnt) if physics.joint(i).name.startswith("robot:")]
    assert physics.nq == N_QPOS
    assert robot == list(range(N_ROBOT_QPOS))


def test_one_view_is_frontal() -> None:
    (camera,) = task_cameras(TASKS["micro"], 1)
    assert camera.azimuth == 90
    assert camera.lookat == TASKS["micro"].lookat


@pytest.mark.parametrize("n_views", [2, 3, 8, 30])
def test_a_ring_spreads_its_views(n_views: int) -> None:
    cameras = task_cameras(TASKS["knob3"], n_views)
    azimuths = [camera.azimuth for camera in cameras]
    assert len(set(cameras)) == n_views
    assert (azimuths[0], azimuths[-1]) == (60, 120)
    np.testing.assert_allclose(np.diff(azimuths), 60 / (n_views - 1))
    assert len({camera.distance for camera in cameras}) == min(n_views, 3)
    assert {camera.elevation for camera in cameras} == set(TASKS["knob3"].elevations)


def test_a_ring_without_views_is_refused() -> None:
    with pytest.raises(BadInput, match="must be 1 to 1000, got 0"):
        task_cameras(TASKS["micro"], 0)


def test_there_is_one_rgb_frame_per_camera(renderer: StateRenderer, start: NDArray[np.float64]) -> None:
    frames = renderer.render(start)
    assert frames.shape == (3, 64, 64, 3)
    assert frames.dtype == np.uint8
    assert len({hash_arrays(frame) for frame in frames}) == 3


def test_frames_are_upright(start: NDArray[np.float64]) -> None:
    from_above = Camera(lookat=(-0.3, 0.5, 1.8), distance=3.0, azimuth=90.0, elevation=-20.0)
    with open_renderer(RenderConfig(size=64), (from_above,)) as renderer:
        (frame,) = renderer.render(start)
    assert frame[0].max() == 0, "above the kitchen there is nothing"
    assert frame[-1].min() > 0, "below it is the floor"


@pytest.mark.parametrize("task", TASKS.values(), ids=list(TASKS))
def test_every_view_of_a_task_shows_its_part_moving(
    task: Task, physics: mujoco.MjModel, start: NDArray[np.float64]
) -> None:
    with open_renderer(RenderConfig(size=112), task_cameras(task, 8)) as renderer:
        moved = renderer.scene.with_joint(start, task.joint, task.goal)
        change = np.abs(renderer.render(moved).astype(int) - renderer.render(start)).max(axis=-1) > 20
    assert moved[physics.joint(task.joint).qposadr[0]] == task.goal
    for equality in range(physics.neq):  # the burner rises with its knob
        knob, burner = physics.eq_obj1id[equality], physics.eq_obj2id[equality]
        if knob == physics.joint(task.joint).id:
            risen = moved[physics.jnt_qposadr[burner]]
            np.testing.assert_allclose(physics.eq_data[equality, 1] * risen, task.goal, rtol=1e-9)
    enough = 0.0003 if task.name == "knob2" else 0.001  # of the burner a kettle leaves a sliver
    assert (change.mean(axis=(1, 2)) > enough).all(), "share of pixels that change, per view"
    assert not change[:, 0].any(), "the moving part stays below the upper edge"


@pytest.mark.parametrize("task", TASKS.values(), ids=list(TASKS))
def test_the_views_that_are_left_out_are_those_from_which_the_scene_hides_what_moves(
    task: Task,
) -> None:
    whole = task_cameras(dataclasses.replace(task, seen_from=RING), 8)
    with open_renderer(RenderConfig(), whole) as renderer:
        model = renderer.scene.model
        start = KitchenEnv(task.name).start_qpos
        moved = renderer.scene.with_joint(start, task.joint, max(model.joint(task.joint).range, key=abs))
        data = mujoco.MjData(model)
        data.qpos[:] = moved[N_ROBOT_QPOS:]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        turns = model.joint(task.joint).id
        coupled = model.eq_obj2id[(model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & (model.eq_obj1id == turns)]
        moving = model.jnt_bodyid[[turns, *coupled]]
        looked_at = moving[np.linalg.norm(data.xpos[moving] - task.lookat, axis=1).argmin()]
        canvas = Canvas(model, tuple(camera.to_mujoco() for camera in whole), 224)
        try:
            shares = seen_shares(canvas, model, data, object_geoms(model, looked_at))
        finally:
            canvas.close()
    hidden = hidden_views(shares)
    assert task_cameras(task, 8) == tuple(view for i, view in enumerate(whole) if i not in hidden)
    assert hidden == ((0, 1, 2, 3) if task.name == "knob2" else ()), "a kettle stands on the burner of knob2"


@pytest.mark.parametrize("n_views", [1, 2, 3, 8, 30])
def test_no_view_is_from_where_the_part_is_hidden_and_one_is_left_of_any_ring(n_views: int) -> None:
    cameras = task_cameras(TASKS["knob2"], n_views)
    assert cameras
    assert all(92 <= camera.azimuth <= 120 for camera in cameras)


def test_the_views_of_before_are_kept_under_their_version() -> None:
    before = task_cameras(TASKS["knob2"], 8, framing=1)
    assert [camera.azimuth for camera in before] == list(np.linspace(60, 120, 8))
    assert {(camera.lookat, camera.elevation) for camera in before} == {((-0.22, 0.5, 2.12), up) for up in (-20, -35)}
    for task in TASKS.values():
        assert (task_cameras(task, 8, framing=1) == task_cameras(task, 8)) == (task.name != "knob2")
    with pytest.raises(BadInput, match="framing of the kitchen's views must be 1 to 2, got 3"):
        task_cameras(TASKS["knob2"], 8, framing=3)


def test_frames_repeat_bitwise_in_another_renderer_and_another_process(start: NDArray[np.float64]) -> None:
    digests = set()
    for _ in range(2):
        with open_renderer(RenderConfig(size=64), task_cameras(TASKS["micro"], 3)) as renderer:
            renderer.render(start)
            digests.add(hash_arrays(renderer.render(np.zeros(N_QPOS))))
    other = in_another_process()
    assert other.returncode == 0, other.stderr
    assert digests == {other.stdout.split()[1]}


@pytest.mark.parametrize("task", TASKS.values(), ids=list(TASKS))
def test_what_is_out_of_sight_is_left_out_and_changes_no_pixel(
    task: Task, start: NDArray[np.float64], monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_renderer(RenderConfig(), task_cameras(task, 3)) as renderer:
        states = start, renderer.scene.with_joint(start, task.joint, task.goal)
        frames = [renderer.render(state) for state in states]
        in_sight, n_seen = rendering.in_sight, list[int]()

        def everything(*scene: Any) -> NDArray[np.bool_]:
            seen = in_sight(*scene)
            n_seen.append(int(seen.sum()))
            return np.ones_like(seen)

        monkeypatch.setattr(rendering, "in_sight", everything)
        np.testing.assert_array_equal(frames, [renderer.render(state) for state in states])
    assert min(n_seen) > 0
    assert max(n_seen) < renderer.scene.model.ngeom


def test_two_renderers_can_draw_in_turn(renderer: StateRenderer, start: NDArray[np.float64]) -> None:
    alone = renderer.render(start)
    with open_renderer(RenderConfig(size=32), (OVERVIEW,)) as other:
        small = other.render(start)
        np.testing.assert_array_equal(renderer.render(start), alone)
        np.testing.assert_array_equal(other.render(start), small)
    np.testing.assert_array_equal(renderer.render(start), alone)


def test_a_hidden_robot_leaves_no_trace_and_a_shown_one_does(start: NDArray[np.float64]) -> None:
    moved = start.copy()
    moved[:N_ROBOT_QPOS] += 0.3
    robot_in_view, robot_behind = OVERVIEW, task_cameras(TASKS["ldoor"], 1)[0]
    seen = {}
    for robot in (False, True):
        with open_renderer(RenderConfig(size=96, robot=robot), (robot_in_view, robot_behind)) as renderer:
            seen[robot] = renderer.render(start), renderer.render(moved)
    np.testing.assert_array_equal(*seen[False])
    assert (seen[True][0][0] != seen[True][1][0]).any(), "a shown robot moves"
    assert (seen[True][0][0] != seen[False][0][0]).any(), "a hidden robot is not seen"
    np.testing.assert_array_equal(seen[True][0][1], seen[False][0][1], "hiding it changes nothing else")


def test_a_frame_depends_on_the_objects_and_on_a_robot_that_is_shown() -> None:
    assert relevant_qpos(RenderConfig()) == slice(9, 30)
    assert relevant_qpos(RenderConfig(robot=True)) == slice(0, 30)


def test_a_decimated_robot_looks_like_the_whole_one(start: NDArray[np.float64]) -> None:
    frames = []
    for fraction in (0.1, 1.0):
        with open_renderer(RenderConfig(robot=True, mesh_fraction=fraction), (OVERVIEW,)) as renderer:
            frames.append(renderer.render(start))
    assert (frames[0] != frames[1]).any()
    assert psnr(*frames) >= 30


@pytest.mark.parametrize("shape", [(29,), (31,), (1, 30), ()])
def test_a_state_of_the_wrong_shape_is_refused(renderer: StateRenderer, shape: tuple[int, ...]) -> None:
    with pytest.raises(BadInput, match=r"qpos must have shape \(30,\)"):
        renderer.render(np.zeros(shape))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_state_that_is_not_finite_is_refused(renderer: StateRenderer, value: float) -> None:
    qpos = np.zeros(N_QPOS)
    qpos[[3, 22]] = value
    with pytest.raises(BadInput, match=r"finite, got NaN or infinity at entries \[3, 22\]"):
        renderer.render(qpos)


def test_a_renderer_without_cameras_is_refused() -> None:
    with pytest.raises(BadInput, match="at least 1 camera"):
        open_renderer(RenderConfig(), ())


@pytest.mark.parametrize(
    ("change", "message"),
    [({"size": 0}, "must be 1 to 4096 pixels, got 0"), ({"mesh_fraction": 0.0}, r"in \(0, 1\], got 0")],
)
def test_a_config_out_of_range_is_refused(change: dict[str, float], message: str) -> None:
    with pytest.raises(BadInput, match=message):
        dataclasses.replace(RenderConfig(), **change)


def test_a_camera_inside_its_object_is_refused() -> None:
    with pytest.raises(BadInput, match="distance above 0 m"):
        dataclasses.replace(OVERVIEW, distance=0.0)


def test_the_fingerprint_follows_what_changes_frames_and_nothing_else() -> None:
    hidden, shown = RenderConfig(), RenderConfig(robot=True)
    assert hidden.fingerprint() == RenderConfig(mesh_fraction=0.5).fingerprint()
    different = [hidden, shown, RenderConfig(size=96), RenderConfig(robot=True, mesh_fraction=0.5)]
    assert len({config.fingerprint() for config in different}) == len(different)


def test_the_working_gl_backend_is_named_and_kept_for_others() -> None:
    name = gl_backend()
    assert name == os.environ["MUJOCO_GL"] == select_gl_backend()


def test_without_egl_osmesa_draws_the_same_frames_or_the_missing_packages_are_named(start: NDArray[np.float64]) -> None:
    with_egl = in_another_process()
    without_egl = in_another_process({"__EGL_VENDOR_LIBRARY_DIRS": os.devnull})
    if without_egl.returncode == 0:
        assert without_egl.stdout.split()[0] == "osmesa"
        assert with_egl.stdout.split()[1] == without_egl.stdout.split()[1]
    else:
        assert "apt-get install libegl1 libgl1 libosmesa6" in without_egl.stderr


def test_a_gl_backend_chosen_by_the_user_is_not_replaced() -> None:
    refused = in_another_process({"MUJOCO_GL": "off"})
    assert refused.returncode != 0
    assert "ZestError: the GL backend 'off' does not work" in refused.stderr
