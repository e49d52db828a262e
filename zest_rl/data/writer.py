"""Episodes → Minari datasets: locked, staged, verified, then renamed; nothing is ever half written.

The layout on disk is drawn in `zest_rl.data.reader`, the alignment of the arrays in `zest_rl.types`.
"""

from __future__ import annotations

import math
import os
import shutil
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from zest_rl.data.folders import CARD_FILE, DATA_FILE, MANIFEST_FILE, METADATA_FILE, dataset_path, exists
from zest_rl.data.hdf5 import open_hdf5
from zest_rl.data.observations import by_path
from zest_rl.data.reader import SOURCE_REWARD, Dataset
from zest_rl.errors import BadInput, ZestError
from zest_rl.runtime import artifacts
from zest_rl.runtime.child import write_in_child
from zest_rl.types import Episode, FloatArray


@dataclass(frozen=True)
class Recording:
    """One collected episode of T steps, as it is stored."""

    seed: int
    obs: FloatArray
    """(T+1, obs_dim) float32."""
    actions: FloatArray
    """(T, act_dim) float32."""
    terminated: bool
    qpos: NDArray[np.float64]
    """(T+1, nq) simulator positions; frames are rendered from them."""
    qvel: NDArray[np.float64]
    """(T+1, nv) simulator velocities."""
    gt_reward: FloatArray
    """(T+1,) float32; the first belongs to the reset."""
    gt_success: NDArray[np.bool_]
    """(T+1,) bool."""

    def __post_init__(self) -> None:
        Episode(self.obs, self.actions, self.gt_reward[1:], self.terminated)  # checks shapes, types, finiteness
        wrong = [name for name in ("qpos", "qvel", "gt_success") if len(getattr(self, name)) != len(self.obs)]
        if wrong:
            raise BadInput(f"{' and '.join(wrong)} must have T + 1 = {len(self.obs)} rows, as many as obs")


def _set_metadata(path: Path, **values: object) -> None:
    artifacts.write_json(path, {**artifacts.read_json(path), **values})


def _seal(staging: Path, dataset_id: str, expected: Iterable[Mapping[str, NDArray[Any]]]) -> None:
    """Compare a staged dataset with the arrays that it must hold, and write its manifest.

    h5py drops the error of a write that fails while an array is closed, so only reading proves that it is complete.
    """
    n_expected = 0
    with h5py.File(staging / DATA_FILE, "r") as file:
        for i, arrays in enumerate(expected):
            n_expected += 1
            for name, array in arrays.items():
                stored = file.get(f"episode_{i}/{name}")
                if stored is None or not np.array_equal(stored[()], array, equal_nan=True):
                    raise ZestError(f"{name} of episode {i} of {dataset_id} was not written whole; is the disk full?")
        if len(file) != n_expected:
            raise ZestError(f"{len(file)} of {n_expected} episodes of {dataset_id} were written; try again")
    files = [path for path in sorted(staging.rglob("*")) if path.is_file() and path.name != CARD_FILE]
    digests = {path.relative_to(staging).as_posix(): artifacts.hash_file(path) for path in files}
    artifacts.write_json(staging / MANIFEST_FILE, digests)


def _arrays_on_disk(recording: Recording) -> dict[str, NDArray[Any]]:
    """Return the arrays of one episode by their names on disk."""
    ends = np.zeros(len(recording.actions), dtype=bool)
    ends[-1] = True
    return {
        "observations": recording.obs,
        "actions": recording.actions,
        "rewards": recording.gt_reward[1:],
        "terminations": ends & recording.terminated,
        "truncations": ends & (not recording.terminated),
        "infos/state/qpos": recording.qpos,
        "infos/state/qvel": recording.qvel,
        "infos/gt/reward": recording.gt_reward,
        "infos/gt/success": recording.gt_success,
    }


