"""HDF5 files of others: opened for reading once all that they hold is known to lie in the one file.

HDF5 can reach out of a file (external links, external storage, virtual datasets) and give one object several names
(soft links, further hard links, cycles). To read would be to take other files for data, to write to a copy would be to
change them. No dataset needs any of it, so a file with one of these is refused before anything else in it is read.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from h5py import h5d, h5l, h5o, h5z
from numpy.typing import NDArray

from zest_rl.errors import BadInput, ZestError
from zest_rl.runtime.files import check_file

MAX_RATIO = 2000
"""Bytes of an array by bytes that are stored; gzip's limit is 1032."""
_GREATEST_RATIO = 2**26
"""The same of other compression: Blosc stores 2 GB of equal values in 32 bytes."""
_KNOWN_FILTERS = {h5z.FILTER_DEFLATE, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32, h5z.FILTER_LZF}
"""Those to which `MAX_RATIO` applies."""
MAX_DEPTH = 32
"""Groups within groups; HDF5 walks through them by recursion."""
_FREE = 64 * 2**20  # bytes of an array that need not be stored, as values that were never written are not
_EXTERNAL_STORAGE, _FILTERS = 1 << 7, 1 << 11  # messages of an object's header
_LINKS = {h5l.TYPE_SOFT: "a soft link", h5l.TYPE_EXTERNAL: "an external link"}
_REPACK = "copy the data themselves to a file (h5py: `copy(…, expand_soft=True, expand_external=True)`)"


@contextmanager
def open_hdf5(path: Path, what: str = "") -> Iterator[h5py.File]:
    """Open a file for reading; `what` names it in errors, else its path. Errors of h5py in the block are mapped, too.

    Raises:
        BadInput: no regular file, no HDF5, something that reaches out of it or has two names, an array that is larger
            than memory or compressed in a way that h5py cannot undo.
        ZestError: what is read is damaged.
    """
    check_file(path)
    what, status = what or str(path), path.stat()
    _check_plain(path, what, (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns))
    with mapped_errors(what), h5py.File(path, "r") as file:
        yield file


@contextmanager
def mapped_errors(what: str) -> Iterator[None]:
    """Turn whatever h5py raises in the block into an error that names `what`.

    Raises:
        BadInput: an array does not fit in memory.
        ZestError: h5py failed.
    """
    try:
        yield
    except MemoryError as error:
        raise BadInput(f"{what} needs more memory than there is ({error}); split it, or free some") from error
    except Exception as error:
        if isinstance(error, ZestError) or not _is_raised_by_h5py(error):
            raise
        raise ZestError(f"{what} is damaged ({error}); download it or make it again") from error


def read_array(node: h5py.Dataset, dtype: type) -> NDArray[Any]:
    """Read all of an array of numbers.

    Raises:
        BadInput: it holds something else, or is larger than what is stored can be.
    """
    if node.dtype.kind not in "biuf":
        raise BadInput(f"{node.name} must hold numbers, got values of type {node.dtype}; store numbers")
    check_stored(node)
    with np.errstate(over="ignore"):  # of float64 that float32 cannot hold: infinity, which is refused by name
        return np.asarray(node[()], dtype=dtype)


def check_rows(name: str, node: h5py.Dataset, n_steps: int, n_more: int = 0) -> None:
    """Refuse an array that has not T + `n_more` rows, before it is read.

    Raises:
        BadInput: such an array, or as in `read_array`.
    """
    if not node.shape or node.shape[0] != n_steps + n_more:
        wanted = f"T + {n_more}" if n_more else "T"
        raise BadInput(
            f"{name} must have {wanted} = {n_steps + n_more} rows, got shape {node.shape}; repair or drop the episode"
        )
    check_stored(node)


def check_stored(node: h5py.Dataset) -> None:
    """Raise `BadInput` if an array is larger than what is stored of it can be."""
    n_bytes = math.prod(node.shape or ()) * node.id.get_type().get_size()
    if n_bytes > _FREE and n_bytes > _max_ratio(node) * node.id.get_storage_size():
        raise BadInput(
            f"{node.name} declares {n_bytes:,} bytes of shape {node.shape}, of which {node.id.get_storage_size():,}"
            " are stored; the file is damaged or incomplete, download it or make it again"
        )


def _max_ratio(node: h5py.Dataset) -> int:
    properties = node.id.get_create_plist()
    filters = {properties.get_filter(i)[0] for i in range(properties.get_nfilters())}
    return MAX_RATIO if filters <= _KNOWN_FILTERS else _GREATEST_RATIO


def _is_raised_by_h5py(error: Exception) -> bool:
    frame = error.__traceback__
    while frame is not None and frame.tb_next is not None:
        frame = frame.tb_next
    return frame is not None and str(frame.tb_frame.f_globals.get("__name__")).startswith("h5py.")


@functools.lru_cache(maxsize=16)
def _check_plain(path: Path, what: str, version: tuple[int, ...]) -> None:
    """Walk through a file; once for each `version` of it, as workers open a file for every episode."""
    try:
        file = h5py.File(path, "r")
    except (OSError, RuntimeError, ValueError) as error:
        raise BadInput(f"{what} cannot be read as HDF5 ({error}); only that storage is read") from error
    with mapped_errors(what), file:
        if problem := _second_name(file) or h5o.visit(file.id, functools.partial(_problem_of, file), info=True):
            raise BadInput(f"{what}: {problem}")


def _second_name(file: h5py.File) -> str | None:
    """Return what is wrong with the first link that is not the only name of an object in the file; None without any."""
    seen = {h5o.get_info(file.id).addr}

    def check(name: bytes, link: h5l.LinkInfo) -> str | None:
        if link.type != h5l.TYPE_HARD:
            return f"{_text(name)} is {_LINKS.get(link.type, 'a link of an unknown kind')}, not data; {_REPACK}"
        if link.u in seen:
            return f"{_text(name)} is a second name of something else in the file; {_REPACK}"
        if name.decode(errors="ignore").encode() != name:
            return f"{_text(name)} is a name that is not UTF-8; rename it"
        if name.count(b"/") > MAX_DEPTH:
            return f"{_text(name)} lies {name.count(b'/')} groups deep, expected {MAX_DEPTH} at most"
        seen.add(link.u)
        return None

    problem: str | None = file.id.links.visit(check, info=True)
    return problem


def _problem_of(file: h5py.File, name: bytes, found: h5o.ObjInfo) -> str | None:
    """Return why an array cannot be read from the file alone; None if it can, or is none."""
    if found.type != h5o.TYPE_DATASET:
        return None
    if found.meta_size.obj.heap_size or found.hdr.mesg.present & _EXTERNAL_STORAGE:  # where names of files are kept
        return f"{_text(name)} is stored outside the file (external storage or a virtual dataset); {_REPACK}"
    if not found.hdr.mesg.present & _FILTERS:
        return None
    properties = h5d.open(file.id, name).get_create_plist()
    for i in range(properties.get_nfilters()):
        code, _, _, title = properties.get_filter(i)
        if not _can_be_undone(code):
            return (
                f"{_text(name)} is compressed by filter {code} ({_text(title) or 'no name'}), which h5py does not "
                "bring; `pip install hdf5plugin`, which is used if it is there, or repack the file where it was made: "
                "`h5repack -f GZIP=4 IN OUT`"
            )
    return None


def _can_be_undone(code: int) -> bool:
    if not h5z.filter_avail(code) and find_spec("hdf5plugin") is not None:
        import_module("hdf5plugin")  # registers its filters
    return bool(h5z.filter_avail(code))


def _text(name: bytes) -> str:
    return name.decode(errors="backslashreplace")
