"""Minari datasets on disk → episodes (`zest_rl.data.writer` is the way back).

Layout of one dataset, alignment in `zest_rl.types`::

    ROOT/zest/kitchen-micro-noisy-v0/
      zest_manifest.json        sha256 of every file below; a change on disk is noticed
      data/metadata.json        Minari's metadata, and under "zest" how the dataset was made
      data/main_data.hdf5       episode_i/{observations (T+1, obs_dim), actions (T, act_dim), rewards (T,),
                                terminations (T,), truncations (T,), infos/state/{qpos, qvel} (T+1, n),
                                infos/gt/{reward, success} (T+1,), infos/zest/score (T+1,) once relabeled}

Datasets of other environments may hold observations in a group (`zest_rl.data.observations`), no state and no ground
truth; once relabeled, what they came with is ``infos/source/{reward, success}`` (T+1,), 0 at the reset.

Ground truth is read by `read_ground_truth` alone; `read_episodes` and `read_states` never open it.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from zest_rl.data.env_specs import entry_points
from zest_rl.data.observations import acts_discretely, entries, is_numbers, numbers, stored_rows
from zest_rl.errors import BadInput, ZestError, nearest
from zest_rl.runtime import artifacts
from zest_rl.types import Episode, FloatArray, GroundTruth

DATASET_ID = re.compile(r"(?:[A-Za-z0-9][\w.-]+/)*[A-Za-z0-9][\w.-]*-v\d+")
DATA_FILE, METADATA_FILE, MANIFEST_FILE = "data/main_data.hdf5", "data/metadata.json", "zest_manifest.json"
SOURCE_REWARD, SOURCE_SUCCESS = "infos/source/reward", "infos/source/success"
"""Where the rewards and successes of another environment's dataset are kept (T+1,) when it is relabeled."""
_GT_REWARD = "infos/gt/reward"


