"""Observations as Minari, robomimic and others keep them in HDF5: which entries are pictures, and which are numbers.

A Dict or Tuple space is a group, each entry a dataset with one row per step; entries go by their paths within the
group. A *picture* is (H, W) or (H, W, C) or (C, H, W) with 1 or 3 channels and sides of at least `MIN_SIDE` pixels, as
uint8 or as floats in [0, 1]; or one JPEG file per step, which Minari makes of uint8 pictures by default (lossy). Floats
of that form with another range are numbers; the range is the space's where it is finite, else that of the values.
"""

from __future__ import annotations

import functools
import io
import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from zest_rl.data.hdf5 import read_array
from zest_rl.errors import BadInput
from zest_rl.types import FloatArray, Frame

MIN_SIDE = 8
"""Smaller arrays of this form are matrices, not pictures."""
ROWS = 64
"""Steps whose pictures are held in memory at a time."""
_JPEG = bytes((0xFF, 0xD8, 0xFF))


def entries(node: h5py.Group | h5py.Dataset, prefix: str = "") -> dict[str, h5py.Dataset]:
    """Return all datasets at or below a node by their paths, sorted; the path of the node itself is ""."""
    if isinstance(node, h5py.Dataset):
        return {prefix: node}
    datasets: dict[str, h5py.Dataset] = {}
    for name in sorted(node):
        datasets |= entries(node[name], f"{prefix}/{name}" if prefix else name)
    return datasets


def n_channels(entry: h5py.Dataset) -> int | None:
    """Return 1 or 3 for pictures (3 for JPEG files), 0 for floats of that form but not in [0, 1], None for the rest."""
    channels = _channels_by_form(entry)
    return channels if channels is None or entry.dtype.kind != "f" or _is_in_unit_range(entry) else 0


def is_numbers(entry: h5py.Dataset) -> bool:
    """Whether an entry holds numbers that a policy can observe: no pictures, no text, one row per step."""
    return not n_channels(entry) and entry.dtype.kind in "biuf" and entry.ndim > 0


def acts_discretely(episode: h5py.Group) -> bool:
    """Whether the actions of an episode are whole numbers: Discrete, MultiDiscrete, MultiBinary."""
    return bool(episode["actions"].dtype.kind != "f")


def _channels_by_form(entry: h5py.Dataset) -> int | None:
    if _is_jpeg(entry):
        return 3
    return None if entry.dtype.kind not in "uf" else _channels(entry.shape[1:])


def _is_in_unit_range(entry: h5py.Dataset) -> bool:
    """Whether floats are in [0, 1], by their space, or by their values where that has no bounds."""
    bounds = _declared_bounds(entry)
    if np.isfinite(bounds).all():
        return bounds[0] >= 0 and bounds[1] <= 1
    if np.isfinite(bounds).any():
        return False
    return all(bool(rows.min() >= 0 and rows.max() <= 1) for rows in stored_rows(entry))  # NaN is not


def _declared_bounds(entry: h5py.Dataset) -> tuple[float, float]:
    """Return the bounds of an entry's space, which Minari keeps beside its file; infinite where there are none."""
    metadata = Path(entry.file.filename).with_name("metadata.json")
    _, _, part, *names = entry.name.split("/")
    try:
        if part != "observations":
            raise KeyError(part)
        space = _observation_space(metadata, metadata.stat().st_mtime_ns)
        for name in names:
            parts = space["subspaces"]
            space = parts[int(name.removeprefix("_index_"))] if isinstance(parts, list) else parts[name]
        return float(np.min(space["low"])), float(np.max(space["high"]))
    except (OSError, KeyError, IndexError, TypeError, ValueError):
        return -np.inf, np.inf


@functools.lru_cache(maxsize=4)
def _observation_space(metadata: Path, changed: int) -> Any:
    return json.loads(
        json.loads(metadata.read_text(encoding="utf-8"))["observation_space"]
    )  # large: it has bounds for each pixel


def _is_jpeg(entry: h5py.Dataset) -> bool:
    ragged = h5py.check_vlen_dtype(entry.dtype)
    if ragged is not None:
        return bool(ragged == np.uint8) and len(entry) > 0 and bytes(entry[0][:3]) == _JPEG
    return entry.dtype == np.uint8 and entry.ndim == 2 and len(entry) > 0 and bytes(entry[0, :3]) == _JPEG


def _channels(shape: tuple[int, ...]) -> int | None:
    if len(shape) == 2:
        return 1 if min(shape) >= MIN_SIDE else None
    if len(shape) != 3:
        return None
    for channels, sides in ((shape[2], shape[:2]), (shape[0], shape[1:])):
        if channels in (1, 3) and min(sides) >= MIN_SIDE:
            return channels
    return None


