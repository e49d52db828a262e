"""Minari datasets on disk → episodes (`zest_rl.data.writer` is the way back).

Layout of one dataset, alignment in `zest_rl.types`::

    ROOT/zest/kitchen-micro-noisy-v0/
      zest_manifest.json        sha256 of every file below; a change on disk is noticed
      data/metadata.json        Minari's metadata, and under "zest" how the dataset was made
      data/main_data.hdf5       episode_i/{observations (T+1, obs_dim), actions (T, act_dim), rewards (T,),
                                terminations (T,), truncations (T,), infos/state/{qpos, qvel} (T+1, n),
                                infos/gt/{reward, success} (T+1,), infos/zest/score (T+1,) once relabeled}

Datasets of other environments may hold observations in a group (`zest_rl.data.observations`), no state and no ground
truth; a relabeled copy keeps their own rewards as ``infos/source/{reward, success}`` (T+1,), 0 at the reset.

`open_dataset` verifies the files once for everything that is read. Ground truth is read by `Dataset.truth` alone;
`Dataset.episodes` and `Dataset.states` never open it.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from zest_rl.data.env_specs import entry_points
from zest_rl.data.observations import acts_discretely, entries, is_numbers, numbers, stored_rows
from zest_rl.data.provenance import DatasetRecord
from zest_rl.errors import BadInput, ZestError, nearest
from zest_rl.runtime import artifacts
from zest_rl.types import Episode, FloatArray, GroundTruth

DATASET_ID = re.compile(r"(?:[A-Za-z0-9][\w.-]+/)*[A-Za-z0-9][\w.-]*-v\d+")
DATA_FILE, METADATA_FILE, MANIFEST_FILE = "data/main_data.hdf5", "data/metadata.json", "zest_manifest.json"
SOURCE_REWARD, SOURCE_SUCCESS = "infos/source/reward", "infos/source/success"
"""Original rewards and successes (T+1,) in a relabeled dataset of another environment."""
_GT_REWARD = "infos/gt/reward"


def datasets_root() -> Path:
    """Minari's folder of local datasets: ``$MINARI_DATASETS_PATH``, else ``~/.minari/datasets``. Not created here."""
    return artifacts.folder_of("MINARI_DATASETS_PATH")


def dataset_path(dataset_id: str) -> Path:
    """Return the folder of a dataset id, whether or not it exists.

    Raises:
        BadInput: the id is not of the form ``namespace/name-vN`` (so ``..`` cannot lead out of the root).
    """
    if not DATASET_ID.fullmatch(dataset_id) or ".." in dataset_id:
        raise BadInput(
            f"a dataset id must look like 'namespace/name-v0' (letters, digits, '.', '_', '-'; namespace of at least "
            f"2 characters), got {dataset_id!r}"
        )
    return datasets_root() / dataset_id


def list_datasets() -> list[str]:
    """Return the ids of all complete datasets under the root, sorted."""
    root = datasets_root()
    return sorted(folder.relative_to(root).as_posix() for folder in _datasets_in(root))


def _datasets_in(folder: Path, above: tuple[Path, ...] = ()) -> Iterator[Path]:
    """Yield the datasets below a folder, links to folders included; `above`: the folders that led here."""
    here = folder.resolve()
    if here in above:  # a link that leads back
        return
    with suppress(OSError):  # no root yet, or a folder of somebody else
        for entry in folder.iterdir():
            if entry.name.startswith(".") or not entry.is_dir():
                continue
            if (entry / METADATA_FILE).exists():
                yield entry
            else:
                yield from _datasets_in(entry, (*above, here))


def exists(dataset_id: str) -> bool:
    """Whether a complete dataset of this id is on disk."""
    return (dataset_path(dataset_id) / METADATA_FILE).exists()


