"""Datasets → transitions, which every format is written from.

Transition t of an episode is (o_t, a_t, r_t, o_{t+1}); nothing is shifted and nothing is lost. Ground truth and scores
go along under names of their own, and are never the reward unless the dataset's rewards are them.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, Literal, get_args

import h5py
import numpy as np
from numpy.typing import NDArray

from zest_rl.data import reader as data
from zest_rl.data.observations import acts_discretely, entries, is_numbers
from zest_rl.errors import BadInput, nearest
from zest_rl.types import FloatArray

Shape = Literal["step", "difference", "terminal"]


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


SUCCESS = (data.SOURCE_SUCCESS, "infos/success", "infos/is_success")
"""Where datasets of other robots hold success by step: LeRobot's once relabeled; Adroit's and mazes'; Fetch's."""
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
        gt_episode_success (T,) bool, of the whole episode, and source_reward (T,) float32 and success (T,) bool after
        the action, which another robot's dataset came with. A Dict of observations is flattened
        (`zest_rl.data.observations.numbers`), and so are actions of several dimensions; whole numbers among the actions
        are int64, (T,) those of a Discrete space.

    Raises:
        BadInput: no such dataset, the rewards cannot be normalised, or are differences already.
    """
    episodes = data.read_episodes(dataset_id, discrete=True)
    actions, success = _beside(dataset_id, [episode.actions for episode in episodes])
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
    widths = sorted({episode.obs.shape[1] for episode in episodes})
    if len(widths) > 1:
        raise BadInput(
            f"the episodes of {dataset_id} must observe equally many numbers, got {widths}; where floats may be "
            "pictures or numbers, declare bounds in the observation space: pictures are in [0, 1]"
        )
    if success is not None:
        extras["success"] = success
    shaped = rewards.of([episode.rewards for episode in episodes], before)
    found = []
    for i, (episode, own) in enumerate(zip(episodes, shaped, strict=True)):
        last = np.arange(len(episode)) == len(episode) - 1
        found.append(
            {
                "observations": episode.obs[:-1],
                "actions": actions[i],
                "rewards": own,
                "next_observations": episode.obs[1:],
                "terminals": last & episode.terminated,
                "timeouts": last & (not episode.terminated),
                **{name: values[i] for name, values in extras.items()},
            }
        )
    return found


@dataclass(frozen=True)
class Contents:
    """All that a file of any format may hold."""

    episodes: list[Transitions]
    scores: list[FloatArray] | None
    """(T+1,) each: ZeST scores of all frames, the first one too; None when the dataset was not relabeled."""
    about: dict[str, Any]
    """JSON-ready: what a reader may want to know of where the file comes from, and what of it is left out."""

    def __len__(self) -> int:
        return sum(len(next(iter(episode.values()))) for episode in self.episodes)

    @property
    def flat(self) -> Transitions:
        """The transitions of all episodes in one, and `episode` (N,) int64, which tells them apart."""
        arrays = {name: np.concatenate([episode[name] for episode in self.episodes]) for name in self.episodes[0]}
        arrays["episode"] = np.repeat(np.arange(len(self.episodes)), [len(one["rewards"]) for one in self.episodes])
        return arrays


def read(dataset_id: str, rewards: Rewards = AS_RECORDED) -> Contents:
    """Read a dataset with all that goes into its files; arguments and errors as in `transitions`."""
    episodes = transitions(dataset_id, rewards)
    metadata = data.read_metadata(dataset_id)
    about = {
        "dataset": dataset_id,
        "rewards": rewards.shape + (", normalised" if rewards.normalise else ""),
        "env_spec": json.loads(metadata.get("env_spec") or "null"),
        "ref_min_score": metadata.get("ref_min_score"),
        "ref_max_score": metadata.get("ref_max_score"),
        "zest": metadata.get("zest"),
        "left_out": _left_out(dataset_id),
    }
    return Contents(episodes, data.read_scores(dataset_id) if "zest_score" in episodes[0] else None, about)


def read_scores(dataset_id: str) -> Contents:
    """Read the scores alone, of a dataset that may hold pictures alone.

    Raises:
        BadInput: no such dataset, or it was not relabeled.
    """
    if "relabel" not in data.read_metadata(dataset_id).get("zest", {}):
        raise BadInput("progress is read from ZeST scores, which this dataset has not; relabel it with `zest relabel`")
    scores = data.read_scores(dataset_id)
    return Contents([{"zest_score": score[1:]} for score in scores], scores, {"left_out": []})


def _beside(dataset_id: str, actions: list[FloatArray]) -> tuple[list[NDArray[Any]], list[NDArray[np.bool_]] | None]:
    """Read what episodes do not tell: how actions (T, act_dim) are stored, and success after each.

    Returns:
        The actions, with the type and, where they are of a Discrete space, the shape that they have; and per episode
        (T,), None where an episode does not hold it.
    """
    with data.open_episodes(dataset_id) as (file, names):
        episodes = [file[name] for name in names]
        whole, alone = acts_discretely(episodes[0]), episodes[0]["actions"].ndim == 1
        success = [_success(episode) for episode in episodes]
    known = [one for one in success if one is not None]
    as_stored: list[NDArray[Any]] = [
        (one[:, 0] if alone else one).astype(np.int64) if whole else one for one in actions
    ]
    return as_stored, known if len(known) == len(success) else None


def _success(episode: h5py.Group) -> NDArray[np.bool_] | None:
    """Read whether the task was done after each action: (T,); None where that is not held."""
    path = next((path for path in SUCCESS if path in episode), None)
    n_steps = len(episode["actions"])
    if path is None or len(episode[path]) not in (n_steps, n_steps + 1):
        return None
    return np.asarray(episode[path][-n_steps:], dtype=bool).reshape(n_steps, -1)[:, 0]


def check_continuous(contents: Contents, reader: str) -> None:
    """Raise `BadInput` where the actions are whole numbers, which `reader` has no policies for."""
    if contents.episodes[0]["actions"].dtype.kind == "i":
        raise BadInput(f"{reader} takes continuous actions, got whole numbers; export to npz, d4rl, d3rlpy or torchrl")


def _left_out(dataset_id: str) -> list[str]:
    """Name the entries of the observations that are no numbers: pictures and text."""
    with data.open_episodes(dataset_id) as (file, names):
        found = entries(file[names[0]]["observations"], "observations")
        return [path for path, entry in found.items() if not is_numbers(entry)]
