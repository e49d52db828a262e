"""Datasets → the formats of other offline-RL code, as files or, for d3rlpy and TorchRL, as their own objects.

`zest_rl.export.transitions` says what a transition is.

- ``npz``: flat arrays (N, …) of all transitions, in the order of the episodes, numbered in `episode`.
- ``d4rl``: the same names at the root of an HDF5 file, as ``d4rl.qlearning_dataset(env, dataset=…)`` reads them; that
  function leaves out the last transition of every episode that a time limit ended.
- ``robomimic``: ``data/demo_I`` per episode with ``obs/flat`` and ``next_obs/flat``, and masks ``train`` and ``valid``.
- ``d3rlpy``: HDF5 for ``ReplayBuffer.load``; its Q-learning leaves out the same transition as D4RL's.
- ``torchrl``: a folder for ``TensorDict.load_memmap``.
- ``lerobot``: a folder, LeRobotDataset v3.0 without videos; ``lerobot-progress``: its side-car of scores alone.

docs/interop.md has a recipe for each, and the version that it is tested against. Exporting needs only NumPy, h5py and
filelock (and pyarrow for LeRobot's), so it works in the environments that those libraries pin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from zest_rl.data.reader import open_dataset
from zest_rl.errors import BadInput, nearest
from zest_rl.export import d3rlpy, flat, lerobot, robomimic, torchrl
from zest_rl.export.d3rlpy import to_d3rlpy
from zest_rl.export.torchrl import to_torchrl
from zest_rl.export.transitions import (
    Shape,
    TransitionDataset,
    Transitions,
    read_progress,
    read_transitions,
    transitions,
)
from zest_rl.runtime import artifacts
from zest_rl.runtime.child import write_in_child

__all__ = ["Exported", "Format", "Shape", "Transitions", "export", "to_d3rlpy", "to_torchrl", "transitions"]

Format = Literal["npz", "d4rl", "robomimic", "d3rlpy", "torchrl", "lerobot", "lerobot-progress"]


@dataclass(frozen=True)
class _Writer:
    """One format."""

    write: Callable[[Path, TransitionDataset], list[str]]
    """Writes, and returns the names of the arrays as a reader of the format types them, I for an episode's number."""
    suffix: str
    """Of the file or folder."""
    is_folder: bool = False
    """`write` fills an empty folder."""
    loses_last_step: str | None = None
    """Reader that leaves out the last transition of an episode ended by a time limit; None: no reader does."""


WRITERS = {
    "npz": _Writer(flat.write_npz, "npz"),
    "d4rl": _Writer(flat.write_d4rl, "d4rl.hdf5", loses_last_step="D4RL's loader"),
    "robomimic": _Writer(robomimic.write, "robomimic.hdf5"),
    "d3rlpy": _Writer(d3rlpy.write, "d3rlpy.h5", loses_last_step="d3rlpy's Q-learning"),
    "torchrl": _Writer(torchrl.write, "torchrl", is_folder=True),
    "lerobot": _Writer(lerobot.write, "lerobot", is_folder=True),
    "lerobot-progress": _Writer(lerobot.write_progress, "progress.parquet"),
}


@dataclass(frozen=True)
class Exported:
    """Result of `export`."""

    path: Path
    n_episodes: int
    n_transitions: int
    arrays: tuple[str, ...]
    """Their names in it; in those of single episodes, I stands for the number."""
    n_bytes: int
    left_out: tuple[str, ...]
    """Entries of the observations that are not numbers: pictures and text."""


def export(
    dataset_id: str,
    to: Format = "npz",
    output: Path | None = None,
    *,
    shape: Shape = "step",
    normalise: bool = False,
    fps: int | None = None,
) -> Exported:
    """Write a dataset in another format, atomically.

    Args:
        dataset_id: any dataset with numbers among its observations; for ``lerobot-progress`` pictures alone will do.
        to: the format.
        output: the file, or the folder, which must not exist; None: DATASET.FORMAT in the current folder.
        shape: the rewards as they are, their change, or the last one alone.
        normalise: shift and scale the rewards to [0, 1] over the dataset.
        fps: steps per second, for LeRobot only; None: those of the recording if known, else the kitchen's.

    Raises:
        BadInput: no such dataset, an unknown format, the output exists, or the format would lose the rewards.
        ZestError: the disk is full or read-only, or pyarrow is missing.
    """
    if to not in WRITERS:
        raise BadInput(f"unknown format {to!r}; {nearest(to, WRITERS)}")
    writer = WRITERS[to]
    path = output or Path(f"{dataset_id.split('/')[-1]}.{writer.suffix}")
    _check_new(path)
    if to == "lerobot-progress" and (shape, normalise) != ("step", False):
        raise BadInput("lerobot-progress holds scores of frames and no rewards; leave --shape and --normalise out")
    with artifacts.lock(path):
        _check_new(path)  # an equal command may have run at the same time
        with artifacts.staged_folder(path) if writer.is_folder else artifacts.atomic_path(path) as staging:
            exported = write_in_child("the export", _write, staging, dataset_id, to, shape, normalise, fps)
    files = [file for file in (path, *path.rglob("*")) if file.is_file()]
    return replace(exported, path=path, n_bytes=sum(file.stat().st_size for file in files))


def _check_new(path: Path) -> None:
    if path.exists():
        raise BadInput(f"{path} exists; delete it, or choose another --output")


def _write(path: Path, dataset_id: str, to: Format, shape: Shape, normalise: bool, fps: int | None) -> Exported:
    """Read a dataset and write it to a temporary place; arguments and errors as in `export`."""
    writer = WRITERS[to]
    with open_dataset(dataset_id) as ds:
        data = read_progress(ds) if to == "lerobot-progress" else read_transitions(ds, shape, normalise)
    if writer.loses_last_step and shape == "terminal" and any(episode["timeouts"].any() for episode in data.episodes):
        raise BadInput(
            f"{writer.loses_last_step} leaves out the transition at a time limit, which holds the only reward of "
            "'terminal'; export 'step' or 'difference', or to npz"
        )
    size = sum(array.nbytes for episode in data.episodes for array in episode.values())
    artifacts.check_free_space(path.parent, 2 * size)
    names = lerobot.write(path, data, fps) if to == "lerobot" else writer.write(path, data)
    return Exported(path, len(data.episodes), len(data), tuple(names), 0, data.left_out)
