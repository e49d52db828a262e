"""Minari datasets for tests, left in the Minari root by Minari's own writer."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import minari
import numpy as np
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer


@dataclass(frozen=True)
class Recorded:
    """One episode of T steps that a time limit ended."""

    observations: Any
    """(T+1, …), or a dict of such."""
    actions: np.ndarray
    rewards: np.ndarray
    infos: dict[str, Any] = field(default_factory=dict)


def write_minari(
    dataset_id: str,
    episodes: Sequence[Recorded],
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    **options: Any,
) -> str:
    """Write a dataset; `options` are Minari's."""
    buffers = []
    for i, episode in enumerate(episodes):
        last = np.arange(len(episode.actions)) == len(episode.actions) - 1
        buffers.append(
            EpisodeBuffer(
                id=i, seed=i, observations=episode.observations, actions=episode.actions, rewards=episode.rewards,
                terminations=last & False, truncations=last, infos=episode.infos,
            )
        )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # datasets of tests have no author
        minari.create_dataset_from_buffers(
            dataset_id, buffers, observation_space=observation_space, action_space=action_space, **options
        )
    return dataset_id
