"""Recorded simulator states of real environments, rendered and relabeled."""

from __future__ import annotations

import copy
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import gymnasium
import h5py
import mujoco
import numpy as np
import pytest
from gymnasium_robotics.utils import mujoco_utils
from read_dataset import read
from rollouts import (
    LENGTHS,
    Episode,
    Run,
    as_observed,
    check_kept_but_the_rewards,
    roll_out,
    state_of,
    write_rollouts,
    write_states,
)

from zest_rl import cli
from zest_rl.data import reader
from zest_rl.errors import BadInput, Notice
from zest_rl.sources import open_source
from zest_rl.sources.stage import stage_of
from zest_rl.types import Frame


def rendered(env_id: str, camera: str | None, episode: Episode, seed: int) -> list[Frame]:
    """The same states in an environment of their own, through Gymnasium's own renderer."""
    chosen = {} if camera is None else {"camera_name": camera}
    env: Any = gymnasium.make(env_id, render_mode="rgb_array", width=224, height=224, **chosen)
    bare = env.unwrapped
    bare.model.vis.quality.shadowsize = bare.model.vis.quality.offsamples = 0
    env.reset(seed=seed)
    env.render()
    inner = next((part for name in ("point_env", "ant_env", "robot_env") if (part := getattr(bare, name, None))), bare)
    flags = inner.mujoco_renderer.viewer.scn.flags
    for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION, mujoco.mjtRndFlag.mjRND_SKYBOX):
        flags[flag] = False
    frames = []
    for state in episode.state:  # after a step, Gymnasium shows positions of one substep before
        bare.data.qpos[:] = state["qpos"]
        mujoco.mj_forward(bare.model, bare.data)
        if bare.model.nmocap:  # Fetch's gripper is pulled along by one
            mujoco_utils.reset_mocap2body_xpos(bare.model, bare.data)
        frames.append(env.render())
    env.close()
    return frames


@pytest.mark.parametrize(
    "env_id",
    [
        "AdroitHandPen-v1",
        "AdroitHandDoor-v1",
        "FetchReach-v4",
        "PointMaze_UMaze-v3",
        "AntMaze_UMaze-v5",
        "HalfCheetah-v5",
        "Humanoid-v5",
        "Reacher-v5",
        "FrankaKitchen-v1",
    ],
)
def test_without_a_camera_frames_are_those_that_the_environment_renders(env_id: str) -> None:
    (episode,) = roll_out(env_id, (3,))
    source = open_source(write_states("some/random-v0", env_id, [episode]), cameras=["default"])
    ours = [views[0] for views in source.frames.read(0)]
    np.testing.assert_array_equal(ours, rendered(env_id, None, episode, seed=0))
    assert max(np.std(frame) for frame in ours) > 10, "it shows something"


def test_a_process_that_has_made_no_environment_yet_renders_one(maze: list[Episode]) -> None:
    dataset = write_states("maze/random-v0", "PointMaze_UMaze-v3", maze[:1])
    code = "from zest_rl.sources import open_source; print(len(list(open_source(f, cameras=c).frames.read(0))))"
    given = f"f, c = {dataset!r}, ['default']"
    done = subprocess.run([sys.executable, "-c", f"{given}; {code}"], capture_output=True, text=True)
    assert done.stdout == f"{LENGTHS[0] + 1}\n", done.stderr


def test_the_environments_own_camera_stays_where_it_stood_at_first_and_embeddings_depend_on_it() -> None:
    episodes = roll_out("HalfCheetah-v5", (2, 2))
    both = open_source(write_states("cheetah/both-v0", "HalfCheetah-v5", episodes), cameras=["default"]).frames
    last = open_source(write_states("cheetah/last-v0", "HalfCheetah-v5", episodes[1:]), cameras=["default"]).frames
    assert both.describe()["camera_pose"][1] == 4.0, "metres, of the environment's default_camera_config"
    assert both.describe()["camera_pose"] != last.describe()["camera_pose"]
    assert both.digest(1) != last.digest(0), "the same states, seen from elsewhere"
    cameras = [open_source(f"cheetah/{name}-v0", cameras=["track"]).frames for name in ("both", "last")]
    assert cameras[0].digest(1) == cameras[1].digest(0)