def _build_new(
    root: Path, dataset_id: str, recordings: Sequence[Recording], env_spec: str, fields: Mapping[str, Any]
) -> None:
    os.environ["MINARI_DATASETS_PATH"] = str(root)  # of this child process only
    import gymnasium
    import minari
    from minari.data_collector import EpisodeBuffer

    spec = gymnasium.envs.registration.EnvSpec.from_json(env_spec)
    buffers = []
    for i, recording in enumerate(recordings):
        arrays = _arrays_on_disk(recording)
        infos = {
            "state": {key: arrays.pop(f"infos/state/{key}") for key in ("qpos", "qvel")},
            "gt": {key: arrays.pop(f"infos/gt/{key}") for key in ("reward", "success")},
        }
        buffers.append(EpisodeBuffer(id=i, seed=recording.seed, infos=infos, **arrays))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Minari warns of every optional field that is not given
        minari.create_dataset_from_buffers(dataset_id, buffers, env=spec, eval_env=spec, **fields)


@contextmanager
def _staged(dataset_id: str, n_bytes: int) -> Iterator[Path]:
    """Lock the folder of a new dataset, and yield one that is renamed to it at the end; raises as `write_dataset`."""
    final = dataset_path(dataset_id)
    with artifacts.lock(final):
        if exists(dataset_id):
            raise BadInput(f"dataset {dataset_id} exists already; choose another name or delete {final}")
        artifacts.check_free_space(final.parent, n_bytes)
        with artifacts.staged_folder(final) as staging:
            yield staging


def write_dataset(
    dataset_id: str,
    recordings: Sequence[Recording],
    *,
    env_spec: str,
    ref_min_score: float,
    ref_max_score: float,
    algorithm_name: str,
    description: str,
    zest: Mapping[str, Any],
) -> Path:
    """Write collected episodes as a new Minari dataset; rewards are the ground truth until it is relabeled.

    Args:
        dataset_id: ``namespace/name-vN``; must not exist.
        recordings: the episodes.
        env_spec: Gymnasium EnvSpec as JSON.
        ref_min_score: ground-truth return of the robot doing nothing (0 on the normalized scale).
        ref_max_score: mean ground-truth return of the expert (100 on the normalized scale).
        algorithm_name: the policy that acted.
        description: one paragraph for readers.
        zest: how the dataset was made; kept in the metadata.

    Returns:
        The dataset's folder.

    Raises:
        BadInput: bad id, no episodes, or a dataset of this id exists.
        ZestError: the disk is full or read-only; nothing is left behind.
    """
    if not recordings:
        raise BadInput("a dataset must have at least 1 episode, got 0; collect some first")
    fields = {
        "ref_min_score": ref_min_score,
        "ref_max_score": ref_max_score,
        "algorithm_name": algorithm_name,
        "description": description,
    }
    n_bytes = sum(r.obs.nbytes + r.actions.nbytes + r.qpos.nbytes + r.qvel.nbytes for r in recordings)
    with _staged(dataset_id, 2 * n_bytes) as staging:
        write_in_child("the dataset", _build_new, staging / "root", dataset_id, recordings, env_spec, fields)
        (staging / "root" / dataset_id / "data").rename(staging / "data")
        shutil.rmtree(staging / "root")
        _set_metadata(staging / METADATA_FILE, zest=dict(zest))
        _seal(staging, dataset_id, map(_arrays_on_disk, recordings))
    return dataset_path(dataset_id)


