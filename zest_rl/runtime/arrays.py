"""Named arrays in ``.npz`` files: written atomically, and read as they were written or not at all.

A file holds the sha256 of each of its arrays, which is compared before anything is parsed: zip's own checksum is not
looked at when a damaged header makes an array shorter.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zest_rl.runtime import artifacts

Arrays = Mapping[str, NDArray[Any]]
Layout = Mapping[str, tuple[type[np.generic], tuple[int | None, ...]]]
"""Name → dtype and shape that an array must have; None: an axis of any length. Floats must be finite."""
DIGESTS = "sha256.json"


def read_arrays(
    path: Path, layout: Layout | None = None, *, undigested: bool = False
) -> dict[str, NDArray[Any]] | None:
    """Read an ``.npz`` file, or return None when it is missing, damaged, or not of the layout.

    Args:
        path: the file.
        layout: the arrays to read; None: all, as they are. Empty: only look whether a file with digests is there.
        undigested: accept files of versions that wrote no digests; nothing but zip's checksum guards them.
    """
    try:
        with zipfile.ZipFile(path) as file:
            return _read(file, layout, undigested)
    except Exception:  # zip, NumPy and the allocator raise nearly every type on damaged bytes
        return None


def _read(file: zipfile.ZipFile, layout: Layout | None, undigested: bool) -> dict[str, NDArray[Any]] | None:
    members = file.infolist()
    if any(member.compress_type != zipfile.ZIP_STORED for member in members):
        return None  # a few bytes could unpack to more than the memory
    names = [member.filename for member in members if member.filename != DIGESTS]
    digests = None if undigested and len(names) == len(members) else json.loads(file.read(DIGESTS))
    if digests is not None and digests.keys() != set(names):
        return None
    arrays = {}
    for name in names if layout is None else [f"{name}.npy" for name in layout]:
        content = file.read(name)
        if digests is not None and artifacts.hash_bytes(content) != digests[name]:
            return None
        buffer = io.BytesIO(content)
        arrays[name.removesuffix(".npy")] = np.lib.format.read_array(buffer, allow_pickle=False)
        if buffer.read(1):
            return None
    return arrays if layout is None or all(_fits(arrays[name], *layout[name]) for name in layout) else None


def _fits(array: NDArray[Any], dtype: type[np.generic], shape: tuple[int | None, ...]) -> bool:
    return (
        array.dtype == dtype
        and array.ndim == len(shape)
        and all(expected in (None, n) for n, expected in zip(array.shape, shape, strict=True))
        and (array.dtype.kind != "f" or bool(np.isfinite(array).all()))
    )


def write_arrays(path: Path, arrays: Arrays) -> None:
    """Write an ``.npz`` file atomically, creating its folder.

    Raises:
        ZestError: the folder cannot be written to, or its disk is full.
    """
    artifacts.check_free_space(path.parent, sum(array.nbytes for array in arrays.values()))
    digests = {}
    with artifacts.atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w") as file:
        for name, array in arrays.items():
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, np.asanyarray(array), allow_pickle=False)
            digests[f"{name}.npy"] = artifacts.hash_bytes(buffer.getvalue())
            file.writestr(f"{name}.npy", buffer.getvalue())
        file.writestr(DIGESTS, json.dumps(digests))


def concatenate(parts: Sequence[Arrays]) -> dict[str, NDArray[Any]]:
    """Join equally named arrays of several parts along the first axis."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
