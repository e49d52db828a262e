"""`zest relabel` on datasets of other robots: real environments, real files in the layouts of their formats."""

from __future__ import annotations

import copy
import json
import shutil
import sys
import tempfile
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import gymnasium
import gymnasium_robotics  # noqa: F401  # registers its environments
import h5py
import imageio.v2 as imageio
import minari
import mujoco
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from gymnasium import spaces
from gymnasium_robotics.utils import mujoco_utils
from minari.data_collector import EpisodeBuffer
from PIL import Image
from read_dataset import read

from zest_rl import cli
from zest_rl.data import reader
from zest_rl.data.reader import Dataset
from zest_rl.data.writer import write_scored
from zest_rl.embedders import load_embedder
from zest_rl.errors import ZestError
from zest_rl.rewards.scores import score_views
from zest_rl.runtime.gl import select_gl_backend
from zest_rl.sources import open_source
from zest_rl.sources.pictures import Pictures
from zest_rl.sources.stage import stage_of
from zest_rl.types import FloatArray, Frame

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")  # datasets of tests have no author
Run = Callable[..., dict[str, Any]]
LENGTHS = (4, 6, 4)
SIDE = 64


@dataclass(frozen=True)
class Episode:
    """A rollout as its environment gave it."""

    observations: list[dict[str, np.ndarray]]
    """T+1."""
    frames: list[Frame]
    """T+1."""
    state: list[dict[str, np.ndarray]]
    """T+1, of the simulator."""
    actions: np.ndarray
    rewards: np.ndarray


def roll_out(env_id: str, lengths: tuple[int, ...], **kwargs: Any) -> list[Episode]:
    """Random actions in a real environment."""
    select_gl_backend()
    env = gymnasium.make(env_id, render_mode="rgb_array", width=SIDE, height=SIDE, **kwargs)
    quality = env.unwrapped.model.vis.quality
    quality.shadowsize = quality.offsamples = 0  # they take nearly all of the time
    env.action_space.seed(0)
    episodes = []
    for seed, length in enumerate(lengths):
        observation, _ = env.reset(seed=seed)
        observations, frames, state, actions, rewards = [observation], [env.render()], [state_of(env)], [], []
        for _ in range(length):
            actions.append(env.action_space.sample())
            observation, reward, *_ = env.step(actions[-1])
            observations.append(observation)
            frames.append(env.render())
            state.append(state_of(env))
            rewards.append(reward)
        episodes.append(Episode(observations, frames, state, np.array(actions), np.array(rewards)))
    env.close()
    return episodes


def state_of(env: Any) -> dict[str, np.ndarray]:
    """What the environment itself calls its state, or qpos alone."""
    bare = env.unwrapped
    return dict(bare.get_env_state()) if hasattr(bare, "get_env_state") else {"qpos": bare.data.qpos.copy()}


@pytest.fixture(scope="module", autouse=True)
def _temporary(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Mazes leave their XML where temporary files are."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", str(tmp_path_factory.mktemp("temporary")))
        yield


@pytest.fixture(scope="module")
def maze() -> list[Episode]:
    return roll_out("PointMaze_UMaze-v3", LENGTHS)


@pytest.fixture(autouse=True)
def _places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "cache"))
    (tmp_path / "minari").mkdir()