def _build_episodes(
    root: Path, dataset_id: str, episodes: Sequence[Mapping[str, Any]], env_spec: str | None, fields: Mapping[str, Any]
) -> None:
    os.environ["MINARI_DATASETS_PATH"] = str(root)  # of this child process only
    import gymnasium
    import minari
    from minari.data_collector import EpisodeBuffer

    spec = None if env_spec is None else gymnasium.envs.registration.EnvSpec.from_json(env_spec)
    buffers = [EpisodeBuffer(id=i, **episode) for i, episode in enumerate(episodes)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Minari warns of every optional field that is not given
        minari.create_dataset_from_buffers(dataset_id, buffers, env=spec, jpeg_encoding=False, **fields)


def write_episodes(
    dataset_id: str,
    episodes: Sequence[Mapping[str, Any]],
    *,
    observation_space: Any,
    action_space: Any,
    env_spec: str | None,
    description: str,
    ref_min_score: float | None = None,
    ref_max_score: float | None = None,
) -> Path:
    """Write episodes of any environment as a new Minari dataset.

    Args:
        dataset_id: ``namespace/name-vN``; must not exist.
        episodes: of each the arguments of a Minari EpisodeBuffer, as arrays; see `zest_rl.types` for their lengths.
        observation_space: of the environment.
        action_space: of the environment.
        env_spec: Gymnasium EnvSpec as JSON; None where it cannot be stored.
        description: one paragraph for readers.
        ref_min_score: return that counts as 0 %.
        ref_max_score: return that counts as 100 %.

    Returns:
        The dataset's folder.

    Raises:
        BadInput: bad id, a dataset of this id exists, or one reference score without or not below the other.
        ZestError: the disk is full or read-only; nothing is left behind.
    """
    fields = {"observation_space": observation_space, "action_space": action_space, "description": description}
    references = {"ref_min_score": ref_min_score, "ref_max_score": ref_max_score}
    given = {name: score for name, score in references.items() if score is not None}
    if given and not (len(given) == 2 and -math.inf < given["ref_min_score"] < given["ref_max_score"] < math.inf):
        raise BadInput(
            f"reference scores must be two finite numbers, that of 0 % below that of 100 %, or none, got {references}"
        )
    arrays = [by_path({name: part for name, part in episode.items() if name != "seed"}) for episode in episodes]
    n_bytes = sum(array.nbytes for of_episode in arrays for array in of_episode.values())
    with _staged(dataset_id, 2 * n_bytes) as staging:
        write_in_child("the dataset", _build_episodes, staging / "root", dataset_id, episodes, env_spec, fields)
        (staging / "root" / dataset_id / "data").rename(staging / "data")
        shutil.rmtree(staging / "root")
        _set_metadata(staging / METADATA_FILE, **given)  # Minari keeps them beside an eval_env alone
        _seal(staging, dataset_id, arrays)
    return dataset_path(dataset_id)


class Trajectories(Protocol):
    """Episodes that can be written with new rewards."""

    @property
    def dataset_id(self) -> str:
        """The Minari id that they have, or would have."""

    @property
    def n_steps(self) -> Sequence[int]:
        """T of every episode."""

    @property
    def n_bytes(self) -> int:
        """Approximate size of the files that `fill` writes."""

    def fingerprint(self) -> str:
        """64 hex digits over everything that training may see, except the rewards."""

    def rewards_to_keep(self) -> Sequence[FloatArray | None]:
        """Rewards (T,) of every episode to keep beside the new ones; None, or all NaN, if there are none."""

    def fill(self, folder: Path) -> None:
        """Write a Minari dataset's `DATA_FILE` and `METADATA_FILE` to `folder`, without all episodes in memory.

        Called in a child process. Missing rewards are written as NaN.
        """

    def written(self) -> Iterator[Mapping[str, NDArray[Any]]]:
        """Yield for every episode the arrays that `fill` must have written, by their names on disk."""


@dataclass(frozen=True)
class DatasetCopy:
    """The `Trajectories` of a Minari dataset, whose files are copied; made by `of` from an open dataset."""

    dataset_id: str
    path: Path
    """Folder of the dataset."""
    n_steps: Sequence[int]
    """T of every episode."""
    sha256: str
    rewards: Sequence[FloatArray | None]
    file_sha256: Mapping[str, str]
    """Of the files that are copied, by name."""

    @classmethod
    def of(cls, ds: Dataset) -> Self:
        """Read the fields from an open dataset."""
        return cls(ds.id, ds.path, ds.n_steps(), ds.fingerprint(), ds.rewards_to_keep(), ds.file_sha256())

    @property
    def n_bytes(self) -> int:
        """Size of the HDF5 file."""
        return (self.path / DATA_FILE).stat().st_size

    def fingerprint(self) -> str:
        """See `zest_rl.data.reader.Dataset.fingerprint`."""
        return self.sha256

    def rewards_to_keep(self) -> Sequence[FloatArray | None]:
        """See `zest_rl.data.reader.Dataset.rewards_to_keep`."""
        return self.rewards

    def fill(self, folder: Path) -> None:
        """Copy the two files.

        Raises:
            ZestError: a file was changed since it was read.
        """
        (folder / "data").mkdir()
        for name, sha256 in self.file_sha256.items():
            shutil.copyfile(self.path / name, folder / name)
            if artifacts.hash_file(folder / name) != sha256:
                raise ZestError(f"{name} of dataset {self.dataset_id} was changed since it was read")

    def written(self) -> Iterator[Mapping[str, NDArray[Any]]]:
        """Nothing: a copy of a file that fails raises."""
        return ({} for _ in self.n_steps)


def _build_scored(trajectories: Trajectories, folder: Path, scored: Sequence[Mapping[str, FloatArray]]) -> None:
    trajectories.fill(folder)
    with open_hdf5(folder / DATA_FILE):
        pass  # nothing in it leads to another file, so that writing to it changes it alone
    with h5py.File(folder / DATA_FILE, "r+") as file:
        for i, arrays in enumerate(scored):
            group = file[f"episode_{i}"]
            if "infos/zest" in group:
                del group["infos/zest"]
            for name, array in arrays.items():
                if name in group:
                    del group[name]
                group[name] = array


def _scored(reward: FloatArray, score: FloatArray | None, source: FloatArray | None) -> dict[str, FloatArray]:
    """Return the new arrays of an episode by their names on disk."""
    arrays = {"rewards": reward} | ({} if score is None else {"infos/zest/score": score})
    if source is not None and not np.isnan(source).all():
        arrays[SOURCE_REWARD] = np.concatenate([np.zeros(1, np.float32), source])
    return arrays


def write_scored(
    trajectories: Trajectories,
    dataset_id: str,
    rewards: Sequence[FloatArray],
    scores: Sequence[FloatArray] | None,
    *,
    description: str,
    zest: Mapping[str, Any],
    extra: Callable[[Path], None] = lambda folder: None,
) -> Path:
    """Write episodes with new rewards; everything else, ground truth included, stays the same bit for bit.

    Original rewards that are not the kitchen's ground truth are kept as ``infos/source/reward``.

    Args:
        trajectories: the episodes.
        dataset_id: the new id; must not exist.
        rewards: (T,) float32 per episode.
        scores: (T+1,) float32 per episode, kept as ``infos/zest/score``; None without any.
        description: appended to the source's description.
        zest: record of the stage that made the rewards, kept in the metadata beside those of earlier stages.
        extra: called with the staged folder, to write further files to it.

    Returns:
        The new dataset's folder.

    Raises:
        BadInput: the new id exists; lengths do not fit; a value is not finite.
        ZestError: the disk is full or read-only; nothing is left behind.
    """
    n_steps = list(trajectories.n_steps)
    arrays = [(rewards, 0)] if scores is None else [(rewards, 0), (scores, 1)]
    if any([len(array) - n_more for array in of_episodes] != n_steps for of_episodes, n_more in arrays):
        raise BadInput("rewards must have length T and scores length T+1 for every episode of the source dataset")
    if broken := {i for of_all, _ in arrays for i, array in enumerate(of_all) if not np.isfinite(array).all()}:
        raise BadInput(f"rewards and scores must be finite, got NaN or infinity in episodes {sorted(broken)}")
    with _staged(dataset_id, 2 * trajectories.n_bytes) as staging:
        kept, of_frames = trajectories.rewards_to_keep(), scores or (None,) * len(rewards)
        scored = [_scored(*new) for new in zip(rewards, of_frames, kept, strict=True)]
        write_in_child("the dataset", _build_scored, trajectories, staging, scored)
        metadata = artifacts.read_json(staging / METADATA_FILE)
        earlier = metadata.get("zest", {})
        for stage in ("relabel", "given"):  # the rewards of before
            earlier.pop(stage, None)
        _set_metadata(
            staging / METADATA_FILE,
            dataset_id=dataset_id,
            description=f"{metadata.get('description', '')} {description}".strip(),
            zest={**earlier, **zest},
        )
        extra(staging)
        _seal(staging, dataset_id, ({**old, **new} for old, new in zip(trajectories.written(), scored, strict=True)))
    return dataset_path(dataset_id)
