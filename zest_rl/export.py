"""Datasets → files that other offline-RL code reads: flat arrays, D4RL's HDF5, robomimic's HDF5.

Transition t of an episode is (o_t, a_t, r_t, o_{t+1}); nothing is shifted and nothing is lost. Ground truth and scores
go along under names of their own, and are never the reward unless the dataset's rewards are them.

- ``npz``: flat arrays (N, …) of all transitions, in the order of episodes, which `episode` tells apart.
- ``d4rl``: the same names at the root of an HDF5 file, as ``d4rl.qlearning_dataset(env, dataset=…)`` reads them; that
  function leaves out the last transition of every episode that a time limit ended.
- ``robomimic``: ``data/demo_I`` per episode with ``obs/flat`` and ``next_obs/flat``, and masks ``train`` and ``valid``.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import h5py
import numpy as np
from numpy.typing import NDArray

from zest_rl import artifacts, data
from zest_rl.errors import BadInput, nearest
from zest_rl.types import FloatArray

Format = Literal["npz", "d4rl", "robomimic"]
Shape = Literal["step", "difference", "terminal"]
VALID_SHARE = 0.1
"""Of the episodes, for robomimic's mask ``valid``."""


@dataclass(frozen=True)
class Rewards:
    """How the dataset's rewards are handed on."""

    shape: Shape = "step"
    """``step``: as they are; ``difference``: their change; ``terminal``: the last one alone, 0 before."""
    normalise: bool = False
    """Shift and scale to [0, 1] over the dataset, after the shape was made; of ``terminal`` the last ones alone."""

    def __post_init__(self) -> None:
        if self.shape not in get_args(Shape):
            raise BadInput(f"unknown shape of rewards {self.shape!r}; {nearest(self.shape, get_args(Shape))}")

    def of(self, episodes: list[FloatArray], before: list[float]) -> list[FloatArray]:
        """Shape and scale the rewards of all episodes.

        Args:
            episodes: (T,) float32 each.
            before: what the frame before the first action is worth, which the first difference is against.

        Raises:
            BadInput: rewards that are all equal are to be normalised.
        """
        if self.shape == "difference":
            episodes = [np.diff(one, prepend=np.float32(first)) for one, first in zip(episodes, before, strict=True)]
        counted = [rewards[-1:] if self.shape == "terminal" else rewards for rewards in episodes]
        if self.normalise:
            every = np.concatenate(counted)
            low, size = every.min(), np.ptp(every)
            if size == 0:
                raise BadInput("rewards that are all equal cannot be normalised; leave --normalise out")
            counted = [((rewards - low) / size).astype(np.float32) for rewards in counted]
        return [
            np.concatenate([np.zeros(len(rewards) - len(own), np.float32), own])
            for rewards, own in zip(episodes, counted, strict=True)
        ]


Transitions = dict[str, NDArray[Any]]
"""Equally long arrays of one episode, see `transitions`."""
AS_RECORDED = Rewards()


def transitions(dataset_id: str, rewards: Rewards = AS_RECORDED) -> list[Transitions]:
    """Read a dataset as transitions, one dict of equally long arrays per episode.

    Args:
        dataset_id: any dataset with numbers among its observations.
        rewards: how its rewards are handed on.

    Returns:
        observations, next_observations (T, obs_dim), actions (T, act_dim), rewards (T,) float32; terminals, timeouts
        (T,) bool; and where they are recorded, zest_score, gt_reward (T,) float32 after the action,
        gt_episode_success (T,) bool, of the whole episode, and source_reward (T,) float32, which another robot's
        dataset came with. A Dict of observations is flattened (`zest_rl.observations.numbers`).

    Raises:
        BadInput: no such dataset, the rewards cannot be normalised, or are differences already.
    """
    episodes = data.read_episodes(dataset_id)
    made = data.read_metadata(dataset_id).get("zest", {}).get("relabel")
    before = [0.0] * len(episodes)
    extras: dict[str, list[NDArray[Any]]] = {}
    if made is not None:
        if rewards.shape == "difference" and made["reward"] == "difference":
            raise BadInput(f"the rewards of {dataset_id} are differences already; export them as they are")
        scores = data.read_scores(dataset_id)
        before = [float(score[0]) for score in scores]
        extras["zest_score"] = [score[1:] for score in scores]
        source = data.read_source_rewards(dataset_id)
        if source is not None:
            extras["source_reward"] = source
    if data.has_ground_truth(dataset_id):
        truth = data.read_ground_truth(dataset_id)
        extras["gt_reward"] = [episode.rewards for episode in truth]
        extras["gt_episode_success"] = [np.full(len(episode.rewards), episode.success) for episode in truth]
    shaped = rewards.of([episode.rewards for episode in episodes], before)
    found = []
    for i, (episode, own) in enumerate(zip(episodes, shaped, strict=True)):
        last = np.arange(len(episode)) == len(episode) - 1
        found.append(
            {
                "observations": episode.obs[:-1],
                "actions": episode.actions,
                "rewards": own,
                "next_observations": episode.obs[1:],
                "terminals": last & episode.terminated,
                "timeouts": last & (not episode.terminated),
                **{name: values[i] for name, values in extras.items()},
            }
        )
    return found


