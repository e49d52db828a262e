"""HDF5 files that are compared with what was to be written: h5py drops errors of writes while an array is closed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from zest_rl.errors import ZestError


def write_hdf5(
    path: Path, arrays: Mapping[str, Any], attributes: Mapping[str, Mapping[str, Any]], compression: str | None = None
) -> None:
    """Write a new file, then read it again and compare.

    Args:
        path: of the file; call this in a child process, which HDF5 kills on a full disk.
        arrays: path in the file → array, or anything else that h5py stores.
        attributes: path in the file → attributes of that group.
        compression: of all arrays.

    Raises:
        ZestError: an array in the file is another one.
    """
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file.create_dataset(name, data=values, compression=compression)
        for group, values in attributes.items():
            file[group].attrs.update(values)
    with h5py.File(path, "r") as file:
        for name, values in arrays.items():
            entry = file[name]
            stored = np.asarray(entry.asstr()[()] if entry.dtype.kind == "O" else entry[()])
            if not np.array_equal(stored, np.asarray(values), equal_nan=stored.dtype.kind == "f"):
                raise ZestError(f"{name} was not written whole; is the disk full?")