def test_states_are_rendered_as_the_environment_itself_shows_them_with_the_door_where_it_stood(
    goal: Path, zest: Run, refusal: Callable[..., tuple[int, str]]
) -> None:
    door = roll_out("AdroitHandDoor-v1", (2, 2))
    dataset = write_states("door/random-v0", "AdroitHandDoor-v1", door)
    source = open_source(dataset, cameras=["fixed"])
    for i, episode in enumerate(door):
        ours = [views[0] for views in source.frames.read(i)]
        theirs = rendered("AdroitHandDoor-v1", "fixed", episode, seed=i)
        np.testing.assert_array_equal(ours, theirs)
    assert (ours[0] != next(iter(source.frames.read(0)))[0]).any(), "the doors of two episodes stand elsewhere"
    result = zest("relabel", dataset, "--goal", goal, "--camera", "fixed", "vil_camera", "--n-workers", "1")
    assert result["views"] == ["fixed", "vil_camera"]
    check_kept_but_the_rewards(dataset, result["dataset"])
    facts = read(result["dataset"], lambda ds: ds.metadata)["zest"]["relabel"]["frames"]
    assert facts["qpos_from"] == [["infos/state/qpos", 0, None]]
    assert facts["scenery_from"] == ["infos/state/door_body_pos"]
    code, error = refusal("relabel", dataset, "--goal", goal, "--camera", "fixd")
    assert (code, "has no camera 'fixd'; did you mean 'fixed'?" in error) == (2, True)
    with h5py.File(reader.dataset_path(dataset) / reader.DATA_FILE, "r+") as file:
        del file["episode_0/infos/state/door_body_pos"]
    code, error = refusal("relabel", dataset, "--goal", goal, "--camera", "default")
    assert (code, "lacks infos/state/door_body_pos" in error) == (2, True)


def test_the_target_of_fetch_is_where_the_goal_is_and_its_joints_must_be_recorded(
    goal: Path, zest: Run, refusal: Callable[..., tuple[int, str]]
) -> None:
    fetch = roll_out("FetchReach-v4", (2,))
    dataset = write_states("fetch/random-v0", "FetchReach-v4", fetch)
    frames = [views[0] for views in open_source(dataset, cameras=["default"]).frames.read(0)]
    red = np.stack(frames).astype(int)
    assert ((red[..., 0] > 150) & (red[..., 1] < 60) & (red[..., 2] < 60)).any(axis=(1, 2)).all(), "the target is red"
    assert zest("relabel", dataset, "--goal", goal, "--camera", "default", "--n-workers", "1")["n_still_frames"] == 0
    blind = write_states("fetch/blind-v0", "FetchReach-v4", fetch, with_state=False)
    code, error = refusal("relabel", blind, "--goal", goal, "--camera", "default")
    assert code == 2
    assert "observations of FetchReach-v4 do not hold it to the bit. Record infos/state/qpos, or give --frames" in error


EXACT = {"robot_noise_ratio": 0.0, "object_noise_ratio": 0.0}


@pytest.mark.parametrize(
    ("env_id", "kwargs"),
    [
        ("PointMaze_UMaze-v3", {}),
        ("AntMaze_UMaze-v5", {}),
        ("Ant-v5", {}),
        ("HalfCheetah-v5", {}),
        ("Hopper-v5", {}),
        ("Humanoid-v5", {}),
        ("HumanoidStandup-v5", {}),
        ("InvertedPendulum-v5", {}),
        ("Swimmer-v5", {}),
        ("Swimmer-v5", {"exclude_current_positions_from_observation": False}),
        ("Walker2d-v5", {}),
        ("FrankaKitchen-v1", EXACT),
    ],
)
def test_qpos_is_read_from_observations_where_they_hold_it_to_the_bit(env_id: str, kwargs: dict[str, Any]) -> None:
    frames, qpos = observed_alone(env_id, **kwargs)
    np.testing.assert_array_equal(frames.read_states(0)["qpos"], qpos)
    assert not frames.describe()["qpos_is_noisy"]