@dataclass(frozen=True)
class Exported:
    """What `export` wrote."""

    path: Path
    n_episodes: int
    n_transitions: int
    arrays: tuple[str, ...]
    """Names of the arrays of `transitions`."""


def export(dataset_id: str, to: Format, path: Path, rewards: Rewards = AS_RECORDED) -> Exported:
    """Write a dataset in another format, atomically.

    Args:
        dataset_id: any dataset with flat observations.
        to: the format.
        path: the file; it must not exist.
        rewards: how the dataset's rewards are handed on.

    Raises:
        BadInput: no such dataset, an unknown format, there is a file already, or the format would lose the rewards.
        ZestError: the disk is full or read-only.
    """
    if to not in WRITERS:
        raise BadInput(f"unknown format {to!r}; {nearest(to, WRITERS)}")
    if path.exists():
        raise BadInput(f"{path} exists; delete it, or choose another --output")
    episodes = transitions(dataset_id, rewards)
    if to == "d4rl" and rewards.shape == "terminal" and any(episode["timeouts"].any() for episode in episodes):
        raise BadInput(
            "D4RL's loader leaves out the transition at a time limit, which holds the only reward of 'terminal'; "
            "export 'step' or 'difference', or to npz"
        )
    size = sum(array.nbytes for episode in episodes for array in episode.values())
    artifacts.check_free_space(path.parent, 2 * size)
    with artifacts.atomic_path(path) as temporary:
        WRITERS[to](temporary, episodes, _about(dataset_id, rewards))
    return Exported(path, len(episodes), sum(len(episode["rewards"]) for episode in episodes), tuple(episodes[0]))


def _about(dataset_id: str, rewards: Rewards) -> dict[str, Any]:
    """What a reader of the file may want to know of where it comes from."""
    metadata = data.read_metadata(dataset_id)
    return {
        "dataset": dataset_id,
        "rewards": rewards.shape + (", normalised" if rewards.normalise else ""),
        "env_spec": json.loads(metadata.get("env_spec") or "null"),
        "ref_min_score": metadata.get("ref_min_score"),
        "ref_max_score": metadata.get("ref_max_score"),
        "zest": metadata.get("zest"),
    }


def _flat(episodes: list[Transitions]) -> dict[str, NDArray[Any]]:
    arrays = {name: np.concatenate([episode[name] for episode in episodes]) for name in episodes[0]}
    arrays["episode"] = np.repeat(np.arange(len(episodes)), [len(episode["rewards"]) for episode in episodes])
    return arrays


def _write_npz(path: Path, episodes: list[Transitions], about: dict[str, Any]) -> None:
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, about=np.array(json.dumps(about)), **_flat(episodes))


def _write_d4rl(path: Path, episodes: list[Transitions], about: dict[str, Any]) -> None:
    with h5py.File(path, "w") as file:
        for name, values in _flat(episodes).items():
            file.create_dataset(name, data=values, compression="gzip")
        file.attrs["about"] = json.dumps(about)


def _write_robomimic(path: Path, episodes: list[Transitions], about: dict[str, Any]) -> None:
    if len(episodes) < 2:
        raise BadInput("robomimic's masks part the episodes into train and valid, which takes 2 or more; got 1")
    names = [f"demo_{i}" for i in range(len(episodes))]
    with h5py.File(path, "w") as file:
        group = file.create_group("data")
        for name, episode in zip(names, episodes, strict=True):
            demo = group.create_group(name)
            demo.attrs["num_samples"] = len(episode["rewards"])
            demo.create_dataset("obs/flat", data=episode["observations"])
            demo.create_dataset("next_obs/flat", data=episode["next_observations"])
            for key in ("actions", "rewards"):
                demo.create_dataset(key, data=episode[key])
            demo.create_dataset("dones", data=(episode["terminals"] | episode["timeouts"]).astype(np.int64))
            for key in sorted(episode.keys() - {"observations", "next_observations", "actions", "rewards"}):
                demo.create_dataset(key, data=episode[key])
        group.attrs["total"] = sum(len(episode["rewards"]) for episode in episodes)
        spec = about["env_spec"] or {"id": "unknown"}
        env = {"env_name": spec["id"], "type": 2, "env_kwargs": spec.get("kwargs", {})}  # 2: a Gym environment
        group.attrs["env_args"] = json.dumps(env)
        group.attrs["about"] = json.dumps(about)
        n_valid = max(1, round(VALID_SHARE * len(names)))
        chosen = set(np.random.default_rng(0).permutation(len(names))[:n_valid].tolist())
        for mask, members in (("valid", chosen), ("train", set(range(len(names))) - chosen)):
            file.create_dataset(f"mask/{mask}", data=np.array([names[i].encode() for i in sorted(members)], dtype="S"))


WRITERS: dict[str, Callable[[Path, list[Transitions], dict[str, Any]], None]] = {
    "npz": _write_npz,
    "d4rl": _write_d4rl,
    "robomimic": _write_robomimic,
}