@dataclass(frozen=True)
class Dataset:
    """An open dataset whose files match their hashes; see `open_dataset`."""

    id: str
    path: Path
    """Its folder."""
    metadata: Mapping[str, Any]
    """The whole of ``metadata.json``; `record` is the typed part of it."""
    groups: Mapping[str, h5py.Group]
    """Episodes by their names in the HDF5 file, ``episode_0`` first; gone once the dataset is closed."""

    @cached_property
    def record(self) -> DatasetRecord:
        """Environment, scale, and how it was made."""
        return DatasetRecord.from_metadata(self.id, self.metadata)

    @property
    def file(self) -> Path:
        """The HDF5 file."""
        return self.path / DATA_FILE

    def file_sha256(self) -> dict[str, str]:
        """Return the sha256 of the HDF5 file and of the metadata, by name: from the manifest, which was checked."""
        manifest = self.path / MANIFEST_FILE
        known: dict[str, str] = artifacts.read_json(manifest) if manifest.exists() else {}
        names = (DATA_FILE, METADATA_FILE)
        return {name: known.get(name) or artifacts.hash_file(self.path / name) for name in names}

    def episodes(self, *, discrete: bool = False) -> list[Episode]:
        """Read what a trainer may see of every episode; a Dict of observations is flattened (`observations.numbers`).

        Actions of several dimensions are flattened; those of a Discrete space, (T,), are read as (T, 1) if `discrete`.

        Raises:
            BadInput: an episode without steps, lengths that do not fit, NaN, observations that are pictures alone,
                discrete actions without `discrete`.
            ZestError: the file is damaged.
        """

        def read(group: h5py.Group) -> Episode:
            ends = self._array(group, "terminations", bool)
            return Episode(
                obs=self._observations(group),
                actions=self._actions(group, discrete),
                rewards=self._array(group, "rewards", np.float32),
                terminated=bool(len(ends) and ends[-1]),
            )

        return self._each(read)

    def n_steps(self) -> list[int]:
        """Read T of every episode; rewards need not be recorded.

        Raises:
            BadInput: rewards of another length.
        """

        def read(group: h5py.Group) -> int:
            n_steps = len(self._array(group, "terminations", bool))
            if "rewards" in group and len(group["rewards"]) != n_steps:
                raise BadInput(f"rewards must be as many as terminations, {n_steps}, got {len(group['rewards'])}")
            return n_steps

        return self._each(read)

    def rewards(self) -> list[FloatArray]:
        """Read the rewards (T,) of every episode.

        Raises:
            BadInput: there are none.
        """
        return self._arrays("rewards")

    def states(self) -> list[NDArray[np.float64]]:
        """Read the simulator positions (T+1, nq) of every episode.

        Raises:
            BadInput: no recorded state, lengths that do not fit, NaN.
        """

        def read(group: h5py.Group) -> NDArray[np.float64]:
            qpos = self._array(group, "infos/state/qpos", np.float64)
            n_steps = len(self._array(group, "rewards", np.float32))
            if n_steps == 0:
                raise BadInput("an episode must have at least 1 step, got 0; drop empty episodes from the dataset")
            if qpos.ndim != 2 or len(qpos) != n_steps + 1:
                raise BadInput(f"infos/state/qpos must have shape ({n_steps + 1}, nq), got {qpos.shape}")
            if not np.isfinite(qpos).all():
                raise BadInput("infos/state/qpos must be finite, got NaN or infinity; drop the episode")
            return qpos

        return self._each(read)

    @property
    def has_truth(self) -> bool:
        """Whether any episode holds the hand-designed rewards; `truth` refuses a dataset where some do not."""
        return any(_GT_REWARD in group for group in self.groups.values())

    def truth(self) -> list[GroundTruth]:
        """Read the hand-designed rewards of every episode: for evaluation and reports only, never for a trainer.

        Raises:
            BadInput: no ground truth is recorded.
        """
        return self._each(
            lambda group: GroundTruth(
                rewards=self._array(group, _GT_REWARD, np.float32)[1:],
                success=bool(self._array(group, "infos/gt/success", bool).any()),
            )
        )

    def scores(self) -> list[FloatArray]:
        """Read the ZeST scores (T+1,) of every episode.

        Raises:
            BadInput: the dataset was not relabeled.
        """
        return self._arrays("infos/zest/score")

    def source_rewards(self) -> list[FloatArray] | None:
        """Read the rewards (T,) that a dataset of another environment had before it was relabeled; None without any."""
        if not all(SOURCE_REWARD in group for group in self.groups.values()):
            return None
        return [rewards[1:] for rewards in self._arrays(SOURCE_REWARD)]

    def rewards_to_keep(self) -> list[FloatArray | None]:
        """Read the original rewards (T,) that a relabeled copy keeps; None for ground truth, or if there are none."""

        def read(group: h5py.Group) -> FloatArray | None:
            if _GT_REWARD in group:
                return None
            if SOURCE_REWARD in group:
                return self._array(group, SOURCE_REWARD, np.float32)[1:]
            return self._array(group, "rewards", np.float32) if "rewards" in group else None

        return self._each(read)

    def fingerprint(self) -> str:
        """Hash everything that relabeling and training may see, except rewards: observations, actions, ends, states."""

        def digest(group: h5py.Group) -> str:
            if "observations" not in group:
                raise BadInput(f"dataset {self.id} has no 'observations' in {group.name}")
            actions = self._array(group, "actions", np.float32)
            ends = self._array(group, "terminations", bool)
            arrays = [actions, np.array([bool(len(ends) and ends[-1])])]
            if "infos/state/qpos" in group:
                arrays.append(self._array(group, "infos/state/qpos", np.float64))
            return artifacts.hash_stream(itertools.chain(_observation_parts(group["observations"]), arrays))

        return artifacts.hash_json(self._each(digest))

    def describe(self) -> dict[str, Any]:
        """Identity, environment, scale and provenance, JSON-ready, for the ``meta.json`` of a policy trained on it.

        Command, versions and machine are left out, so that an equal dataset made again has an equal description.
        `DatasetRecord.of_run` reads it.

        Raises:
            BadInput: a policy could not be evaluated on the dataset, or as in `episodes`.
        """
        for key in ("env_spec", "ref_min_score", "ref_max_score"):
            if self.metadata.get(key) is None and not self.record.is_foreign:
                raise BadInput(
                    f"dataset {self.id} has no {key} in its metadata, so a policy could not be evaluated on it; "
                    "give env, eval_env and both reference scores when the dataset is made"
                )
        return {
            "id": self.id,
            "sha256": self.fingerprint(),
            "rewards_sha256": artifacts.hash_arrays(*(episode.rewards for episode in self.episodes())),
            "env_spec": self.record.env_spec,
            "ref_min_score": self.record.ref_min_score,
            "ref_max_score": self.record.ref_max_score,
            "zest": {
                stage: {key: value for key, value in facts.items() if key != "provenance"}
                for stage, facts in self.metadata.get("zest", {}).items()
            },
        }

    def kitchen_task(self) -> str:
        """Return the kitchen task of the dataset.

        Raises:
            BadInput: its environment is not the kitchen.
        """
        if self.record.task is None:
            raise BadInput(
                f"dataset {self.id} is of environment {self.record.env.get('id')!r}; frames can be rendered for "
                "zest/Kitchen-v1 only, so collect a dataset with `zest collect`; `zest relabel` alone takes any, see "
                "docs/any_dataset.md"
            )
        return self.record.task

    def _each(self, read: Callable[[h5py.Group], Any]) -> list[Any]:
        results = []
        for name, group in self.groups.items():
            try:
                results.append(read(group))
            except BadInput as error:
                raise BadInput(f"{name} of dataset {self.id}: {error}") from error
            except OSError as error:
                raise ZestError(f"{name} of dataset {self.id} is damaged ({error}); make it again") from error
        return results

    def _arrays(self, name: str) -> list[FloatArray]:
        return self._each(lambda group: self._array(group, name, np.float32))

    def _array(self, group: h5py.Group, name: str, dtype: type) -> NDArray[Any]:
        if name not in group:
            raise BadInput(
                f"dataset {self.id} has no {name!r} in {group.name}; record it when the dataset is made "
                "(zest_rl.data.reader describes the layout)"
            )
        node = group[name]
        if not isinstance(node, h5py.Dataset):
            raise BadInput(f"{name!r} in {group.name} of dataset {self.id} must be one flat array, got a group")
        return np.asarray(node[()], dtype=dtype)

    def _observations(self, group: h5py.Group) -> FloatArray:
        node = group.get("observations")
        if isinstance(node, h5py.Group) or (node is not None and node.ndim != 2):
            return numbers(node)
        return self._array(group, "observations", np.float32)

    def _actions(self, group: h5py.Group, discrete: bool) -> FloatArray:
        actions = self._array(group, "actions", np.float32)
        is_discrete = acts_discretely(group)
        if is_discrete and not discrete:
            raise BadInput("its actions are discrete, a policy here acts by continuous ones; `zest export` takes them")
        return (
            actions.reshape(len(actions), math.prod(actions.shape[1:])) if actions.ndim > 1 or is_discrete else actions
        )