def test_the_kitchens_noisy_positions_are_shown_and_told(goal: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frames, qpos = observed_alone("FrankaKitchen-v1")
    assert 0 < np.abs(frames.read_states(0)["qpos"] - qpos).max() <= 0.001
    assert frames.describe()["qpos_is_noisy"]
    assert len(list(frames.read(0))) == len(qpos)
    assert cli.main(["relabel", "some/random-v0", "--goal", str(goal), "--camera", "default", "--n-workers", "1"]) == 0
    err = capsys.readouterr().err
    warning = "warning: states are read from observations that the environment blurred"
    assert 0 <= err.find(warning) < err.index("embedding frames: 100/100"), "told before the work"


def test_an_environment_made_with_a_camera_of_its_model_is_seen_from_that() -> None:
    frames, _ = observed_alone("HalfCheetah-v5", camera_name="track")
    assert frames.describe()["camera_pose"] is None
    named: Any = open_source("some/random-v0", cameras=["track"]).frames
    for own, by_name in zip(frames.read(0), named.read(0), strict=True):
        np.testing.assert_array_equal(own[0], by_name[0])


def observed_alone(env_id: str, **kwargs: Any) -> tuple[Any, np.ndarray]:
    """Frames of a dataset without recorded states, and the states (T+1, nq) of its only episode."""
    env: Any = gymnasium.make(env_id, **kwargs)
    env.action_space.seed(0)
    observation, info = env.reset(seed=0)
    observations, infos, state, actions = [observation], [info], [state_of(env)], []
    for _ in range(3):
        actions.append(env.action_space.sample())
        observation, _, _, _, info = env.step(actions[-1])
        observations.append(copy.deepcopy(observation))
        infos.append(info)
        state.append(state_of(env))
    episode = Episode(observations, [], state, np.array(actions), np.zeros(3))
    kept = {name: np.array([info[name] for info in infos]) for name in infos[0] if name in ("x_position", "y_position")}
    dataset = write_rollouts("some/random-v0", [episode], as_observed, env=env.spec, infos=lambda _: kept)
    return open_source(dataset, cameras=["default"]).frames, np.array([one["qpos"] for one in state])


@pytest.mark.parametrize(
    "trap", ["evil.envs.maze:PointMazeEnv", "zest_rl.cli:main", "gymnasium.envs.registration:make"]
)
def test_code_that_is_not_the_registered_environments_is_not_run(
    trap: str, maze: list[Episode], goal: Path, refusal: Callable[..., tuple[int, str]]
) -> None:
    dataset = write_states("maze/random-v0", "PointMaze_UMaze-v3", maze[:1])
    edit_spec(dataset, entry_point=trap)
    code, error = refusal("relabel", dataset, "--goal", goal, "--camera", "default")
    assert (code, f"would run code of {trap!r}" in error) == (2, True)


def edit_spec(dataset: str, **changes: Any) -> None:
    path = reader.dataset_path(dataset) / reader.METADATA_FILE
    metadata = json.loads(path.read_text())
    spec = json.loads(metadata.get("env_spec") or gymnasium.spec("PointMaze_UMaze-v3").to_json())
    metadata["env_spec"] = json.dumps(spec | changes)
    path.write_text(json.dumps(metadata))


@pytest.mark.parametrize("entry_point", ["ale_py.env:AtariEnv", "my_robot.envs:MyRobotEnv"])
def test_pictures_of_any_environment_are_taken_for_it_is_never_built(
    entry_point: str,
    pictured: str,
    maze: list[Episode],
    goal: Path,
    zest: Run,
    refusal: Callable[..., tuple[int, str]],
    tmp_path: Path,
) -> None:
    edit_spec(pictured, id="Robot-v0", entry_point=entry_point)
    made = zest("relabel", pictured, "--goal", goal, "--frames", "cameras/top", "--n-workers", "1")["dataset"]
    assert zest("inspect", made, "--output", tmp_path / "page.html")["datasets"].keys() == {made}
    assert zest("export", made, "--output", tmp_path / "maze.npz")["n_transitions"] == sum(LENGTHS)
    states = write_states("maze/random-v0", "PointMaze_UMaze-v3", maze)
    edit_spec(states, id="Robot-v0", entry_point=entry_point)
    code, error = refusal("relabel", states, "--goal", goal, "--camera", "default")
    assert (code, f"would run code of {entry_point!r}; only gymnasium.*" in error) == (2, True)
    assert "are trusted; give --frames FOLDER" in error


def test_an_env_spec_that_is_none_is_refused(
    maze: list[Episode], goal: Path, refusal: Callable[..., tuple[int, str]]
) -> None:
    dataset = write_states("maze/random-v0", "PointMaze_UMaze-v3", maze[:1])
    edit_spec(dataset, unheard_of=1)
    code, error = refusal("relabel", dataset, "--goal", goal, "--camera", "default")
    assert (code, "env_spec is not the JSON of a Gymnasium EnvSpec" in error) == (2, True)


def test_wrapped_observations_are_not_taken_for_the_state_and_wrappers_are_not_run(
    maze: list[Episode], goal: Path, refusal: Callable[..., tuple[int, str]]
) -> None:
    wrapper = {"name": "Trap", "entry_point": "gymnasium.envs.registration:make", "kwargs": {"id": "CartPole-v1"}}
    for with_state in (False, True):
        dataset = write_states(f"maze/state-{with_state}-v0", "PointMaze_UMaze-v3", maze[:1], with_state=with_state)
        edit_spec(dataset, additional_wrappers=[wrapper])
    code, error = refusal("relabel", "maze/state-False-v0", "--goal", goal, "--camera", "default")
    assert (code, "wrappers (Trap) may have changed the observations of PointMaze_UMaze-v3" in error) == (2, True)
    assert len(list(open_source("maze/state-True-v0", cameras=["default"]).frames.read(0))) == LENGTHS[0] + 1


def test_wrappers_of_other_packages_are_left_out_where_the_state_is_recorded(maze: list[Episode]) -> None:
    dataset = write_states("maze/wrapped-v0", "PointMaze_UMaze-v3", maze[:1], with_state=True)
    edit_spec(dataset, additional_wrappers=[{"name": "Theirs", "entry_point": "their_package:Wrapper", "kwargs": {}}])
    assert len(list(open_source(dataset, cameras=["default"]).frames.read(0))) == LENGTHS[0] + 1
    edit_spec(dataset, additional_wrappers=None)
    assert len(list(open_source(dataset, cameras=["default"]).frames.read(0))) == LENGTHS[0] + 1


def test_targets_that_only_a_renderer_places_are_refused(goal: Path, refusal: Callable[..., tuple[int, str]]) -> None:
    dataset = write_states("hand/random-v0", "HandReach-v3", roll_out("HandReach-v3", (1,)))
    code, error = refusal("relabel", dataset, "--goal", goal, "--camera", "default")
    assert (code, "places targets only while it renders" in error) == (2, True)


def test_embeddings_of_states_are_cached_by_the_compiled_model(maze: list[Episode], tmp_path: Path) -> None:
    bare: Any = gymnasium.make("HalfCheetah-v5").unwrapped
    text = Path(bare.fullpath).read_text(encoding="utf-8")
    path, digests = tmp_path / "cheetah.xml", []
    cheetah = roll_out("HalfCheetah-v5", (1,))
    dataset = write_states("cheetah/random-v0", "HalfCheetah-v5", cheetah)
    edit_spec(dataset, kwargs={"xml_file": str(path)})
    for colour in ("1 0 0 1", "0 1 0 1", "1 0 0 1"):
        path.write_text(text.replace('rgba="0.8 0.6 .4 1"', f'rgba="{colour}"'))
        stage_of.cache_clear()
        with pytest.warns(Notice, match=r"is made from .*cheetah\.xml"):
            digests.append(open_source(dataset, cameras=["default"]).frames.digest(0))
    assert digests[0] == digests[2] != digests[1]


OWN_ROBOT = """
import gymnasium
import numpy as np
from gymnasium.envs.mujoco.reacher_v5 import ReacherEnv

class OwnReacher(ReacherEnv):
    pass

gymnasium.register("OwnReacher-v0", entry_point="own_robot:OwnReacher", max_episode_steps=50)

def qpos(arrays):
    cos, sin, target = np.split(arrays["observations"][:, :6], 3, axis=1)
    return np.concatenate([np.arctan2(sin, cos), target], axis=1)

def short(arrays):
    return qpos(arrays)[1:]
"""


def test_another_package_rebuilds_the_states_of_its_own_environment(
    goal: Path,
    zest: Run,
    refusal: Callable[..., tuple[int, str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    site = tmp_path / "site"
    about = site / "own_robot-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: own_robot\nVersion: 1.0\n")
    (site / "own_robot.py").write_text(OWN_ROBOT)
    episodes = roll_out("Reacher-v5", (3, 3))
    dataset = write_states("own/random-v0", "Reacher-v5", episodes, with_state=False)
    edit_spec(dataset, id="OwnReacher-v0", entry_point="own_robot:OwnReacher")
    words = ["relabel", dataset, "--goal", goal, "--n-workers", "1"]
    monkeypatch.syspath_prepend(str(site))
    code, error = refusal(*words)
    assert (code, "would run code of 'own_robot:OwnReacher'" in error) == (2, True)
    assert "own_robot" not in sys.modules

    def register(function: str) -> None:
        entry = f"[zest_rl.state_renderers]\nOwnReacher-v0 = {function}\n"
        (about / "entry_points.txt").write_text(entry)

    register("own_robot:qpos")
    made = zest(*words)["dataset"]
    assert read(made, lambda ds: ds.metadata)["zest"]["relabel"]["frames"]["qpos_from"] == "own_robot:qpos"
    frames: Any = open_source(dataset, cameras=["default"]).frames
    for i, episode in enumerate(episodes):
        np.testing.assert_allclose(frames.read_states(i)["qpos"], [state["qpos"] for state in episode.state], atol=1e-6)
    for function, message in (
        ("own_robot:short", "failed (ValueError: qpos must be finite and of shape (4, nq), got (3, 4))"),
        ("own_robot:lost", "cannot be loaded (AttributeError: "),
        ("no_robot:qpos", "cannot be loaded (ModuleNotFoundError: "),
    ):
        register(function)
        code, error = refusal(*words)
        assert (code, f"{function}, which is registered for OwnReacher-v0, {message}" in error) == (1, True), error


@pytest.mark.parametrize("spec", ["[]", "1", "null", '"x"', "{}", "[" * 100_000, "no JSON"])
def test_an_env_spec_of_another_form_is_refused(spec: str) -> None:
    with pytest.raises(BadInput, match="is not the JSON of a Gymnasium EnvSpec"):
        stage_of(spec, ())