@pytest.fixture(scope="module")
def goal(maze: list[Episode], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A start and a goal as pictures of the scene."""
    folder = tmp_path_factory.mktemp("goal")
    for part, frame in (("init", maze[1].frames[0]), ("goal", maze[1].frames[-1])):
        (folder / part).mkdir()
        Image.fromarray(frame).save(folder / part / "0.png")
    return folder


def write_minari(
    dataset_id: str,
    episodes: list[Episode],
    observe: Callable[[Episode], Any],
    space: gymnasium.Space[Any],
    *,
    infos: Callable[[Episode], dict[str, Any]] = lambda episode: {},
    **options: Any,
) -> str:
    """Leave episodes in the Minari root, through Minari's own writer."""
    buffers = []
    for i, episode in enumerate(episodes):
        ends = np.arange(len(episode.actions)) == len(episode.actions) - 1
        buffers.append(
            EpisodeBuffer(
                id=i,
                seed=i,
                observations=observe(episode),
                actions=episode.actions,
                rewards=episode.rewards,
                terminations=ends & False,
                truncations=ends,
                infos=infos(episode),
            )
        )
    action_space = spaces.Box(-1, 1, episodes[0].actions.shape[1:], np.float32)
    minari.create_dataset_from_buffers(
        dataset_id, buffers, observation_space=space, action_space=action_space, **options
    )
    return dataset_id


def box(array: np.ndarray) -> spaces.Box:
    """The space of one step of an array."""
    if array.dtype == np.uint8:
        return spaces.Box(0, 255, array.shape[1:], np.uint8)
    return spaces.Box(-np.inf, np.inf, array.shape[1:], array.dtype.type)


def rows(episode: Episode, key: str) -> np.ndarray:
    return np.stack([observation[key] for observation in episode.observations])


def with_pictures(episode: Episode) -> dict[str, Any]:
    """The maze's observations and two cameras, one of them upside down, as CHW floats."""
    frames = np.stack(episode.frames)
    return {
        "achieved_goal": rows(episode, "achieved_goal"),
        "observation": rows(episode, "observation"),
        "cameras": {"top": frames, "turned": np.moveaxis(frames[:, ::-1], 3, 1).astype(np.float32) / 255},
    }


def space_of(value: Any) -> gymnasium.Space[Any]:
    return spaces.Dict({k: space_of(v) for k, v in value.items()}) if isinstance(value, dict) else box(value)


def expected_scores(views: list[list[Frame]], goal: Path) -> FloatArray:
    """What the definition gives, without any of the package's reading, caching or batching."""
    embedder = load_embedder("efficientnet-lite0")
    start, wanted = (
        embedder.embed_images([np.asarray(Image.open(goal / part / "0.png"))]) for part in ("init", "goal")
    )
    embedded = np.stack([embedder.embed_images(frames) for frames in views], axis=1)
    return score_views(embedded, start, wanted)


def arrays(dataset_id: str) -> dict[str, np.ndarray]:
    """Every array of a dataset by its path in the HDF5 file."""
    found = {}

    def visit(name: str, node: Any) -> None:
        if isinstance(node, h5py.Dataset):
            found[name] = node[()]

    with h5py.File(reader.dataset_path(dataset_id) / reader.DATA_FILE) as file:
        file.visititems(visit)
    return found


def check_kept_but_the_rewards(source_id: str, relabeled_id: str) -> None:
    """Rewards are scores[1:], the former ones are kept under a name that says so, all else is bit for bit the same."""
    before, after = arrays(source_id), arrays(relabeled_id)
    n = sum(name.endswith("/rewards") for name in before)
    added = {f"episode_{i}/infos/{name}" for i in range(n) for name in ("zest/score", "source/reward")}
    assert set(after) == set(before) | added
    for name, array in before.items():
        if name.endswith("/rewards"):
            episode = name.removesuffix("/rewards")
            np.testing.assert_array_equal(after[name], after[f"{episode}/infos/zest/score"][1:])
            kept = after[f"{episode}/infos/source/reward"]
            np.testing.assert_array_equal(kept, np.concatenate([[0], array]).astype(np.float32))
        else:
            assert list(map(bytes, np.atleast_1d(after[name]))) == list(map(bytes, np.atleast_1d(array)))
    for ours, theirs in zip(read(relabeled_id, Dataset.rewards), minari.load_dataset(relabeled_id), strict=True):
        np.testing.assert_array_equal(ours, theirs.rewards)


# --- pictures among the observations ----------------------------------------------------------------------------------


@pytest.fixture
def pictured(maze: list[Episode]) -> str:
    """A Minari dataset whose observations hold numbers and two cameras; raw, so that they are exact."""
    space = space_of(with_pictures(maze[0]))
    return write_minari("maze/pictured-v0", maze, with_pictures, space, jpeg_encoding=False)


def test_the_named_camera_is_scored_by_the_definition(
    pictured: str, maze: list[Episode], goal: Path, zest: Run
) -> None:
    result = zest("relabel", pictured, "--goal", goal, "--frames", "observations/cameras/top", "--n-workers", "1")
    assert result["dataset"].startswith("maze/pictured-zest-")
    assert result["views"] == ["observations/cameras/top"]
    assert (result["n_frames"], result["n_episodes_embedded"]) == (sum(LENGTHS) + len(LENGTHS), len(LENGTHS))
    check_kept_but_the_rewards(pictured, result["dataset"])
    for episode, scores in zip(maze, read(result["dataset"], Dataset.scores), strict=True):
        np.testing.assert_allclose(scores, expected_scores([episode.frames], goal), atol=1e-4)
    assert read(result["dataset"], Dataset.scores)[1][-1] > 0.99, "start and goal are pictures of this very episode"


def test_several_cameras_are_views_that_are_averaged(pictured: str, maze: list[Episode], goal: Path, zest: Run) -> None:
    result = zest("relabel", pictured, "--goal", goal, "--frames", "cameras/top", "cameras/turned")
    turned = [[frame[::-1] for frame in episode.frames] for episode in maze]
    for episode, other, scores in zip(maze, turned, read(result["dataset"], Dataset.scores), strict=True):
        np.testing.assert_allclose(scores, expected_scores([episode.frames, other], goal), atol=1e-4)


def test_several_cameras_without_a_choice_are_an_error_that_lists_them(
    pictured: str, goal: Path, refusal: Callable[..., tuple[int, str]]
) -> None:
    code, message = refusal("relabel", pictured, "--goal", goal)
    assert code == 2
    assert "several entries with pictures: observations/cameras/top, observations/cameras/turned" in message


def test_the_only_camera_is_found_by_itself_also_as_jpeg_in_a_flat_observation(
    maze: list[Episode], goal: Path, zest: Run
) -> None:
    flat = write_minari("maze/flat-v0", maze, lambda e: np.stack(e.frames), box(np.stack(maze[0].frames)))
    result = zest("relabel", flat, "--goal", goal, "--n-workers", "1")
    assert result["views"] == ["observations"]
    check_kept_but_the_rewards(flat, result["dataset"])
    for episode, scores in zip(minari.load_dataset(flat), read(result["dataset"], Dataset.scores), strict=True):
        np.testing.assert_allclose(scores, expected_scores([list(episode.observations)], goal), atol=1e-4)


def test_rewards_need_not_be_recorded(pictured: str, goal: Path, zest: Run, tmp_path: Path) -> None:
    words = ["--goal", goal, "--frames", "cameras/top", "--n-workers", "1"]
    with h5py.File(reader.dataset_path(pictured) / reader.DATA_FILE, "r+") as file:
        for episode in file.values():
            del episode["rewards"]
    made = zest("relabel", pictured, *words)["dataset"]
    for scores, found in zip(read(made, Dataset.scores), minari.load_dataset(made), strict=True):
        np.testing.assert_array_equal(found.rewards, scores[1:])
        assert "source" not in found.infos
    zest("export", made, "--output", tmp_path / "maze.npz")
    assert "source_reward" not in np.load(tmp_path / "maze.npz")


def test_episodes_that_minari_could_not_read_are_refused_before_any_work(
    pictured: str, goal: Path, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    with h5py.File(reader.dataset_path(pictured) / reader.DATA_FILE, "r+") as file:
        del file["episode_1"]
    code, error = refusal("relabel", pictured, "--goal", goal, "--frames", "cameras/top")
    assert (code, "must hold episode_0, … episode_1, as Minari needs it" in error) == (2, True)
    assert not (tmp_path / "cache" / "frames").exists()


def test_the_metadata_tells_where_the_frames_came_from(pictured: str, goal: Path, zest: Run) -> None:
    made = zest("relabel", pictured, "--goal", goal, "--frames", "cameras/top")["dataset"]
    facts = read(made, lambda ds: ds.metadata)["zest"]["relabel"]
    assert facts["source"] == pictured
    assert facts["source_sha256"] == read(pictured, Dataset.fingerprint)
    assert facts["frames"]["views"] == ["observations/cameras/top"]
    assert facts["scorer"]["config"]["goal"] == str(goal)
    assert {"goal_sha256", "embedder_sha256"} <= facts["scorer"].keys()
    assert (reader.dataset_path(made) / "zest_goal" / "goal" / "0.png").is_file()


def test_a_run_goes_on_at_the_episode_where_it_was_cut_and_ends_as_one_that_was_not(
    pictured: str, goal: Path, zest: Run, tmp_path: Path
) -> None:
    words = ["relabel", pictured, "--goal", goal, "--frames", "cameras/top", "--n-workers", "1"]
    whole = zest(*words)
    expected = arrays(whole["dataset"])
    shutil.rmtree(whole["path"])
    cached = sorted((tmp_path / "cache" / "frames").rglob("*.npz"))
    assert len(cached) == len(LENGTHS)
    cached[0].unlink()
    again = zest(*words)
    assert (again["dataset"], again["n_episodes_embedded"]) == (whole["dataset"], 1)
    for name, array in arrays(again["dataset"]).items():
        np.testing.assert_array_equal(array, expected[name])
    assert zest(*words)["n_episodes_embedded"] == 0


def test_a_ray_cluster_of_its_own_makes_the_same_rewards(pictured: str, goal: Path, zest: Run, tmp_path: Path) -> None:
    words = ["relabel", pictured, "--goal", goal, "--frames", "cameras/top"]
    here = zest(*words, "--n-workers", "1")
    expected = arrays(here["dataset"])
    shutil.rmtree(here["path"])
    shutil.rmtree(tmp_path / "cache" / "frames")
    on_ray = zest(*words, "--engine", "ray", "--n-workers", "2")
    assert (on_ray["dataset"], on_ray["n_episodes_embedded"]) == (here["dataset"], len(LENGTHS))
    for name, array in arrays(on_ray["dataset"]).items():
        np.testing.assert_array_equal(array, expected[name])


def test_damaged_embeddings_are_noticed_and_made_again(
    pictured: str, goal: Path, zest: Run, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    words = ["relabel", pictured, "--goal", goal, "--frames", "cameras/top", "--n-workers", "1"]
    shutil.rmtree(zest(*words)["path"])
    next((tmp_path / "cache" / "frames").rglob("*.npz")).write_bytes(b"cut")
    code, message = refusal(*words)
    assert (code, "in the cache are damaged; run the same command again" in message) == (1, True)
    assert zest(*words)["n_episodes_embedded"] == 1


def test_an_episode_of_pictures_is_never_in_memory_whole(tmp_path: Path) -> None:
    n, shape = 1000, (120, 160, 3)
    with h5py.File(tmp_path / "long.hdf5", "w") as file:
        file.create_dataset("episode_0/observations", (n, *shape), np.uint8, chunks=(10, *shape), compression="gzip")
    frames = Pictures(tmp_path / "long.hdf5", ("episode_0",), ("observations",))
    tracemalloc.start()
    assert sum(1 for _ in frames.read(0)) == n
    frames.digest(0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < n * np.prod(shape) / 4


def test_every_way_of_scoring_works_on_pictures(pictured: str, goal: Path, zest: Run) -> None:
    base = ["relabel", pictured, "--goal", goal, "--frames", "cameras/top", "--n-workers", "1"]
    level = zest(*base)["dataset"]
    difference = zest(*base, "--reward", "difference")["dataset"]
    raw = zest(*base, "--features", "raw", "--similarity", "l2")["dataset"]
    for scores, rewards in zip(read(level, Dataset.scores), read(difference, Dataset.rewards), strict=True):
        np.testing.assert_array_equal(rewards, np.diff(scores))
    assert all((rewards <= 0).all() for rewards in read(raw, Dataset.rewards))
    many = goal.parent / "many"
    shutil.copytree(goal, many, dirs_exist_ok=True)
    Image.fromarray(np.zeros((SIDE, SIDE, 3), np.uint8)).save(many / "goal" / "1.png")
    chosen = zest(*base, "--goal", many, "--goal-share", "0.5")["dataset"]
    assert len(read(chosen, lambda ds: ds.metadata)["zest"]["relabel"]["kept_goals"]) == 1
    assert len({level, difference, raw, chosen}) == 4


def test_episodes_of_one_length_can_be_shuffled(maze: list[Episode], goal: Path, zest: Run) -> None:
    same = [episode for episode in maze if len(episode.actions) == LENGTHS[0]]
    flat = write_minari("maze/same-v0", same, lambda e: np.stack(e.frames), box(np.stack(maze[0].frames)))
    real, null = (zest("relabel", flat, "--goal", goal, *more)["dataset"] for more in ((), ("--shuffle", "0")))
    one, other = read(real, Dataset.rewards)
    np.testing.assert_array_equal(read(null, Dataset.rewards), [other, one])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--frames", "cameras/top"], "frames from elsewhere need a goal of their own, got 'same-scene'"),
        (["--goal", "drawings"], "several entries with pictures"),
        (["--frames", "cameras/top", "--goal", "drawings"], "need a goal of their own, got 'drawings'"),
        (["--frames", "cameras/top", "--goal", "text:a -> b"], "reads pictures only; use one that reads text"),
        (
            ["--frames", "cameras/wrist"],
            "has no pictures at 'cameras/wrist', and there is no such folder; entries with pictures: observations/cam",
        ),
        (["--frames", "cameras/top", "--views", "3"], "--views belong to the kitchen's own renderer"),
    ],
)
def test_bad_input_names_what_is_wrong_and_writes_nothing(
    pictured: str, words: list[str], message: str, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    code, error = refusal("relabel", pictured, *words)
    assert code == 2
    assert message in " ".join(error.split())
    assert reader.list_datasets() == [pictured]


def test_numbers_alone_are_no_frames(maze: list[Episode], goal: Path, refusal: Callable[..., tuple[int, str]]) -> None:
    blind = write_minari("maze/blind-v0", maze, lambda e: rows(e, "observation"), box(rows(maze[0], "observation")))
    code, error = refusal("relabel", blind, "--goal", goal)
    assert (code, "shows no frames" in error) == (2, True)


# --- recorded simulator states ----------------------------------------------------------------------------------------


def recorded(episode: Episode) -> dict[str, Any]:
    return {"state": {key: np.stack([state[key] for state in episode.state]) for key in episode.state[0]}}


def stacked(values: list[Any]) -> Any:
    """Rows of an array, or of those in a dict."""
    if isinstance(values[0], dict):
        return {key: stacked([value[key] for value in values]) for key in values[0]}
    return np.stack(values)


def as_observed(episode: Episode) -> Any:
    return stacked(episode.observations)


def write_states(dataset_id: str, env_id: str, episodes: list[Episode], *, with_state: bool = True) -> str:
    space = space_of(as_observed(episodes[0]))
    infos = recorded if with_state else (lambda episode: {})
    return write_minari(dataset_id, episodes, as_observed, space, env=env_id, infos=infos)


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
    source = open_source(write_states("some/random-v0", env_id, [episode]))
    ours = [views[0] for views in source.frames.read(0)]
    np.testing.assert_array_equal(ours, rendered(env_id, None, episode, seed=0))
    assert max(np.std(frame) for frame in ours) > 10, "it shows something"


def test_the_environments_own_camera_stays_where_it_stood_at_first_and_embeddings_depend_on_it() -> None:
    episodes = roll_out("HalfCheetah-v5", (2, 2))
    both = open_source(write_states("cheetah/both-v0", "HalfCheetah-v5", episodes)).frames
    last = open_source(write_states("cheetah/last-v0", "HalfCheetah-v5", episodes[1:])).frames
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
    code, error = refusal("relabel", dataset, "--goal", goal)
    assert (code, "lacks infos/state/door_body_pos" in error) == (2, True)


def test_the_target_of_fetch_is_where_the_goal_is_and_its_joints_must_be_recorded(
    goal: Path, zest: Run, refusal: Callable[..., tuple[int, str]]
) -> None:
    fetch = roll_out("FetchReach-v4", (2,))
    dataset = write_states("fetch/random-v0", "FetchReach-v4", fetch)
    frames = [views[0] for views in open_source(dataset).frames.read(0)]
    red = np.stack(frames).astype(int)
    assert ((red[..., 0] > 150) & (red[..., 1] < 60) & (red[..., 2] < 60)).any(axis=(1, 2)).all(), "the target is red"
    assert zest("relabel", dataset, "--goal", goal, "--n-workers", "1")["n_still_frames"] == 0
    blind = write_states("fetch/blind-v0", "FetchReach-v4", fetch, with_state=False)
    code, error = refusal("relabel", blind, "--goal", goal)
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
    np.testing.assert_array_equal(frames._recorded(0)["qpos"], qpos)
    assert not frames.describe()["qpos_is_noisy"]


def test_the_kitchens_noisy_positions_are_shown_and_told(goal: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frames, qpos = observed_alone("FrankaKitchen-v1")
    assert 0 < np.abs(frames._recorded(0)["qpos"] - qpos).max() <= 0.001
    assert frames.describe()["qpos_is_noisy"]
    assert len(list(frames.read(0))) == len(qpos)
    assert cli.main(["relabel", "some/random-v0", "--goal", str(goal), "--n-workers", "1"]) == 0
    assert "warning: states are read from observations that the environment blurred" in capsys.readouterr().err


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
    dataset = write_minari(
        "some/random-v0",
        [episode],
        as_observed,
        space_of(as_observed(episode)),
        env=env.spec,
        infos=lambda _: kept,
    )
    return open_source(dataset).frames, np.array([one["qpos"] for one in state])


@pytest.mark.parametrize(
    "trap", ["evil.envs.maze:PointMazeEnv", "zest_rl.cli:main", "gymnasium.envs.registration:make"]
)
def test_code_that_is_not_the_registered_environments_is_not_run(
    trap: str, maze: list[Episode], goal: Path, refusal: Callable[..., tuple[int, str]]
) -> None:
    dataset = write_states("maze/random-v0", "PointMaze_UMaze-v3", maze[:1])
    edit_spec(dataset, entry_point=trap)
    code, error = refusal("relabel", dataset, "--goal", goal)
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
    code, error = refusal("relabel", states, "--goal", goal)
    assert (code, f"would run code of {entry_point!r}; only gymnasium.*" in error) == (2, True)
    assert "are trusted; give --frames FOLDER" in error


def test_an_env_spec_that_is_none_is_refused(
    maze: list[Episode], goal: Path, refusal: Callable[..., tuple[int, str]]
) -> None:
    dataset = write_states("maze/random-v0", "PointMaze_UMaze-v3", maze[:1])
    edit_spec(dataset, unheard_of=1)
    code, error = refusal("relabel", dataset, "--goal", goal)
    assert (code, "env_spec is not the JSON of a Gymnasium EnvSpec" in error) == (2, True)


def test_wrapped_observations_are_not_taken_for_the_state_and_wrappers_are_not_run(
    maze: list[Episode], goal: Path, refusal: Callable[..., tuple[int, str]]
) -> None:
    wrapper = {"name": "Trap", "entry_point": "gymnasium.envs.registration:make", "kwargs": {"id": "CartPole-v1"}}
    for with_state in (False, True):
        dataset = write_states(f"maze/state-{with_state}-v0", "PointMaze_UMaze-v3", maze[:1], with_state=with_state)
        edit_spec(dataset, additional_wrappers=[wrapper])
    code, error = refusal("relabel", "maze/state-False-v0", "--goal", goal)
    assert (code, "wrappers (Trap) may have changed the observations of PointMaze_UMaze-v3" in error) == (2, True)
    assert len(list(open_source("maze/state-True-v0").frames.read(0))) == LENGTHS[0] + 1


def test_targets_that_only_a_renderer_places_are_refused(goal: Path, refusal: Callable[..., tuple[int, str]]) -> None:
    dataset = write_states("hand/random-v0", "HandReach-v3", roll_out("HandReach-v3", (1,)))
    code, error = refusal("relabel", dataset, "--goal", goal)
    assert (code, "places targets only while it renders" in error) == (2, True)


def test_embeddings_of_states_are_cached_by_the_compiled_model(maze: list[Episode], tmp_path: Path) -> None:
    bare: Any = gymnasium.make("HalfCheetah-v5").unwrapped
    text = Path(bare.fullpath).read_text()
    path, digests = tmp_path / "cheetah.xml", []
    cheetah = roll_out("HalfCheetah-v5", (1,))
    dataset = write_states("cheetah/random-v0", "HalfCheetah-v5", cheetah)
    edit_spec(dataset, kwargs={"xml_file": str(path)})
    for colour in ("1 0 0 1", "0 1 0 1", "1 0 0 1"):
        path.write_text(text.replace('rgba="0.8 0.6 .4 1"', f'rgba="{colour}"'))
        stage_of.cache_clear()
        digests.append(open_source(dataset).frames.digest(0))
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
    frames: Any = open_source(dataset).frames
    for i, episode in enumerate(episodes):
        np.testing.assert_allclose(frames._recorded(i)["qpos"], [state["qpos"] for state in episode.state], atol=1e-6)
    for function, message in (
        ("own_robot:short", "failed (ValueError: qpos must be finite and of shape (4, nq), got (3, 4))"),
        ("own_robot:lost", "cannot be loaded (AttributeError: "),
        ("no_robot:qpos", "cannot be loaded (ModuleNotFoundError: "),
    ):
        register(function)
        code, error = refusal(*words)
        assert (code, f"{function}, which is registered for OwnReacher-v0, {message}" in error) == (1, True), error


# --- a folder beside the dataset --------------------------------------------------------------------------------------


def blind(maze: list[Episode]) -> str:
    """A dataset without any frames."""
    return write_minari("maze/blind-v0", maze, as_observed, space_of(as_observed(maze[0])))


def write_video(path: Path, frames: list[Frame]) -> None:
    """H.264 as people have it."""
    imageio.mimwrite(path, frames, fps=10, codec="libx264", quality=9, macro_block_size=2)


def test_folders_of_videos_and_of_pictures_are_views(
    maze: list[Episode], goal: Path, zest: Run, tmp_path: Path
) -> None:
    for i, episode in enumerate(maze):
        (tmp_path / "top" / f"episode_{i:03d}").mkdir(parents=True)
        for t, frame in enumerate(episode.frames):
            Image.fromarray(frame).save(tmp_path / "top" / f"episode_{i:03d}" / f"frame{t}.png")
        (tmp_path / "films").mkdir(exist_ok=True)
        write_video(tmp_path / "films" / f"episode_{i}.mp4", episode.frames)
    dataset = blind(maze)
    top = zest("relabel", dataset, "--goal", goal, "--frames", tmp_path / "top", "--n-workers", "1")
    for episode, scores in zip(maze, read(top["dataset"], Dataset.scores), strict=True):
        np.testing.assert_allclose(scores, expected_scores([episode.frames], goal), atol=1e-4)
    folders = [tmp_path / "top", tmp_path / "films"]
    both = zest("relabel", dataset, "--goal", goal, "--frames", *folders, "--n-workers", "1")
    assert both["views"] == ["top", "films"]
    films = [imageio.mimread(tmp_path / "films" / f"episode_{i}.mp4") for i in range(len(maze))]
    for episode, film, scores in zip(maze, films, read(both["dataset"], Dataset.scores), strict=True):
        np.testing.assert_allclose(scores, expected_scores([episode.frames, list(film)], goal), atol=1e-4)


def test_one_frame_may_be_missing_at_the_end_and_no_more(
    maze: list[Episode], goal: Path, zest: Run, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    dataset = blind(maze)
    words = ["relabel", dataset, "--goal", goal, "--frames", tmp_path / "films", "--n-workers", "1"]

    def leave(n_missing: int) -> None:
        shutil.rmtree(tmp_path / "films", ignore_errors=True)
        for i, episode in enumerate(maze):
            folder = tmp_path / "films" / f"episode_{i}"
            folder.mkdir(parents=True)
            for t, frame in enumerate(episode.frames[: len(episode.frames) - n_missing]):
                Image.fromarray(frame).save(folder / f"{t}.png")

    leave(1)
    scores = read(zest(*words)["dataset"], Dataset.scores)
    for episode, one in zip(maze, scores, strict=True):
        np.testing.assert_allclose(one[:-1], expected_scores([episode.frames[:-1]], goal), atol=1e-4)
        assert one[-1] == one[-2]
    leave(2)
    code, error = refusal(*words)
    assert code == 2
    assert "episode 0 has 4 actions, so it needs 5 frames (x_0 … x_T), or 4 without the last; got 3" in error
    shutil.rmtree(tmp_path / "films" / "episode_1")
    code, error = refusal(*words)
    assert (code, "1 are missing, the first is 1" in error) == (2, True)


# --- robomimic --------------------------------------------------------------------------------------------------------


def write_robomimic(path: Path, maze: list[Episode], *, with_next: bool = True) -> Path:
    """The layout of https://robomimic.github.io/docs/datasets/overview.html."""
    with h5py.File(path, "w") as file:
        group = file.create_group("data")
        for i, episode in enumerate(maze):
            demo = group.create_group(f"demo_{i}")
            demo.attrs["num_samples"] = len(episode.actions)
            for name, part in (("obs", slice(None, -1)), ("next_obs", slice(1, None)))[: 1 + with_next]:
                demo[f"{name}/agentview_image"] = np.stack(episode.frames)[part]
                demo[f"{name}/robot0_eef_pos"] = rows(episode, "observation")[part]
                demo[f"{name}/object"] = rows(episode, "desired_goal")[part]
            demo["actions"], demo["rewards"] = episode.actions, episode.rewards + i
            demo["dones"] = np.arange(len(episode.actions)) == len(episode.actions) - 1
        group.attrs["total"] = sum(len(episode.actions) for episode in maze)
        group.attrs["env_args"] = json.dumps({"env_name": "Maze", "type": 2, "env_kwargs": {}})
    return path


def check_imported(dataset_id: str, maze: list[Episode], expected: list[list[Frame]], goal: Path) -> None:
    """Minari loads it; observations, actions and scores are those of the rollouts."""
    for i, (episode, frames, found) in enumerate(zip(maze, expected, minari.load_dataset(dataset_id), strict=True)):
        scores = expected_scores([frames], goal)
        np.testing.assert_allclose(found.rewards, scores[1:], atol=1e-4)
        np.testing.assert_array_equal(found.actions, episode.actions.astype(np.float32))
        np.testing.assert_array_equal(found.infos["source"]["reward"], np.concatenate([[0], episode.rewards + i]))
        assert found.terminations.tolist() == [False] * (len(episode.actions) - 1) + [True]


def test_a_robomimic_file_becomes_a_minari_dataset(maze: list[Episode], goal: Path, zest: Run, tmp_path: Path) -> None:
    path = write_robomimic(tmp_path / "Lift ph.hdf5", maze)
    made = zest("relabel", path, "--goal", goal, "--n-workers", "1")
    assert made["dataset"].startswith("zest/Lift-ph-zest-")
    assert made["dataset"].endswith("-v0")
    check_imported(made["dataset"], maze, [episode.frames for episode in maze], goal)
    for episode, found in zip(maze, minari.load_dataset(made["dataset"]), strict=True):
        assert found.observations.keys() == {"object", "robot0_eef_pos"}
        wanted = rows(episode, "observation").astype(np.float32)
        np.testing.assert_array_equal(found.observations["robot0_eef_pos"], wanted)


def test_a_robomimic_file_without_next_obs_repeats_the_last_frame_and_observation(
    maze: list[Episode], goal: Path, zest: Run, tmp_path: Path
) -> None:
    made = zest("relabel", write_robomimic(tmp_path / "short.hdf5", maze, with_next=False), "--goal", goal)["dataset"]
    check_imported(made, maze, [[*episode.frames[:-1], episode.frames[-2]] for episode in maze], goal)
    for found in minari.load_dataset(made):
        np.testing.assert_array_equal(found.observations["object"][-1], found.observations["object"][-2])


def test_the_last_frame_repeats_where_next_obs_lacks_the_camera(maze: list[Episode], tmp_path: Path) -> None:
    path = write_robomimic(tmp_path / "lift.hdf5", maze)
    with h5py.File(path, "r+") as file:
        del file["data/demo_1/next_obs/agentview_image"]
    frames = open_source(str(path)).frames
    assert [len(list(frames.read(i))) for i in range(len(maze))] == list(LENGTHS)


@pytest.mark.parametrize("dataset", ["/data/missing.hdf5", "~/missing", "./missing", "demos/missing.hdf5"])
def test_a_path_where_nothing_is_is_named_as_such(
    dataset: str, goal: Path, refusal: Callable[..., tuple[int, str]]
) -> None:
    code, error = refusal("relabel", dataset, "--goal", goal)
    assert (code, f"there is no file or folder {dataset}" in error) == (2, True)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (lambda path: path.write_bytes(b"no HDF5"), "cannot be read as HDF5"),
        (lambda path: h5py.File(path, "w").close(), "must hold data/demo_0, … with actions and obs/"),
        (lambda path: h5py.File(path, "w").create_group("data/demo_x").file.close(), "named data/demo_0, data/demo_1"),
        (lambda path: path.mkdir(), "is a folder, but no LeRobot dataset"),
    ],
)
def test_other_files_are_refused(
    content: Callable[[Path], Any], message: str, goal: Path, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    content(tmp_path / "some.hdf5")
    code, error = refusal("relabel", tmp_path / "some.hdf5", "--goal", goal)
    assert (code, message in error) == (2, True)


# --- LeRobot ----------------------------------------------------------------------------------------------------------


def write_lerobot(root: Path, maze: list[Episode], *, version: str = "v3.0", number: int = 0, step: int = 1) -> Path:
    """The layout of https://huggingface.co/docs/lerobot/lerobot-dataset-v3: two episodes in the first files."""
    fps, key = 10, "observation.images.top"
    rows_of, first = [], 0
    for i, episode in enumerate(maze):
        n_steps = len(episode.actions)
        rows_of.append(
            {
                "observation.state": rows(episode, "observation")[:-1].astype(np.float32).tolist(),
                "action": episode.actions.tolist(),
                "next.reward": (episode.rewards + i).astype(np.float32).tolist(),
                "next.done": (np.arange(n_steps) == n_steps - 1).tolist(),
                "next.truncated": [False] * n_steps,
                "timestamp": (np.arange(n_steps) / fps).astype(np.float32).tolist(),
                "frame_index": list(range(n_steps)),
                "episode_index": [number + step * i] * n_steps,
                "index": list(range(first, first + n_steps)),
                "task_index": [0] * n_steps,
            }
        )
        first += n_steps
    listed = []
    for file, members in enumerate(([0, 1], [2])):
        data_file, video = (f"{at}/chunk-000/file-{file:03d}" for at in ("data", f"videos/{key}"))
        for path in (data_file, video):
            (root / path).parent.mkdir(parents=True, exist_ok=True)
        columns = {name: [value for i in members for value in rows_of[i][name]] for name in rows_of[0]}
        pyarrow.parquet.write_table(pyarrow.table(columns), root / f"{data_file}.parquet")
        frames = [frame for i in members for frame in maze[i].frames[:-1]]
        imageio.mimwrite(root / f"{video}.mp4", frames, fps=fps, codec="libx264", quality=9, macro_block_size=2)
        start = 0.0
        for i in members:
            length = len(maze[i].actions)
            place = {"chunk_index": 0, "file_index": file}
            listed.append(
                {
                    "episode_index": number + step * i,
                    "tasks": ["go there"],
                    "length": length,
                    **{f"data/{name}": value for name, value in place.items()},
                    **{f"videos/{key}/{name}": value for name, value in place.items()},
                    f"videos/{key}/from_timestamp": start,
                    f"videos/{key}/to_timestamp": start + length / fps,
                    "stats/action/mean": [0.0, 0.0],
                }
            )
            start += length / fps
    (root / "meta" / "episodes" / "chunk-000").mkdir(parents=True)
    table = pyarrow.Table.from_pylist(listed)
    pyarrow.parquet.write_table(table, root / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    one = {"dtype": "float32", "names": None}
    features = {
        key: {"dtype": "video", "shape": [SIDE, SIDE, 3], "info": {"video.is_depth_map": False}},
        "observation.state": {**one, "shape": [4]},
        "action": {**one, "shape": [2]},
        "next.reward": {**one, "shape": [1]},
        "next.done": {"dtype": "bool", "shape": [1]},
        "next.truncated": {"dtype": "bool", "shape": [1]},
        "episode_index": {"dtype": "int64", "shape": [1]},
    }
    info = {
        "codebase_version": version,
        "total_episodes": len(maze),
        "fps": fps,
        "features": features,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    }
    (root / "meta" / "info.json").write_text(json.dumps(info))
    return root


def test_a_lerobot_folder_becomes_a_minari_dataset(
    maze: list[Episode], goal: Path, zest: Run, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    root = write_lerobot(tmp_path / "pusht", maze)
    videos = sorted((root / "videos").rglob("*.mp4"))
    decoded = [list(imageio.mimread(video)) for video in videos]
    assert [len(frames) for frames in decoded] == [LENGTHS[0] + LENGTHS[1], LENGTHS[2]]
    of_episodes = [decoded[0][: LENGTHS[0]], decoded[0][LENGTHS[0] :], decoded[1]]
    source = open_source(str(root))
    for i, frames in enumerate(of_episodes):
        np.testing.assert_array_equal([views[0] for views in source.frames.read(i)], frames)
    made = zest("relabel", root, "--goal", goal, "--n-workers", "1")
    assert made["dataset"].startswith("zest/pusht-zest-")
    assert made["views"] == ["observation.images.top"]
    check_imported(made["dataset"], maze, [[*frames, frames[-1]] for frames in of_episodes], goal)
    for episode, found in zip(maze, minari.load_dataset(made["dataset"]), strict=True):
        state = rows(episode, "observation").astype(np.float32)
        np.testing.assert_array_equal(found.observations["observation.state"][:-1], state[:-1])
    for words, fps in (((), 10), (("--fps", "20"), 20)):
        back = zest("export", made["dataset"], "--to", "lerobot", "--output", tmp_path / f"back{fps}", *words)
        assert json.loads((Path(back["file"]) / "meta" / "info.json").read_text())["fps"] == fps
    videos[1].unlink()
    code, error = refusal("relabel", root, "--goal", goal)
    assert (code, "lacks videos/observation.images.top/chunk-000/file-001.mp4" in error) == (2, True)


def test_a_part_of_a_lerobot_dataset_keeps_its_order_whatever_its_numbers(
    maze: list[Episode], goal: Path, zest: Run, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    folders = write_lerobot(tmp_path / "whole", maze), write_lerobot(tmp_path / "part", maze, number=3, step=2)
    whole, part = (open_source(str(folder)) for folder in folders)
    assert part.trajectories.fingerprint() == whole.trajectories.fingerprint()
    for i in range(len(maze)):
        np.testing.assert_array_equal(list(part.frames.read(i)), list(whole.frames.read(i)))
    made = zest("relabel", tmp_path / "part", "--goal", goal, "--n-workers", "1")["dataset"]
    assert [len(rewards) for rewards in read(made, Dataset.rewards)] == list(LENGTHS)
    listed = tmp_path / "part" / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    shutil.copyfile(listed, listed.with_name("file-001.parquet"))
    code, error = refusal("relabel", tmp_path / "part", "--goal", goal)
    assert (code, "must list every episode once, got 6 rows" in error) == (2, True)


def test_an_older_lerobot_dataset_is_refused_with_what_converts_it(
    maze: list[Episode], goal: Path, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    code, error = refusal("relabel", write_lerobot(tmp_path / "old", maze, version="v2.1"), "--goal", goal)
    assert (code, "of version v2.1, v3.0 is read; convert it with" in error) == (2, True)


@pytest.mark.parametrize("lost", ["features", "fps"])
def test_a_lerobot_folder_whose_info_lacks_a_part_is_refused(
    lost: str, maze: list[Episode], goal: Path, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    path = write_lerobot(tmp_path / "pusht", maze) / "meta" / "info.json"
    path.write_text(json.dumps({name: value for name, value in json.loads(path.read_text()).items() if name != lost}))
    code, error = refusal("relabel", tmp_path / "pusht", "--goal", goal)
    assert (code, f"is not that of a LeRobot v3.0 dataset ({lost!r})" in error) == (2, True)


def test_without_next_truncated_an_episode_of_lerobot_counts_as_cut(maze: list[Episode], tmp_path: Path) -> None:
    root = write_lerobot(tmp_path / "pusht", maze)
    rows_: Any = open_source(str(root)).trajectories
    assert [episode.terminated for episode in rows_.episodes()] == [True] * 3
    path = root / "meta" / "info.json"
    info = json.loads(path.read_text())
    del info["features"]["next.truncated"]
    path.write_text(json.dumps(info))
    rows_ = open_source(str(root)).trajectories
    assert [episode.terminated for episode in rows_.episodes()] == [False] * 3


@pytest.mark.parametrize("form", ["robomimic", "lerobot"])
def test_ends_are_those_of_the_dataset_that_was_exported(
    form: str, maze: list[Episode], goal: Path, zest: Run, tmp_path: Path
) -> None:
    dataset = blind(maze)
    with h5py.File(reader.dataset_path(dataset) / reader.DATA_FILE, "r+") as file:
        file["episode_1/terminations"][-1], file["episode_1/truncations"][-1] = True, False
    for i, episode in enumerate(maze):
        for t, frame in enumerate(episode.frames):
            path = tmp_path / "films" / f"episode_{i}" / f"{t}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(frame).save(path)
    exported = zest("export", dataset, "--to", form, "--output", tmp_path / "exported.hdf5")["file"]
    made = zest("relabel", exported, "--goal", goal, "--frames", tmp_path / "films", "--n-workers", "1")["dataset"]
    assert [episode.terminated for episode in read(made, Dataset.episodes)] == [False, True, False]


# --- what is kept and checked -----------------------------------------------------------------------------------------


def test_datasets_that_differ_by_their_rewards_alone_are_not_taken_for_one_another(
    maze: list[Episode], goal: Path, zest: Run, tmp_path: Path
) -> None:
    made = []
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        path = write_robomimic(tmp_path / folder / "lift.hdf5", maze)
        with h5py.File(path, "r+") as file:
            file["data/demo_1/rewards"][:] = 7 if folder == "b" else np.nan
        made.append(zest("relabel", path, "--goal", goal, "--n-workers", "1")["dataset"])
    assert made[0] != made[1]
    found = [arrays(name) for name in made]
    assert "episode_1/infos/source/reward" not in found[0], "none were recorded"
    np.testing.assert_array_equal(found[1]["episode_1/infos/source/reward"], [0, *[7] * LENGTHS[1]])


def test_a_reward_that_is_nan_does_not_lose_the_others_and_an_info_called_gt_is_no_ground_truth(
    maze: list[Episode], goal: Path, zest: Run
) -> None:
    dataset = write_minari(
        "maze/nan-v0",
        maze,
        with_pictures,
        space_of(with_pictures(maze[0])),
        infos=lambda episode: {"gt": {"depth": np.zeros(len(episode.frames))}},
        jpeg_encoding=False,
    )
    with h5py.File(reader.dataset_path(dataset) / reader.DATA_FILE, "r+") as file:
        file["episode_0/rewards"][1] = np.nan
    made = zest("relabel", dataset, "--goal", goal, "--frames", "cameras/top", "--n-workers", "1")["dataset"]
    check_kept_but_the_rewards(dataset, made)


@pytest.mark.parametrize("name", ["observations/object", "infos/source/reward"])
def test_imported_arrays_that_did_not_reach_the_disk_are_noticed(
    name: str, maze: list[Episode], tmp_path: Path
) -> None:
    def lose(staging: Path) -> None:
        with h5py.File(staging / reader.DATA_FILE, "r+") as file:
            file[f"episode_1/{name}"][-1] += 1

    demos = open_source(str(write_robomimic(tmp_path / "lift.hdf5", maze))).trajectories
    scores = [np.zeros(length + 1, np.float32) for length in LENGTHS]
    rewards = [score[1:] for score in scores]
    with pytest.raises(ZestError, match=f"{name} of episode 1 of zest/lift-v0 was not written whole"):
        write_scored(demos, "zest/lift-v0", rewards, scores, description="", zest={}, extra=lose)
    assert reader.list_datasets() == []


# --- what comes after -------------------------------------------------------------------------------------------------


def test_policies_are_trained_on_it_it_is_exported_and_inspected_and_not_evaluated(
    pictured: str, maze: list[Episode], goal: Path, zest: Run, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    made = zest("relabel", pictured, "--goal", goal, "--frames", "cameras/top", "--n-workers", "1")["dataset"]
    small = ["--hidden-size", "16", "--n-layers", "1", "--n-updates", "4", "--log-every", "2", "--threads", "1"]
    for agent in ("bc", "dt"):
        trained = zest("train", agent, made, *small, "--run-dir", tmp_path / agent)
        assert trained["next"] == f"zest export {made}"
        code, error = refusal("evaluate", tmp_path / agent)
        assert (code, f"zest export {made}" in error) == (2, True)
    written = zest("export", made, "--output", tmp_path / "maze.npz")
    assert written["n_transitions"] == sum(LENGTHS)
    arrays_ = np.load(tmp_path / "maze.npz")
    flat = [np.concatenate([rows(e, "achieved_goal"), rows(e, "observation")], axis=1)[:-1] for e in maze]
    np.testing.assert_array_equal(arrays_["observations"], np.concatenate(flat).astype(np.float32))
    np.testing.assert_array_equal(arrays_["source_reward"], np.concatenate([e.rewards for e in maze]))
    np.testing.assert_array_equal(arrays_["rewards"], np.concatenate(read(made, Dataset.rewards)))
    inspected = zest("inspect", made, "--output", tmp_path / "page.html")
    figures = inspected["datasets"][made]["figures"]
    assert figures.keys() == {
        "Value-order correlation", "Told by the step", "Straight in time", "Saturated", "Nothing to see",
    }  # fmt: skip
    still = [score[1:] == 0 for score in read(made, Dataset.scores)]
    assert sum(map(np.sum, still)) == read(made, lambda ds: ds.metadata)["zest"]["relabel"]["n_still_frames"]
    assert figures["Nothing to see"]["value"] == pytest.approx(np.mean([episode.mean() for episode in still]))
    assert made in (tmp_path / "page.html").read_text()
