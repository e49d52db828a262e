"""Datasets → files that other offline-RL code reads: flat arrays, D4RL's HDF5, robomimic's HDF5.

Transition t of an episode is (o_t, a_t, r_t, o_{t+1}); nothing is shifted and nothing is lost. Ground truth and scores
go along under names of their own, and are never the reward unless the dataset's rewards are them.

=============  ======================================================================================================
``npz``        flat arrays (N, …) of all transitions, in the order of episodes, which `episode` tells apart
``d4rl``       the same names at the root of an HDF5 file, as D4RL's datasets and CORL's flat loaders read them
``robomimic``  ``data/demo_I`` per episode with ``obs/flat`` and ``next_obs/flat``, and masks ``train`` and ``valid``
=============  ======================================================================================================
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
    """``step``: as they are; ``difference``: their change, the first against 0; ``terminal``: the last one alone."""
    normalise: bool = False
    """Shift and scale to [0, 1] over the dataset, after the shape was made."""

    def __post_init__(self) -> None:
        if self.shape not in get_args(Shape):
            raise BadInput(f"unknown shape of rewards {self.shape!r}; {nearest(self.shape, get_args(Shape))}")

    def of(self, episodes: list[FloatArray]) -> list[FloatArray]:
        """Shape and scale the rewards (T,) of all episodes.

        Raises:
            BadInput: rewards that are all equal are to be normalised.
        """
        if self.shape == "difference":
            episodes = [np.diff(rewards, prepend=np.float32(0)) for rewards in episodes]
        elif self.shape == "terminal":
            episodes = [np.where(np.arange(len(r)) == len(r) - 1, r, np.float32(0)) for r in episodes]
        if not self.normalise:
            return episodes
        every = np.concatenate(episodes)
        low, size = every.min(), np.ptp(every)
        if size == 0:
            raise BadInput("rewards that are all equal cannot be normalised; leave --normalise out")
        return [((rewards - low) / size).astype(np.float32) for rewards in episodes]


Transitions = dict[str, NDArray[Any]]
"""Equally long arrays of one episode, see `transitions`."""
AS_RECORDED = Rewards()


def transitions(dataset_id: str, rewards: Rewards = AS_RECORDED) -> list[Transitions]:
    """Read a dataset as transitions, one dict of equally long arrays per episode.

    Args:
        dataset_id: any dataset with flat observations.
        rewards: how its rewards are handed on.

    Returns:
        observations, next_observations (T, obs_dim), actions (T, act_dim), rewards (T,) float32; terminals, timeouts
        (T,) bool; and where they are recorded, zest_score, gt_reward (T,) float32 after the action, gt_success (T,)
        bool.

    Raises:
        BadInput: no such dataset, or the rewards cannot be normalised.
    """
    episodes = data.read_episodes(dataset_id)
    extras: dict[str, list[NDArray[Any]]] = {}
    if "relabel" in data.read_metadata(dataset_id).get("zest", {}):
        extras["zest_score"] = [score[1:] for score in data.read_scores(dataset_id)]
    if data.has_ground_truth(dataset_id):
        truth = data.read_ground_truth(dataset_id)
        extras["gt_reward"] = [episode.rewards for episode in truth]
        extras["gt_success"] = [np.full(len(episode.rewards), episode.success) for episode in truth]
    found = []
    for i, (episode, own) in enumerate(zip(episodes, rewards.of([e.rewards for e in episodes]), strict=True)):
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


def export(dataset_id: str, to: Format, path: Path, rewards: Rewards = AS_RECORDED) -> Path:
    """Write a dataset in another format, atomically.

    Args:
        dataset_id: any dataset with flat observations.
        to: the format.
        path: the file; it must not exist.
        rewards: how the dataset's rewards are handed on.

    Raises:
        BadInput: no such dataset, an unknown format, or there is a file already.
        ZestError: the disk is full or read-only.
    """
    if to not in WRITERS:
        raise BadInput(f"unknown format {to!r}; {nearest(to, WRITERS)}")
    if path.exists():
        raise BadInput(f"{path} exists; delete it, or choose another --output")
    episodes = transitions(dataset_id, rewards)
    size = sum(array.nbytes for episode in episodes for array in episode.values())
    artifacts.check_free_space(path.parent, 2 * size)
    with artifacts.atomic_path(path) as temporary:
        WRITERS[to](temporary, episodes, _about(dataset_id, rewards))
    return path


def _about(dataset_id: str, rewards: Rewards) -> dict[str, Any]:
    """What a reader of the file may want to know of where it comes from."""
    described = data.describe(dataset_id)
    return {
        "dataset": dataset_id,
        "rewards": rewards.shape + (", normalised" if rewards.normalise else ""),
        "env_spec": json.loads(described["env_spec"]),
        "ref_min_score": described["ref_min_score"],
        "ref_max_score": described["ref_max_score"],
        "zest": described["zest"],
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
            for key in ("zest_score", "gt_reward", "gt_success"):
                if key in episode:
                    demo.create_dataset(key, data=episode[key])
        group.attrs["total"] = sum(len(episode["rewards"]) for episode in episodes)
        spec = about["env_spec"]
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
