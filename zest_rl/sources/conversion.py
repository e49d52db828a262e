"""Episodes of other formats → the files of a Minari dataset, one episode in memory at a time."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zest_rl.data.reader import METADATA_FILE, SOURCE_SUCCESS
from zest_rl.errors import BadInput
from zest_rl.runtime import artifacts
from zest_rl.types import FloatArray


@dataclass(frozen=True)
class ConvertedEpisode:
    """One episode of T steps."""

    obs: dict[str, FloatArray]
    """(T+1, n) float32 each, no pictures; where the last was not recorded, it repeats the one before."""
    actions: FloatArray
    """(T, act_dim) float32."""
    rewards: FloatArray
    """(T,) float32, NaN where none were recorded."""
    terminated: bool
    success: NDArray[np.bool_] | None = None
    """(T,) whether the task was done after each action; None where that was not recorded."""

    def __post_init__(self) -> None:
        n_steps = len(self.actions)
        wrong = [name for name, values in self.obs.items() if values.shape[:1] != (n_steps + 1,)]
        if n_steps == 0 or wrong or self.actions.ndim != 2 or self.rewards.shape != (n_steps,):
            raise BadInput(
                f"an episode must have T >= 1 actions (T, n), T rewards and observations of T + 1 steps, got actions "
                f"{self.actions.shape}, rewards {self.rewards.shape}"
                + (f", and {wrong[0]} of {self.obs[wrong[0]].shape}" if wrong else "")
            )
        if not self.obs:
            raise BadInput("an episode must hold numbers among its observations, for a policy to act on; got none")


def dataset_id_of(path: Path) -> str:
    """Return ``zest/NAME-v0`` for a file or folder."""
    name = re.sub(r"[^A-Za-z0-9_.]+", "-", path.stem if path.is_file() else path.name).strip("-._")
    return f"zest/{name or 'dataset'}-v0"


def fingerprint(episodes: Iterable[ConvertedEpisode]) -> str:
    """Hash all that training may see of the episodes, and success where it is kept, but no rewards."""
    return artifacts.hash_json(
        [
            [
                sorted(episode.obs),
                artifacts.hash_arrays(*(episode.obs[name] for name in sorted(episode.obs)), episode.actions),
                episode.terminated,
                *([] if episode.success is None else [artifacts.hash_arrays(episode.success)]),
            ]
            for episode in episodes
        ]
    )


def stored(episode: ConvertedEpisode) -> dict[str, NDArray[Any]]:
    """Return what `write_converted` writes of an episode but its rewards, under the names on disk."""
    last = np.arange(len(episode.actions)) == len(episode.actions) - 1
    success = {} if episode.success is None else {SOURCE_SUCCESS: np.concatenate([[False], episode.success])}
    return {
        **{f"observations/{name}": values for name, values in episode.obs.items()},
        "actions": episode.actions,
        "terminations": last & episode.terminated,
        "truncations": last & (not episode.terminated),
        **success,
    }


def write_converted(
    folder: Path, dataset_id: str, episodes: Iterable[ConvertedEpisode], description: str, *, fps: float | None = None
) -> None:
    """Write the files of a Minari dataset, see `zest_rl.data.writer.Trajectories`; `fps` are steps per second."""
    import minari
    from gymnasium import spaces
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

    def space(array: NDArray[Any]) -> spaces.Box:
        return spaces.Box(-np.inf, np.inf, array.shape[1:], np.float32)

    storage = None
    for i, episode in enumerate(episodes):
        if storage is None:
            observation_space = spaces.Dict({name: space(values) for name, values in episode.obs.items()})
            storage = MinariStorage.new(
                folder / "data", observation_space=observation_space, action_space=space(episode.actions)
            )
        arrays = stored(episode)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            storage.update_episodes(
                [
                    EpisodeBuffer(
                        id=i,
                        observations=episode.obs,
                        actions=episode.actions,
                        rewards=episode.rewards,
                        terminations=arrays["terminations"],
                        truncations=arrays["truncations"],
                        infos={"source": {"success": arrays[SOURCE_SUCCESS]}} if SOURCE_SUCCESS in arrays else {},
                    )
                ]
            )
    metadata = artifacts.read_json(folder / METADATA_FILE)
    metadata |= {"dataset_id": dataset_id, "minari_version": minari.__version__, "description": description}
    if fps is not None:
        metadata["zest"] = {"recorded": {"fps": fps}}
    artifacts.write_json(folder / METADATA_FILE, metadata)
