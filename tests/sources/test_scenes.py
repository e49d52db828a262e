"""Scenes of real environments: the robot hidden, and what it moves looked at from a ring of views."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import gymnasium
import numpy as np
import pytest
from read_dataset import read
from rollouts import Episode, Run, as_observed, recorded_state, roll_out, state_of, write_rollouts, write_states

from zest_rl.errors import BadInput
from zest_rl.sources import open_source
from zest_rl.sources.scenes import SceneStates

PUSHED = (0.0, 0.0, 0.05, 0.1, 0.1)  # metres
OPENED = (0.0, 0.0, 0.5, 1.0)  # rad


def staged(env_id: str, moves: tuple[float, ...], move: Callable[[Any, dict[str, np.ndarray], float], None]) -> Episode:
    """An episode whose states are set by hand: the robot moves all the time, the object as `move` says."""
    env: Any = gymnasium.make(env_id)
    observation, _ = env.reset(seed=0)
    bare, start = env.unwrapped, state_of(env)
    states = []
    for step, far in enumerate(moves):
        state = {name: np.array(values) for name, values in start.items()}
        state["qpos"][:4] += 0.03 * step
        move(bare, state, far)
        states.append(state)
    n_steps = len(moves) - 1
    n_actions = env.action_space.shape[0]
    return Episode(
        [observation] * len(moves), [], states, np.zeros((n_steps, n_actions), np.float32), np.zeros(n_steps)
    )


def push(env: Any, state: dict[str, np.ndarray], far: float) -> None:
    state["qpos"][env.model.joint("object0:joint").qposadr[0]] += far


def open_door(env: Any, state: dict[str, np.ndarray], far: float) -> None:
    state["qpos"][env.model.joint("door_hinge").qposadr[0]] += far


def write(dataset_id: str, env_id: str, *episodes: Episode) -> str:
    return write_rollouts(dataset_id, list(episodes), as_observed, env=env_id, infos=recorded_state)


@pytest.fixture
def pushed() -> str:
    """Two episodes of FetchPush, in the second of which the block is pushed."""
    still, moved = (staged("FetchPush-v4", moves, push) for moves in ((0.0, 0.0), PUSHED))
    return write("push/staged-v0", "FetchPush-v4", still, moved)


@pytest.fixture
def opened() -> str:
    """An episode of AdroitHandDoor in which the door opens."""
    return write("door/staged-v0", "AdroitHandDoor-v1", staged("AdroitHandDoor-v1", OPENED, open_door))


def scene_of(dataset: str, **options: Any) -> SceneStates:
    frames = open_source(dataset, **options).frames
    assert isinstance(frames, SceneStates)
    return frames


def test_the_robot_is_hidden_and_what_moves_is_looked_at_from_the_robots_side(pushed: str) -> None:
    scene = scene_of(pushed)
    facts = scene.describe()
    assert (facts["robot"], facts["look_at"]) == (["robot0:mocap", "robot0:base_link"], "object0")
    assert abs(facts["ring"]["azimuth"]) < 30, "degrees: along +x, for the block lies before the robot"
    assert len(scene.views) == 8
    frames = list(scene.read(1))
    assert np.shape(frames) == (len(PUSHED), 8, 224, 224, 3)
    np.testing.assert_array_equal(frames[0], frames[1])
    changed = np.any(np.array(frames[0]) != frames[3], axis=(1, 2, 3))
    assert changed.all(), "every view sees the block move"
    robot = scene_of(pushed, show_robot=True)
    shown = list(robot.read(1))
    assert (np.array(shown[0]) != shown[1]).any(), "the robot moves"
    assert robot.describe()["robot"] == []


def test_equal_states_are_rendered_once_and_the_robot_makes_none_unequal(pushed: str) -> None:
    frames = list(scene_of(pushed).read(1))
    assert [frames[step] is frames[step - 1] for step in range(1, len(PUSHED))] == [True, False, False, True]
    assert scene_of(pushed).liveliest == 1


def test_a_door_stands_where_it_stood_and_is_seen_whole(opened: str) -> None:
    scene = scene_of(opened)
    assert scene.describe()["look_at"] == "door"
    assert scene.states.scenery == ("infos/state/door_body_pos",)
    first = next(iter(scene.read(0)))
    for frame in first:
        assert frame[80:144, 80:144].std() > 5, "the door is in the middle"
    assert scene_of(opened, look_at="latch").describe()["look_at"] == "latch"


def test_a_view_sees_a_share_of_the_object(pushed: str) -> None:
    scene = scene_of(pushed, n_views=3)
    stage, start = scene._stage, scene.states.start(0)
    cameras = scene.ring.cameras(stage.lookat(start, scene.body))
    np.testing.assert_allclose(stage.seen_shares(start, cameras, scene.body), 1, atol=0.02)
    model = stage.simulation.model
    (block,), (table,) = (model.body(name).geomadr for name in ("object0", "table0"))
    sizes = model.geom_size.copy()
    sizes[table, 2] += 2.1 * sizes[block, 2]  # lower than the cameras
    swallowed = {**start, "geom_size": sizes.ravel()}
    assert (stage.seen_shares(swallowed, cameras, scene.body) == 0).all()
    np.testing.assert_allclose(stage.seen_shares(start, cameras, scene.body), 1, atol=0.02)


def test_what_a_state_lacks_is_as_the_environment_made_it_whatever_was_shown_before(pushed: str) -> None:
    scene = scene_of(pushed, n_views=1)
    data = scene._stage.simulation.data
    made = data.mocap_pos.copy()
    scene._stage.lookat({**scene.states.start(0), "mocap_pos": made + 1}, scene.body)
    assert (data.mocap_pos != made).all()
    assert scene_of(pushed, n_views=1) == scene, "the side from which the robot works, too"
    np.testing.assert_array_equal(data.mocap_pos, made)


def test_rewards_come_from_the_scene_and_the_metadata_say_what_was_seen(goal: Path, zest: Run, pushed: str) -> None:
    result = zest("relabel", pushed, "--goal", goal, "--views", "2", "--n-workers", "1")
    assert [view.partition(", ")[2] for view in result["views"]] == ["elevation -15°, 0.20 m", "elevation -20°, 0.14 m"]
    assert result["n_still_frames"] == 2, "the block rests, though the robot moves"
    facts = read(result["dataset"], lambda ds: ds.metadata)["zest"]["relabel"]["frames"]
    assert (facts["kind"], facts["look_at"], facts["scenery_from"]) == ("scene", "object0", [])
    again = zest("relabel", pushed, "--goal", goal, "--views", "2", "--n-workers", "1", "--look-at", "object0")
    assert again["dataset"] == result["dataset"], "named or found, it is the same"


def test_embeddings_depend_on_what_is_seen(pushed: str) -> None:
    scenes = [scene_of(pushed), scene_of(pushed, show_robot=True), scene_of(pushed, n_views=4)]
    scenes += [scene_of(pushed, robot=["robot0:mocap"], look_at="object0"), scene_of(pushed, tolerance=0.0)]
    assert len({scene.digest(1) for scene in scenes}) == len(scenes)


@pytest.mark.parametrize(
    ("env_id", "options", "message"),
    [
        ("FetchReach-v4", {}, "all joints of the model belong to the robot; keep the robot in view"),
        ("FetchReach-v4", {"look_at": "robot0:gripper_link"}, "belongs to the robot, which is hidden; keep it in view"),
        (
            "FetchReach-v4",
            {"robot": ["robot0:gripper"]},
            "--robot: the model has no body 'robot0:gripper'; did you mean",
        ),
        ("FetchReach-v4", {"look_at": "blok"}, "--look-at: the model has no body 'blok'; valid: "),
        ("FetchReach-v4", {"robot": ["table0"], "show_robot": True}, "--robot names bodies that are hidden"),
        ("FetchPush-v4", {"n_views": 0}, "the number of views must be 1 to 1000, got 0"),
    ],
)
def test_what_a_scene_cannot_show_is_refused(env_id: str, options: dict[str, Any], message: str) -> None:
    dataset = write_states("some/random-v0", env_id, roll_out(env_id, (1,)))
    with pytest.raises(BadInput, match=message):
        open_source(dataset, **options)


def test_a_robot_without_an_object_can_be_looked_at_itself() -> None:
    def roll(env: Any, state: dict[str, np.ndarray], far: float) -> None:
        state["qpos"][0] += far

    dataset = write("maze/staged-v0", "PointMaze_UMaze-v3", staged("PointMaze_UMaze-v3", OPENED, roll))
    scene = scene_of(dataset, show_robot=True)
    assert (scene.describe()["look_at"], scene.describe()["robot"]) == ("particle", [])
    frames = list(scene.read(0))
    assert (np.array(frames[0]) != frames[-1]).any()


def test_flags_of_scenes_are_refused_where_there_is_none(pictured: str) -> None:
    with pytest.raises(BadInput, match="--robot and --look-at belong to the ring of views round an object"):
        open_source(pictured, frames=["observations/cameras/top"], robot=["a"], look_at="b")


def test_an_environment_that_the_dataset_cannot_name_is_made_by_a_function_that_the_user_names(
    pushed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code = 'import gymnasium\nimport gymnasium_robotics\n\ndef push():\n    return gymnasium.make("FetchPush-v4")\n'
    (tmp_path / "makes_push.py").write_text(code, encoding="utf-8")
    scene = scene_of(pushed, env="makes_push:push", n_views=1)
    assert (scene.describe()["look_at"], scene.describe()["env_id"]) == ("object0", "makes_push:push")
    np.testing.assert_array_equal(next(iter(scene.read(1))), next(iter(scene_of(pushed, n_views=1).read(1))))
    with pytest.raises(BadInput, match=r"makes_push \(.*\) has no function 'pull'; did you mean 'push'"):
        open_source(pushed, env="makes_push:pull")
    with pytest.raises(BadInput, match=r"--env must be package\.module:make"):
        open_source(pushed, env="FetchPush-v4")
