"""Rollouts of real environments, and datasets that are made of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import gymnasium
import gymnasium_robotics  # noqa: F401  # registers its environments
import h5py
import minari
import numpy as np
from gymnasium import spaces
from minari_files import Recorded, write_minari
from PIL import Image
from read_dataset import read

from zest_rl.data import reader
from zest_rl.data.reader import Dataset
from zest_rl.embedders import load_embedder
from zest_rl.rewards.scores import score_views
from zest_rl.runtime.gl import select_gl_backend
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


def stacked(values: list[Any]) -> Any:
    """Rows of an array, or of those in a dict."""
    if isinstance(values[0], dict):
        return {key: stacked([value[key] for value in values]) for key in values[0]}
    return np.stack(values)


def as_observed(episode: Episode) -> Any:
    return stacked(episode.observations)


def recorded_state(episode: Episode) -> dict[str, Any]:
    return {"state": {key: np.stack([state[key] for state in episode.state]) for key in episode.state[0]}}


def write_rollouts(
    dataset_id: str,
    episodes: list[Episode],
    observe: Callable[[Episode], Any],
    *,
    infos: Callable[[Episode], dict[str, Any]] = lambda episode: {},
    **options: Any,
) -> str:
    """Leave rollouts in the Minari root, with what `observe` makes of their observations."""
    recorded = [Recorded(observe(e), e.actions, e.rewards, infos(e)) for e in episodes]
    action_space = spaces.Box(-1, 1, episodes[0].actions.shape[1:], np.float32)
    return write_minari(dataset_id, recorded, space_of(recorded[0].observations), action_space, **options)


def write_states(dataset_id: str, env_id: str, episodes: list[Episode], *, with_state: bool = True) -> str:
    infos = recorded_state if with_state else (lambda episode: {})
    return write_rollouts(dataset_id, episodes, as_observed, env=env_id, infos=infos)


def write_blind(maze: list[Episode]) -> str:
    """A dataset without any frames."""
    return write_rollouts("maze/blind-v0", maze, as_observed)


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
