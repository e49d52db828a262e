"""`zest relabel` on datasets of other robots: real environments, real files in the layouts of their formats."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import gymnasium_robotics  # noqa: F401  # registers its environments
import h5py
import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from PIL import Image

from zest_rl import data
from zest_rl.embedders import load_embedder
from zest_rl.rendering import select_gl_backend
from zest_rl.scores import score_views
from zest_rl.types import FloatArray, Frame

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
    qpos: list[np.ndarray]
    actions: np.ndarray
    rewards: np.ndarray


def roll_out(env_id: str, lengths: tuple[int, ...], **kwargs: Any) -> list[Episode]:
    """Random actions in a real environment."""
    select_gl_backend()
    env = gymnasium.make(env_id, render_mode="rgb_array", width=SIDE, height=SIDE, **kwargs)
    env.action_space.seed(0)
    episodes = []
    for seed, length in enumerate(lengths):
        observation, _ = env.reset(seed=seed)
        observations, frames, qpos, actions, rewards = [observation], [env.render()], [], [], []
        qpos.append(env.unwrapped.data.qpos.copy())
        for _ in range(length):
            actions.append(env.action_space.sample())
            observation, reward, *_ = env.step(actions[-1])
            observations.append(observation)
            frames.append(env.render())
            qpos.append(env.unwrapped.data.qpos.copy())
            rewards.append(reward)
        episodes.append(Episode(observations, frames, qpos, np.array(actions), np.array(rewards)))
    env.close()
    return episodes


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

    with h5py.File(data.dataset_path(dataset_id) / data.DATA_FILE) as file:
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
    for ours, theirs in zip(data.read_rewards(relabeled_id), minari.load_dataset(relabeled_id), strict=True):
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
    for episode, scores in zip(maze, data.read_scores(result["dataset"]), strict=True):
        np.testing.assert_allclose(scores, expected_scores([episode.frames], goal), atol=1e-4)
    assert data.read_scores(result["dataset"])[1][-1] > 0.99, "start and goal are pictures of this very episode"


def test_several_cameras_are_views_that_are_averaged(pictured: str, maze: list[Episode], goal: Path, zest: Run) -> None:
    result = zest("relabel", pictured, "--goal", goal, "--frames", "cameras/top", "cameras/turned")
    turned = [[frame[::-1] for frame in episode.frames] for episode in maze]
    for episode, other, scores in zip(maze, turned, data.read_scores(result["dataset"]), strict=True):
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
    for episode, scores in zip(minari.load_dataset(flat), data.read_scores(result["dataset"]), strict=True):
        np.testing.assert_allclose(scores, expected_scores([list(episode.observations)], goal), atol=1e-4)


def test_the_metadata_tells_where_the_frames_came_from(pictured: str, goal: Path, zest: Run) -> None:
    made = zest("relabel", pictured, "--goal", goal, "--frames", "cameras/top")["dataset"]
    facts = data.read_metadata(made)["zest"]["relabel"]
    assert facts["source"] == pictured
    assert facts["source_sha256"] == data.fingerprint(pictured)
    assert facts["frames"]["views"] == ["observations/cameras/top"]
    assert facts["scorer"]["config"]["goal"] == str(goal)
    assert {"goal_sha256", "embedder_sha256"} <= facts["scorer"].keys()
    assert (data.dataset_path(made) / "zest_goal" / "goal" / "0.png").is_file()


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


def test_damaged_embeddings_are_noticed_and_made_again(
    pictured: str, goal: Path, zest: Run, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    words = ["relabel", pictured, "--goal", goal, "--frames", "cameras/top", "--n-workers", "1"]
    shutil.rmtree(zest(*words)["path"])
    next((tmp_path / "cache" / "frames").rglob("*.npz")).write_bytes(b"cut")
    code, message = refusal(*words)
    assert (code, "in the cache are damaged; run the same command again" in message) == (1, True)
    assert zest(*words)["n_episodes_embedded"] == 1


def test_every_way_of_scoring_works_on_pictures(pictured: str, goal: Path, zest: Run) -> None:
    base = ["relabel", pictured, "--goal", goal, "--frames", "cameras/top", "--n-workers", "1"]
    level = zest(*base)["dataset"]
    difference = zest(*base, "--reward", "difference")["dataset"]
    raw = zest(*base, "--features", "raw", "--similarity", "l2")["dataset"]
    for scores, rewards in zip(data.read_scores(level), data.read_rewards(difference), strict=True):
        np.testing.assert_array_equal(rewards, np.diff(scores))
    assert all((rewards <= 0).all() for rewards in data.read_rewards(raw))
    many = goal.parent / "many"
    shutil.copytree(goal, many, dirs_exist_ok=True)
    Image.fromarray(np.zeros((SIDE, SIDE, 3), np.uint8)).save(many / "goal" / "1.png")
    chosen = zest(*base, "--goal", many, "--goal-share", "0.5")["dataset"]
    assert len(data.read_metadata(chosen)["zest"]["relabel"]["kept_goals"]) == 1
    assert len({level, difference, raw, chosen}) == 4


def test_episodes_of_one_length_can_be_shuffled(maze: list[Episode], goal: Path, zest: Run) -> None:
    same = [episode for episode in maze if len(episode.actions) == LENGTHS[0]]
    flat = write_minari("maze/same-v0", same, lambda e: np.stack(e.frames), box(np.stack(maze[0].frames)))
    real, null = (zest("relabel", flat, "--goal", goal, *more)["dataset"] for more in ((), ("--shuffle", "0")))
    one, other = data.read_rewards(real)
    np.testing.assert_array_equal(data.read_rewards(null), [other, one])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--frames", "cameras/top"], "frames from elsewhere need a goal of their own, got 'same-scene'"),
        (["--goal", "drawings"], "several entries with pictures"),
        (["--frames", "cameras/top", "--goal", "drawings"], "need a goal of their own, got 'drawings'"),
        (["--frames", "cameras/top", "--goal", "text:a -> b"], "reads pictures only; use one that reads text"),
        (["--frames", "cameras/wrist"], "has no pictures at 'cameras/wrist'; entries with pictures: observations/cam"),
        (["--frames", "cameras/top", "--views", "3"], "--views belong to the kitchen's own renderer"),
    ],
)
def test_bad_input_names_what_is_wrong_and_writes_nothing(
    pictured: str, words: list[str], message: str, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    code, error = refusal("relabel", pictured, *words)
    assert code == 2
    assert message in " ".join(error.split())
    assert data.list_datasets() == [pictured]


def test_numbers_alone_are_no_frames(maze: list[Episode], goal: Path, refusal: Callable[..., tuple[int, str]]) -> None:
    blind = write_minari("maze/blind-v0", maze, lambda e: rows(e, "observation"), box(rows(maze[0], "observation")))
    code, error = refusal("relabel", blind, "--goal", goal)
    assert (code, "shows no frames" in error) == (2, True)
