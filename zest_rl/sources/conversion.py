"""Episodes of other formats → the files of a Minari dataset, one episode in memory at a time."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zest_rl.data.folders import METADATA_FILE
from zest_rl.data.reader import SOURCE_SUCCESS
from zest_rl.errors import BadInput
from zest_rl.runtime import artifacts
from zest_rl.types import FloatArray, check_finite


@dataclass(frozen=True)
class ConvertedEpisode:
    """One episode of T steps."""

    obs: dict[str, FloatArray]
    """(T+1, n) float32 each, no pictures; o_T repeats o_{T-1} where it was not recorded."""
    actions: FloatArray
    """(T, act_dim) float32."""
    rewards: FloatArray
    """(T,) float32, NaN where none were recorded."""
    terminated: bool
    success: NDArray[np.bool_] | None = None
    """(T,) success after each action; None where it was not recorded."""

    def __post_init__(self) -> None:
        n_steps = len(self.actions)
        wrong = [name for name, values in self.obs.items() if values.shape[:1] != (n_steps + 1,)]
        if n_steps == 0 or wrong or self.actions.ndim != 2 or self.rewards.shape != (n_steps,):
            raise BadInput(
                f"an episode must have T >= 1 actions (T, n), T rewards and observations of T + 1 steps, got actions "
                f"{self.actions.shape}, rewards {self.rewards.shape}"
                + (f", and {wrong[0]} of {self.obs[wrong[0]].shape}" if wrong else "")
            )
        for name, values in {**self.obs, "actions": self.actions}.items():
            check_finite(name, values)
        if not self.obs:
            raise BadInput("an episode must hold numbers among its observations, for a policy to act on; got none")


@dataclass(frozen=True)
class ConvertedTrajectories:
    """The `Trajectories` of a file or folder in another format; its pictures or videos are not copied."""

    path: Path
    format: str
    """Name of the format."""
    names: tuple[str, ...]
    """Of every episode in it: ``demo_3`` of robomimic, the ``episode_index`` of LeRobot."""
    n_steps: tuple[int, ...]
    """T of every episode."""
    n_bytes: int
    """Approximate size of all numbers."""
    episodes: Callable[[], Iterator[ConvertedEpisode]]
    """Reads all episodes, a few in memory at a time; picklable."""
    fps: float | None = None
    """Steps per second, which the copy keeps; None where they are not recorded."""

    @property
    def dataset_id(self) -> str:
        """``zest/NAME-v0``, from the name of the file or folder."""
        name = self.path.stem if self.path.is_file() else self.path.name
        return f"zest/{re.sub(r'[^A-Za-z0-9_.]+|[.]{2,}', '-', name).strip('-._') or 'dataset'}-v0"

    def fingerprint(self) -> str:
        """Hash everything that training may see, except rewards, and what else the copy keeps: success and `fps`."""
        digest = artifacts.hash_json(
            [
                [
                    sorted(episode.obs),
                    artifacts.hash_arrays(*(episode.obs[name] for name in sorted(episode.obs)), episode.actions),
                    episode.terminated,
                    *([] if episode.success is None else [artifacts.hash_arrays(episode.success)]),
                ]
                for episode in self.episodes()
            ]
        )
        return digest if self.fps is None else artifacts.hash_json([digest, self.fps])

    def rewards_to_keep(self) -> Sequence[FloatArray | None]:
        """Read the original rewards."""
        return [episode.rewards for episode in self.episodes()]

    def fill(self, folder: Path) -> None:
        """Write the episodes as a Minari dataset."""
        description = f"Imported from {self.path.name} ({self.format})."
        write_converted(folder, self.dataset_id, self.episodes(), description, fps=self.fps)

    def written(self) -> Iterator[Mapping[str, NDArray[Any]]]:
        """Yield the arrays of each episode, without rewards."""
        return map(arrays_on_disk, self.episodes())


def arrays_on_disk(episode: ConvertedEpisode) -> dict[str, NDArray[Any]]:
    """Return the arrays of an episode, without its rewards, by the names that `write_converted` gives them."""
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
        arrays = arrays_on_disk(episode)
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
