"""Datasets → transitions, the input of every format.

Transition t of an episode is (o_t, a_t, r_t, o_{t+1}); nothing is shifted and nothing is lost. Ground truth and scores
have their own names; they are the reward only where they are the dataset's rewards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import h5py
import numpy as np
from numpy.typing import NDArray

from zest_rl.data.observations import acts_discretely, entries, is_numbers
from zest_rl.data.provenance import DatasetRecord
from zest_rl.data.reader import Dataset, open_dataset
from zest_rl.errors import BadInput, nearest
from zest_rl.types import FloatArray

Shape = Literal["step", "difference", "terminal"]
"""The rewards as they are, their change, or the last one alone and 0 before."""
Transitions = dict[str, NDArray[Any]]
"""Equally long arrays of one episode, see `transitions`."""


@dataclass(frozen=True)
class TransitionDataset:
    """Everything that a file of any format may hold."""

    record: DatasetRecord
    """Of the dataset that was read."""
    episodes: list[Transitions]
    scores: list[FloatArray] | None
    """(T+1,) each: ZeST scores of all frames, including the first; None if the dataset was not relabeled."""
    left_out: tuple[str, ...]
    """Entries of the observations that are not numbers: pictures and text."""
    about: dict[str, Any]
    """JSON-ready: where the data come from, and what is left out."""

    def __len__(self) -> int:
        return sum(len(next(iter(episode.values()))) for episode in self.episodes)

    @property
    def flat(self) -> Transitions:
        """The concatenated transitions of all episodes, and `episode` (N,) int64, the index of each one's episode."""
        arrays = {name: np.concatenate([episode[name] for episode in self.episodes]) for name in self.episodes[0]}
        lengths = [len(episode["rewards"]) for episode in self.episodes]
        return {**arrays, "episode": np.repeat(np.arange(len(lengths)), lengths)}

    def check_continuous(self, library: str) -> None:
        """Raise `BadInput` if the actions are whole numbers, for which `library` has no policies."""
        if self.episodes[0]["actions"].dtype.kind == "i":
            raise BadInput(
                f"{library} takes continuous actions, got whole numbers; export to npz, d4rl, d3rlpy or torchrl"
            )


def shape_rewards(
    episodes: Sequence[FloatArray], before: Sequence[float], shape: Shape = "step", normalise: bool = False
) -> list[FloatArray]:
    """Shape and scale the rewards of all episodes.

    Args:
        episodes: (T,) float32 each.
        before: the value of each episode's first frame, for the first difference.
        shape: see `Shape`.
        normalise: shift and scale the shaped rewards to [0, 1] over the dataset; with ``terminal`` only the last ones.

    Returns:
        (T,) float32 each.

    Raises:
        BadInput: an unknown shape, or `normalise` with rewards that are all equal.
    """
    if shape not in get_args(Shape):
        raise BadInput(f"unknown shape of rewards {shape!r}; {nearest(shape, get_args(Shape))}")
    if shape == "difference":
        episodes = [
            np.diff(rewards, prepend=np.float32(first)) for rewards, first in zip(episodes, before, strict=True)
        ]
    counted = [rewards[-1:] if shape == "terminal" else rewards for rewards in episodes]
    if normalise:
        pooled = np.concatenate(counted)
        low, size = pooled.min(), np.ptp(pooled)
        if size == 0:
            raise BadInput("rewards that are all equal cannot be normalised; leave --normalise out")
        counted = [((rewards - low) / size).astype(np.float32) for rewards in counted]
    return [
        np.concatenate([np.zeros(len(rewards) - len(last), np.float32), last])
        for rewards, last in zip(episodes, counted, strict=True)
    ]