def read_pictures(entry: h5py.Dataset, rows: slice) -> list[Frame]:
    """Read some rows of an entry of pictures as (H, W, 3) uint8 RGB.

    Raises:
        BadInput: the entry holds no pictures, or floats that are not in [0, 1].
    """
    if _channels_by_form(entry) is None:
        raise BadInput(
            f"{entry.name} holds no pictures (got shape {entry.shape[1:]} and dtype {entry.dtype} per step); they must "
            "be (H, W), (H, W, C) or (C, H, W) with 1 or 3 channels, uint8 or floats in [0, 1]"
        )
    stored = entry[rows]
    if _is_jpeg(entry):
        from PIL import Image  # environments that only export may lack it

        return [np.asarray(Image.open(io.BytesIO(bytes(row))).convert("RGB")) for row in stored]
    return [as_frame(picture, entry.name) for picture in stored]


def as_frame(picture: NDArray[Any], what: str) -> Frame:
    """Turn a picture of any of the forms above into (H, W, 3) uint8 RGB; `what` names it in an error."""
    if picture.dtype.kind == "f":
        if not (picture.min() >= 0 and picture.max() <= 1):  # also when it is NaN
            raise BadInput(
                f"{what}: pictures of floats must be in [0, 1], got {picture.min():.4g} to {picture.max():.4g}; "
                "scale them, or store uint8"
            )
        picture = np.round(picture * 255)
    elif picture.dtype != np.uint8:
        raise BadInput(f"{what}: pictures of integers must be uint8, got {picture.dtype}; store uint8")
    if picture.ndim == 2:
        picture = picture[:, :, None]
    elif picture.shape[2] not in (1, 3) or min(picture.shape[:2]) < MIN_SIDE:
        picture = np.moveaxis(picture, 0, 2)
    return np.ascontiguousarray(np.broadcast_to(picture, (*picture.shape[:2], 3)), dtype=np.uint8)


def choose_pictures(channels: dict[str, int | None], wanted: Iterable[str], where: str, prefix: str = "") -> list[str]:
    """Choose the entries whose pictures are the frames: the ones asked for, or the only one.

    Args:
        channels: entry → its `n_channels`: None for no picture, 0 for a picture only if it is asked for.
        wanted: names of entries, with or without `prefix`; empty: the only one in colour, else the only one.
        where: names the dataset in an error.
        prefix: put before each name in messages, such as ``observations``.

    Raises:
        BadInput: no such entry, none at all, or several; the message lists them.
    """
    full_names = {
        name: "/".join(part for part in (prefix, name) if part) for name, n in channels.items() if n is not None
    }
    listing = ", ".join(full_names.values()) or "(none)"
    chosen = []
    for key in wanted:
        name = next((name for name, full in full_names.items() if key in (name, full)), None)
        if name is None:
            raise BadInput(
                f"{where} has no pictures at {key!r}, and there is no such folder; entries with pictures: {listing}"
            )
        chosen.append(name)
    if chosen:
        return chosen
    colour = [name for name in full_names if channels[name] == 3]
    pictures = colour or [name for name in full_names if channels[name]]
    if len(pictures) != 1:
        several = ", ".join(full_names[name] for name in pictures)
        problem = f"several entries with pictures: {several}" if pictures else "no entry with pictures"
        raise BadInput(
            f"{where} has {problem}; "
            + ("choose with --frames KEY, or several keys to average them as views" if pictures else "see --help")
        )
    return pictures


def stored_rows(entry: h5py.Dataset) -> Iterator[NDArray[Any]]:
    """Yield the raw values of an entry, `ROWS` steps at a time; text as the bytes of each row."""
    if h5py.check_vlen_dtype(entry.dtype) is not None:
        for row in range(len(entry)):
            value = entry[row]
            yield np.frombuffer(value, np.uint8) if isinstance(value, bytes) else value
    else:
        yield from (entry[row : row + ROWS] for row in range(0, len(entry), ROWS))


def numbers(node: h5py.Group | h5py.Dataset) -> FloatArray:
    """Flatten the numbers of an observation: one row per step.

    The entries of a Dict are concatenated in the alphabetical order of their paths, as by Gymnasium's ``flatten``;
    pictures and text are left out, and a Discrete stays one number.

    Returns:
        (T+1, n) float32.

    Raises:
        BadInput: there are no numbers.
    """
    columns = [
        read_array(entry, np.float32).reshape(len(entry), -1) for entry in entries(node).values() if is_numbers(entry)
    ]
    if not columns:
        raise BadInput(f"{node.name} holds pictures only; a policy here needs numbers to act on")
    if len({len(column) for column in columns}) > 1:
        raise BadInput(f"the entries of {node.name} must be equally long, got {[len(c) for c in columns]}")
    return np.concatenate(columns, axis=1)