def _verified_metadata(dataset_id: str, folder: Path) -> dict[str, Any]:
    """Return a dataset's metadata after comparing its files with their hashes; raises as `open_dataset`."""
    if not exists(dataset_id):
        raise BadInput(
            f"there is no dataset {dataset_id!r} under the Minari root; {nearest(dataset_id, list_datasets())}. "
            "Make one with `zest collect`, or set MINARI_DATASETS_PATH to the folder that holds it"
        )
    if (folder / MANIFEST_FILE).exists():
        for name, digest in artifacts.read_json(folder / MANIFEST_FILE).items():
            path = folder / name
            if not path.exists() or artifacts.hash_file(path) != digest:
                raise ZestError(
                    f"{name} of dataset {dataset_id} is missing or was changed since it was written; make the dataset "
                    f"again, or, if you changed it on purpose, delete its {MANIFEST_FILE}"
                )
    metadata: dict[str, Any] = artifacts.read_json(folder / METADATA_FILE)
    for key in ("env_spec", "eval_env_spec"):
        if metadata.get(key):
            entry_points(metadata[key], f"the {key} of dataset {dataset_id}")
    return metadata


@contextmanager
def open_dataset(dataset_id: str) -> Iterator[Dataset]:
    """Open a dataset after comparing its files with their hashes.

    Reading runs no code; before an environment is built from the env_spec, `zest_rl.data.env_specs` must check it.

    Raises:
        BadInput: no such dataset (the nearest ids are named), an invalid env_spec, a storage other than HDF5, or
            missing episodes.
        ZestError: a file is damaged or was changed since it was written.
    """
    path = dataset_path(dataset_id)
    metadata = _verified_metadata(dataset_id, path)
    try:
        file = h5py.File(path / DATA_FILE, "r")
    except OSError as error:
        raise BadInput(f"dataset {dataset_id} cannot be read as HDF5 ({error}); only that storage is read") from error
    with file:
        names = [f"episode_{i}" for i in range(len(file))]
        if not names:
            raise BadInput(f"dataset {dataset_id} has no episodes; collect it again")
        if missing := [name for name in names if name not in file]:
            raise BadInput(
                f"dataset {dataset_id} must hold {names[0]}, … {names[-1]}, as Minari needs it, but {missing[0]} "
                f"is missing from its {len(file)} groups; rename them, and set total_episodes in metadata.json"
            )
        yield Dataset(dataset_id, path, metadata, {name: file[name] for name in names})


def _observation_parts(node: h5py.Group | h5py.Dataset) -> Iterator[NDArray[Any]]:
    """Yield an episode's observations in parts: raw pictures, a few steps at a time, and numbers as float32."""
    for entry in entries(node).values():
        if is_numbers(entry):
            yield np.asarray(entry[()], dtype=np.float32)
        else:
            yield from stored_rows(entry)
