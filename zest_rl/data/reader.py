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
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from zest_rl.data.episode_arrays import EpisodeArrays
from zest_rl.data.folders import DATA_FILE, MANIFEST_FILE, METADATA_FILE, verified_metadata
from zest_rl.data.folders import DATASET_ID as DATASET_ID
from zest_rl.data.folders import dataset_path as dataset_path
from zest_rl.data.folders import datasets_root as datasets_root
from zest_rl.data.folders import exists as exists
from zest_rl.data.folders import list_datasets as list_datasets
from zest_rl.data.hdf5 import mapped_errors, open_hdf5, read_array
from zest_rl.data.observations import acts_discretely, entries, is_numbers, joined, stored_rows
from zest_rl.data.picture_forms import PictureForm, form_of
from zest_rl.data.provenance import DatasetRecord
from zest_rl.errors import BadInput
from zest_rl.runtime import artifacts
from zest_rl.types import Episode, FloatArray, GroundTruth, check_finite

SOURCE_REWARD, SOURCE_SUCCESS = "infos/source/reward", "infos/source/success"
"""Original rewards and successes (T+1,) in a relabeled dataset of another environment."""
SUCCESS = (SOURCE_SUCCESS, "infos/success", "infos/is_success")
"""Success by step in datasets of other robots: relabeled LeRobot's; Adroit's and mazes'; Fetch's."""
_GT_REWARD, _QPOS = "infos/gt/reward", "infos/state/qpos"


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
    lengths: Mapping[str, int]
    """T of every episode, by the same names."""

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
            BadInput: lengths that do not fit, NaN, observations that are pictures alone, episodes of unequal width,
                discrete actions without `discrete`.
            ZestError: the file is damaged.
        """

        def read(arrays: EpisodeArrays) -> Episode:
            return Episode(
                obs=arrays.observations(self._forms),
                actions=arrays.actions(discrete),
                rewards=arrays.read("rewards"),
                terminated=arrays.is_terminated(),
            )

        episodes = self._each(read)
        self._check_alike([(episode.obs.shape[1], episode.actions.shape[1]) for episode in episodes])
        return episodes

    def n_steps(self) -> list[int]:
        """Return T of every episode."""
        return list(self.lengths.values())

    def rewards(self) -> list[FloatArray]:
        """Read the rewards (T,) of every episode.

        Raises:
            BadInput: there are none, or as in `episodes`.
        """
        return self._each(lambda arrays: arrays.read("rewards"))

    def states(self) -> list[NDArray[np.float64]]:
        """Read the simulator positions (T+1, nq) of every episode.

        Raises:
            BadInput: no recorded state, lengths that do not fit, NaN.
        """
        states = self._each(lambda arrays: arrays.read(_QPOS, np.float64, n_more=1, ndim=2))
        self._check_alike([qpos.shape[1:] for qpos in states])
        return states

    def successes(self) -> list[NDArray[np.bool_]] | None:
        """Read the success (T,) after each action, by the names that other robots' datasets give it; None without any.

        Raises:
            BadInput: an episode holds other than T or, with the reset's, T+1 of them.
        """

        def read(arrays: EpisodeArrays) -> NDArray[np.bool_]:
            name = next(name for name in SUCCESS if name in arrays.group)
            n_more = int((getattr(arrays.group[name], "shape", None) or ())[:1] == (arrays.n_steps + 1,))
            values = arrays.read(name, n_more=n_more, ndim=None)
            return values[n_more:].reshape(arrays.n_steps, -1)[:, 0].astype(bool)

        if not all(any(name in group for name in SUCCESS) for group in self.groups.values()):
            return None
        return self._each(read)

    @property
    def suits_agents(self) -> bool:
        """Whether the package's agents can learn from it: numbers are observed, actions are continuous in [-1, 1]."""
        return all(
            any(map(is_numbers, entries(group["observations"]).values()))
            and not acts_discretely(group)
            and np.abs(group["actions"][()]).max() <= 1
            for group in self.groups.values()
        )

    @property
    def is_hand_rewarded(self) -> bool:
        """Whether any episode holds the kitchen's hand-designed rewards beside its own."""
        return any(_GT_REWARD in group for group in self.groups.values())

    @property
    def has_truth(self) -> bool:
        """Whether there is something to judge by; `truth` refuses a dataset where some episodes lack it."""
        return self.is_hand_rewarded or self._own_truth is not None

    def truth(self) -> list[GroundTruth]:
        """Read what judges every episode: for evaluation and reports only, never for a trainer.

        The hand-designed rewards of the kitchen; of another robot its own rewards and successes, and where it has
        successes alone, these are its rewards.

        Raises:
            BadInput: none is recorded.
        """
        if self.is_hand_rewarded or self._own_truth is None:
            return self._each(
                lambda arrays: GroundTruth(
                    rewards=arrays.read(_GT_REWARD, n_more=1)[1:],
                    success=bool(arrays.read("infos/gt/success", n_more=1).any()),
                )
            )
        return self._own_truth

    @cached_property
    def _own_truth(self) -> list[GroundTruth] | None:
        """What another robot's dataset holds to judge by; None without any."""
        own, successes = self._own_rewards(), self.successes()
        if self.record.task is not None or (own is None and successes is None):
            return None
        told = [None] * len(self.groups) if successes is None else [bool(success.any()) for success in successes]
        rewards = [success.astype(np.float32) for success in successes or ()] if own is None else own
        return [GroundTruth(*episode) for episode in zip(rewards, told, strict=True)]

    def _own_rewards(self) -> list[FloatArray] | None:
        """Read the rewards (T,) that were not made here; None without any, or where some are no finite numbers."""
        name = "rewards" if self.record.has_recorded_rewards else SOURCE_REWARD
        if not all(name in group for group in self.groups.values()):
            return None
        own = [rewards for rewards in self.rewards_to_keep() if rewards is not None and np.isfinite(rewards).all()]
        return own if len(own) == len(self.groups) else None

    def scores(self) -> list[FloatArray]:
        """Read the ZeST scores (T+1,) of every episode.

        Raises:
            BadInput: the dataset was not relabeled, or as in `episodes`.
        """
        return self._each(lambda arrays: arrays.read("infos/zest/score", n_more=1))

    def source_rewards(self) -> list[FloatArray] | None:
        """Read the rewards (T,) that a dataset of another environment had before it was relabeled; None without any.

        They are its own: NaN stays where it had NaN.
        """
        if not all(SOURCE_REWARD in group for group in self.groups.values()):
            return None
        return self._each(lambda arrays: arrays.read(SOURCE_REWARD, n_more=1, finite=False)[1:])

    def rewards_to_keep(self) -> list[FloatArray | None]:
        """Read the original rewards (T,) that a relabeled copy keeps, NaN included; None for ground truth or none."""

        def read(arrays: EpisodeArrays) -> FloatArray | None:
            if _GT_REWARD in arrays.group:
                return None
            if SOURCE_REWARD in arrays.group:
                return arrays.read(SOURCE_REWARD, n_more=1, finite=False)[1:]
            return arrays.read("rewards", finite=False) if "rewards" in arrays.group else None

        return self._each(read)

    def fingerprint(self) -> str:
        """Hash everything that relabeling and training may see, except rewards: observations, actions, ends, states.

        Raises:
            BadInput: as in `episodes`, but observations may be pictures alone, and actions discrete.
        """
        widths: list[object] = []

        def digest(arrays: EpisodeArrays) -> str:
            observed = arrays.observed()
            forms = {joined("observations", path): form for path, form in self._forms.items()}
            numeric = {path: entry for path, entry in observed.items() if is_numbers(entry, forms.get(path))}
            rest = [arrays.read("actions", ndim=None), np.array([arrays.is_terminated()])]
            widths.append({"actions": rest[0].shape[1:], **{path: numeric[path].shape[1:] for path in numeric}})
            if _QPOS in arrays.group:
                rest.append(arrays.read(_QPOS, np.float64, n_more=1, ndim=None))
            parts = (
                [check_finite(path, read_array(entry, np.float32))] if path in numeric else stored_rows(entry)
                for path, entry in observed.items()
            )
            return artifacts.hash_stream(itertools.chain(*parts, rest))

        digests = self._each(digest)
        self._check_alike(widths)
        return artifacts.hash_json(digests)

    def describe(self) -> dict[str, Any]:
        """Identity, environment, scale and provenance, JSON-ready, for the ``meta.json`` of a policy trained on it.

        Command, versions and machine are left out, so that an equal dataset made again has an equal description.
        `DatasetRecord.of_run` reads it.

        Raises:
            BadInput: as in `fingerprint` and `rewards`.
        """
        return {
            "id": self.id,
            "sha256": self.fingerprint(),
            "rewards_sha256": artifacts.hash_arrays(*self.rewards()),
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

    @cached_property
    def _forms(self) -> dict[str, PictureForm]:
        """Forms of the observations of the first episode, by their paths below ``observations``."""
        observations = next(iter(self.groups.values())).get("observations")
        return {} if observations is None else {path: form_of(entry) for path, entry in entries(observations).items()}

    def _each(self, read: Callable[[EpisodeArrays], Any]) -> list[Any]:
        results = []
        for name, group in self.groups.items():
            what = f"{name} of dataset {self.id}"
            with mapped_errors(what):
                try:
                    results.append(read(EpisodeArrays(group, self.lengths[name])))
                except BadInput as error:
                    raise BadInput(f"{what}: {error}") from error
        return results

    def _check_alike(self, widths: Sequence[object]) -> None:
        """Refuse episodes whose numbers are not those of the first."""
        for name, width in zip(self.groups, widths, strict=True):
            if width != widths[0]:
                raise BadInput(
                    f"the episodes of dataset {self.id} must hold equally many numbers, got {widths[0]} in episode_0 "
                    f"and {width} in {name}; repair or drop it. Where floats may be pictures or numbers, declare "
                    "bounds in the observation space: pictures are in [0, 1]"
                )


@contextmanager
def open_dataset(dataset_id: str) -> Iterator[Dataset]:
    """Open a dataset after comparing its files with their hashes.

    Reading runs no code; before an environment is built from the env_spec, `zest_rl.data.env_specs` must check it.

    Raises:
        BadInput: no such dataset (the nearest ids are named), a file that is a link or is of another kind, metadata
            that break a rule or do not agree with the arrays, a storage other than HDF5, data outside the file
            (`zest_rl.data.hdf5`), or missing episodes.
        ZestError: a file is damaged or was changed since it was written.
    """
    path, what = dataset_path(dataset_id), f"dataset {dataset_id}"
    metadata = verified_metadata(dataset_id)
    if not (path / DATA_FILE).exists():
        raise BadInput(f"{what} cannot be read as HDF5 (it has no {DATA_FILE}); only that storage is read")
    with open_hdf5(path / DATA_FILE, what) as file:
        names = [f"episode_{i}" for i in range(len(file))]
        if not names:
            raise BadInput(f"{what} has no episodes; collect it again")
        if missing := [name for name in names if name not in file]:
            raise BadInput(
                f"{what} must hold {names[0]}, … {names[-1]}, as Minari needs it, but {missing[0]} is missing from its "
                f"{len(file)} groups; rename them, and set total_episodes in metadata.json"
            )
        groups = {name: file[name] for name in names}
        lengths = {name: _n_steps(group, what) for name, group in groups.items()}
        for key, n in (("total_episodes", len(names)), ("total_steps", sum(lengths.values()))):
            if metadata.get(key, n) != n:
                raise BadInput(
                    f"{METADATA_FILE} of {what} has {key} {metadata[key]}, but {DATA_FILE} holds {n}: one of them is "
                    f"not whole. Download or make the dataset again; or, if you changed it on purpose, correct {key}"
                )
        ds = Dataset(dataset_id, path, metadata, groups, lengths)
        _ = ds.record  # which refuses metadata that are not ours
        yield ds


def _n_steps(group: Any, what: str) -> int:
    """Return T of an episode."""
    ends = group.get("terminations") if isinstance(group, h5py.Group) else None
    if not isinstance(ends, h5py.Dataset) or len(ends.shape or ()) != 1:
        raise BadInput(
            f"{what} has no 'terminations' in {group.name}, one per step; record it when the dataset is made"
        )
    if not len(ends):
        raise BadInput(f"{what}: {group.name} must have at least 1 step, got 0; drop empty episodes from the dataset")
    return len(ends)