def datasets_root() -> Path:
    """Minari's folder of local datasets: ``$MINARI_DATASETS_PATH``, else ``~/.minari/datasets``. Not created here."""
    return Path(os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets")


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
    found = (p.parent.parent.relative_to(root).as_posix() for p in root.glob(f"**/{METADATA_FILE}"))
    return sorted(name for name in found if not any(part.startswith(".") for part in name.split("/")))


def exists(dataset_id: str) -> bool:
    """Whether a complete dataset of this id is on disk."""
    return (dataset_path(dataset_id) / METADATA_FILE).exists()


def read_metadata(dataset_id: str) -> dict[str, Any]:
    """Return a dataset's metadata after checking that its files are as they were written.

    Whoever builds an environment from them checks them by `zest_rl.data.env_specs` first; reading runs no code of it.

    Raises:
        BadInput: no such dataset (the nearest are named), or an env_spec in it is none.
        ZestError: a file was damaged or changed since it was written.
    """
    folder = dataset_path(dataset_id)
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
def open_episodes(dataset_id: str) -> Iterator[tuple[h5py.File, list[str]]]:
    """Open the HDF5 file after checking all files as `read_metadata` does; yield it and its episodes' names, in order.

    Raises:
        BadInput: no such dataset, another storage than HDF5, or episodes are missing.
    """
    read_metadata(dataset_id)
    path = dataset_path(dataset_id) / DATA_FILE
    try:
        file = h5py.File(path, "r")
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
        yield file, names


def _array(group: h5py.Group, name: str, dtype: type, dataset_id: str) -> NDArray[Any]:
    if name not in group:
        raise BadInput(
            f"dataset {dataset_id} has no {name!r} in {group.name}; record it when the dataset is made "
            "(zest_rl.data.reader describes the layout)"
        )
    node = group[name]
    if not isinstance(node, h5py.Dataset):
        raise BadInput(f"{name!r} in {group.name} of dataset {dataset_id} must be one flat array, got a group")
    return np.asarray(node[()], dtype=dtype)


def _each(dataset_id: str, read: Callable[[h5py.Group], Any]) -> list[Any]:
    results = []
    with open_episodes(dataset_id) as (file, names):
        for name in names:
            try:
                results.append(read(file[name]))
            except BadInput as error:
                raise BadInput(f"{name} of dataset {dataset_id}: {error}") from error
            except OSError as error:
                raise ZestError(f"{name} of dataset {dataset_id} is damaged ({error}); make it again") from error
    return results


def _observations(group: h5py.Group, dataset_id: str) -> FloatArray:
    node = group.get("observations")
    if isinstance(node, h5py.Group) or (node is not None and node.ndim != 2):
        return numbers(node)
    return _array(group, "observations", np.float32, dataset_id)


def _actions(group: h5py.Group, dataset_id: str, discrete: bool) -> FloatArray:
    actions = _array(group, "actions", np.float32, dataset_id)
    whole = acts_discretely(group)
    if whole and not discrete:
        raise BadInput("its actions are discrete, a policy here acts by continuous ones; `zest export` takes them")
    return actions.reshape(len(actions), math.prod(actions.shape[1:])) if actions.ndim > 1 or whole else actions


def episode_names(dataset_id: str) -> list[str]:
    """Return the names of the episodes' groups in the HDF5 file, in order; raises as `open_episodes` does."""
    with open_episodes(dataset_id) as (_, names):
        return names


def read_episodes(dataset_id: str, *, discrete: bool = False) -> list[Episode]:
    """Read what a trainer may see of every episode; a Dict of observations is flattened (`observations.numbers`).

    Actions of several dimensions are flattened; those of a Discrete space (T,) are read as (T, 1) where `discrete`.

    Raises:
        BadInput: no such dataset, an episode without steps, lengths that do not fit, NaN, no observations but pictures,
            discrete actions that were not asked for.
        ZestError: the files were damaged.
    """

    def read(group: h5py.Group) -> Episode:
        ends = _array(group, "terminations", bool, dataset_id)
        return Episode(
            obs=_observations(group, dataset_id),
            actions=_actions(group, dataset_id, discrete),
            rewards=_array(group, "rewards", np.float32, dataset_id),
            terminated=bool(len(ends) and ends[-1]),
        )

    return _each(dataset_id, read)


def read_lengths(dataset_id: str) -> list[int]:
    """Read T of every episode; rewards need not be recorded.

    Raises:
        BadInput: no such dataset, or rewards of another length.
    """

    def read(group: h5py.Group) -> int:
        n_steps = len(_array(group, "terminations", bool, dataset_id))
        if "rewards" in group and len(group["rewards"]) != n_steps:
            raise BadInput(f"rewards must be as many as terminations, {n_steps}, got {len(group['rewards'])}")
        return n_steps

    return _each(dataset_id, read)


def read_rewards(dataset_id: str) -> list[FloatArray]:
    """Read the rewards (T,) of every episode, and nothing else.

    Raises:
        BadInput: no such dataset, or one without rewards.
    """
    return _each(dataset_id, lambda group: _array(group, "rewards", np.float32, dataset_id))


def read_states(dataset_id: str) -> list[NDArray[np.float64]]:
    """Read the simulator positions (T+1, nq) of every episode.

    Raises:
        BadInput: no such dataset, no recorded state, lengths that do not fit, NaN.
    """

    def read(group: h5py.Group) -> NDArray[np.float64]:
        qpos = _array(group, "infos/state/qpos", np.float64, dataset_id)
        n_steps = len(_array(group, "rewards", np.float32, dataset_id))
        if n_steps == 0:
            raise BadInput("an episode must have at least 1 step, got 0; drop empty episodes from the dataset")
        if qpos.ndim != 2 or len(qpos) != n_steps + 1:
            raise BadInput(f"infos/state/qpos must have shape ({n_steps + 1}, nq), got {qpos.shape}")
        if not np.isfinite(qpos).all():
            raise BadInput("infos/state/qpos must be finite, got NaN or infinity; drop the episode")
        return qpos

    return _each(dataset_id, read)


def has_ground_truth(dataset_id: str) -> bool:
    """Whether any episode holds the hand-designed rewards; `read_ground_truth` refuses a dataset where some do not."""
    return any(_each(dataset_id, lambda group: _GT_REWARD in group))


def read_ground_truth(dataset_id: str) -> list[GroundTruth]:
    """Read the hand-designed rewards of every episode: for evaluation and reports only, never for a trainer.

    Raises:
        BadInput: no such dataset, or no ground truth is recorded in it.
    """

    def read(group: h5py.Group) -> GroundTruth:
        return GroundTruth(
            rewards=_array(group, _GT_REWARD, np.float32, dataset_id)[1:],
            success=bool(_array(group, "infos/gt/success", bool, dataset_id).any()),
        )

    return _each(dataset_id, read)


def read_scores(dataset_id: str) -> list[FloatArray]:
    """Read the ZeST scores (T+1,) of every episode of a relabeled dataset.

    Raises:
        BadInput: no such dataset, or it was not relabeled.
    """
    return _each(dataset_id, lambda group: _array(group, "infos/zest/score", np.float32, dataset_id))


def read_source_rewards(dataset_id: str) -> list[FloatArray] | None:
    """Read the rewards (T,) that a dataset of another environment came with before it was relabeled; None: no such."""
    found = _each(
        dataset_id,
        lambda group: _array(group, SOURCE_REWARD, np.float32, dataset_id)[1:] if SOURCE_REWARD in group else None,
    )
    return None if any(rewards is None for rewards in found) else found


def rewards_to_keep(dataset_id: str) -> list[FloatArray | None]:
    """Read the rewards (T,) of every episode that a copy keeps as its source's; None: none, or the ground truth."""

    def read(group: h5py.Group) -> FloatArray | None:
        if _GT_REWARD in group:
            return None
        if SOURCE_REWARD in group:
            return _array(group, SOURCE_REWARD, np.float32, dataset_id)[1:]
        return _array(group, "rewards", np.float32, dataset_id) if "rewards" in group else None

    return _each(dataset_id, read)


def fingerprint(dataset_id: str) -> str:
    """Hash what relabeling and training may see of a dataset: observations, actions, ends and states; no rewards."""

    def digest(group: h5py.Group) -> str:
        if "observations" not in group:
            raise BadInput(f"dataset {dataset_id} has no 'observations' in {group.name}")
        actions = _array(group, "actions", np.float32, dataset_id)
        ends = _array(group, "terminations", bool, dataset_id)
        arrays = [actions, np.array([bool(len(ends) and ends[-1])])]
        if "infos/state/qpos" in group:
            arrays.append(_array(group, "infos/state/qpos", np.float64, dataset_id))
        return artifacts.hash_stream(itertools.chain(_observed(group["observations"]), arrays))

    return artifacts.hash_json(_each(dataset_id, digest))


def _observed(node: h5py.Group | h5py.Dataset) -> Iterator[NDArray[Any]]:
    """Yield an episode's observations in parts: pictures as they are stored, a few at a time, numbers as float32."""
    for entry in entries(node).values():
        if is_numbers(entry):
            yield np.asarray(entry[()], dtype=np.float32)
        else:
            yield from stored_rows(entry)


def describe(dataset_id: str) -> dict[str, Any]:
    """What a trained policy must remember of its dataset, JSON-ready: identity, environment, scale, how it was made.

    Command, versions and machine stay in the dataset's metadata: an equal dataset made again has an equal description.
    """
    metadata = read_metadata(dataset_id)
    for key in ("env_spec", "ref_min_score", "ref_max_score"):
        if metadata.get(key) is None and not is_foreign(metadata):
            raise BadInput(
                f"dataset {dataset_id} has no {key} in its metadata, so a policy could not be evaluated on it; "
                "give env, eval_env and both reference scores when the dataset is made"
            )
    return {
        "id": dataset_id,
        "sha256": fingerprint(dataset_id),
        "rewards_sha256": artifacts.hash_arrays(*(episode.rewards for episode in read_episodes(dataset_id))),
        "env_spec": metadata.get("env_spec"),
        "ref_min_score": metadata.get("ref_min_score"),
        "ref_max_score": metadata.get("ref_max_score"),
        "zest": {
            stage: {key: value for key, value in facts.items() if key != "provenance"}
            for stage, facts in metadata.get("zest", {}).items()
        },
    }


def is_foreign(metadata: Mapping[str, Any]) -> bool:
    """Whether a dataset's metadata or `describe` say that it was relabeled by frames that we did not render."""
    return "frames" in metadata.get("zest", {}).get("relabel", {})


def kitchen_task(dataset_id: str) -> str | None:
    """Return which kitchen task a dataset is of, None when its environment is another one."""
    spec = json.loads(read_metadata(dataset_id).get("env_spec") or "{}")
    name = spec.get("kwargs", {}).get("task")
    return None if name is None or not str(spec.get("entry_point")).startswith("zest_rl.") else str(name)


def task_name(dataset_id: str) -> str:
    """Return which kitchen task a dataset is of.

    Raises:
        BadInput: its environment is not the kitchen.
    """
    name = kitchen_task(dataset_id)
    if name is None:
        spec = json.loads(read_metadata(dataset_id).get("env_spec") or "{}")
        raise BadInput(
            f"dataset {dataset_id} is of environment {spec.get('id')!r}; frames can be rendered for zest/Kitchen-v1 "
            "only, so collect a dataset with `zest collect`; `zest relabel` alone takes any, see docs/any_dataset.md"
        )
    return name