def transitions(dataset_id: str, *, shape: Shape = "step", normalise: bool = False) -> list[Transitions]:
    """Read a dataset as transitions, one dict of equally long arrays per episode.

    Args:
        dataset_id: any dataset with numbers among its observations.
        shape: of the rewards.
        normalise: shift and scale the rewards to [0, 1] over the dataset.

    Returns:
        observations, next_observations (T, obs_dim), actions (T, act_dim), rewards (T,) float32; terminals, timeouts
        (T,) bool; and where they are recorded, zest_score, gt_reward (T,) float32 after the action,
        gt_episode_success (T,) bool, of the whole episode, and for other robots their original source_reward (T,)
        float32 and success (T,) bool after the action. A Dict of observations is flattened
        (`zest_rl.data.observations.numbers`), and so are actions of several dimensions; actions that are whole numbers
        are int64, of a Discrete space (T,).

    Raises:
        BadInput: no such dataset, the rewards cannot be normalised, or are already differences.
    """
    with open_dataset(dataset_id) as ds:
        return read_transitions(ds, shape, normalise).episodes


def read_transitions(ds: Dataset, shape: Shape = "step", normalise: bool = False) -> TransitionDataset:
    """Read everything that a file may hold of a dataset; arguments and errors as in `transitions`."""
    episodes = ds.episodes(discrete=True)
    groups = list(ds.groups.values())
    columns: dict[str, list[NDArray[Any]]] = {}
    scores, before = None, [0.0] * len(episodes)
    if ds.record.relabel is not None:
        if shape == "difference" and ds.record.relabel.reward == "difference":
            raise BadInput(f"the rewards of {ds.id} are differences already; export them as they are")
        scores = ds.scores()
        before = [float(score[0]) for score in scores]
        columns["zest_score"] = [score[1:] for score in scores]
    if (source := ds.source_rewards()) is not None:
        columns["source_reward"] = source
    if ds.is_hand_rewarded:
        truth = ds.truth()
        columns["gt_reward"] = [episode.rewards for episode in truth]
        columns["gt_episode_success"] = [np.full(len(episode.rewards), episode.success) for episode in truth]
    if (success := ds.successes()) is not None:
        columns["success"] = success
    rewards = shape_rewards([episode.rewards for episode in episodes], before, shape, normalise)
    actions = [_as_stored(episode.actions, groups[0]) for episode in episodes]
    is_last = [np.arange(len(episode)) == len(episode) - 1 for episode in episodes]
    observed = entries(groups[0]["observations"], "observations")
    left_out = [path for path, entry in observed.items() if not is_numbers(entry)]
    return TransitionDataset(
        ds.record,
        [
            {
                "observations": episode.obs[:-1],
                "actions": actions[i],
                "rewards": rewards[i],
                "next_observations": episode.obs[1:],
                "terminals": is_last[i] & episode.terminated,
                "timeouts": is_last[i] & (not episode.terminated),
                **{name: values[i] for name, values in columns.items()},
            }
            for i, episode in enumerate(episodes)
        ],
        scores,
        tuple(left_out),
        {
            "dataset": ds.id,
            "rewards": shape + (", normalised" if normalise else ""),
            "env_spec": ds.record.env or None,
            "ref_min_score": ds.record.ref_min_score,
            "ref_max_score": ds.record.ref_max_score,
            "zest": ds.metadata.get("zest"),
            "left_out": left_out,
        },
    )


def read_progress(ds: Dataset) -> TransitionDataset:
    """Read only the scores; the observations may be pictures alone.

    Raises:
        BadInput: the dataset was not relabeled.
    """
    if ds.record.relabel is None:
        raise BadInput("progress is read from ZeST scores, which this dataset has not; relabel it with `zest relabel`")
    scores = ds.scores()
    return TransitionDataset(ds.record, [{"zest_score": score[1:]} for score in scores], scores, (), {})


def _as_stored(actions: FloatArray, episode: h5py.Group) -> NDArray[Any]:
    """Restore the dtype that actions (T, act_dim) have in `episode` and, for a Discrete space, their shape (T,)."""
    if not acts_discretely(episode):
        return actions
    return (actions[:, 0] if episode["actions"].ndim == 1 else actions).astype(np.int64)
