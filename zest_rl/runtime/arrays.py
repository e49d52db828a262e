"""Named arrays in ``.npz`` files: written atomically, read whole or not at all."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zest_rl.runtime import artifacts

Arrays = Mapping[str, NDArray[Any]]
_DAMAGED = (OSError, ValueError, EOFError, RuntimeError, zipfile.BadZipFile)
"""Errors that reading a damaged ``.npz`` file may raise; RuntimeError: damaged zip flags."""


def read_arrays(path: Path) -> dict[str, NDArray[Any]] | None:
    """Read an ``.npz`` file whole, or return None when it is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except _DAMAGED:
        return None


def read_array(path: Path, name: str) -> NDArray[Any] | None:
    """Read one array of an ``.npz`` file, or return None when it is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return np.asarray(file[name])
    except (*_DAMAGED, KeyError):
        return None


def write_arrays(path: Path, arrays: Arrays) -> None:
    """Write an ``.npz`` file atomically, creating its folder.

    Raises:
        ZestError: the folder cannot be written to, or its disk is full.
    """
    artifacts.check_free_space(path.parent, sum(array.nbytes for array in arrays.values()))
    with artifacts.atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **dict(arrays))


def concatenate(parts: Sequence[Arrays]) -> dict[str, NDArray[Any]]:
    """Join equally named arrays of several parts along the first axis."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
