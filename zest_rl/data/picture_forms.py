"""Which arrays of a dataset are pictures, in what form, and how they become frames.

One step of an entry is a *picture* if it is (H, W), (H, W, C) or (C, H, W) with sides of at least `MIN_SIDE` pixels,
and

- uint8 with 1 or 3 channels, or 4 of which the last, the opacity, is 255 everywhere and is dropped;
- floats with 1 channel in [0, 1], or with 3, or 4 as above, in [0, 1], [0, 255] or [-1, 1]; the range is that of the
  space where it is finite, else that of all values of the first episode;
- or a JPEG file, which Minari makes of uint8 pictures by default (lossy).

(n, …) of these, up to `MAX_PARTS`, are cameras or stacked frames; each is a picture of its own, ``KEY[i]``.
"""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from zest_rl.data.hdf5 import check_stored
from zest_rl.data.picture_size import MAX_ASPECT, MAX_PIXELS
from zest_rl.errors import BadInput
from zest_rl.types import Frame

MIN_SIDE = 8
"""Smaller arrays of this form are matrices, not pictures."""
MAX_PARTS = 16
"""Pictures in one step of an entry."""
ROWS = 64
"""Steps whose pictures are held in memory at a time."""
_JPEG = bytes((0xFF, 0xD8, 0xFF))
_BRIGHT = 64
"""Floats without bounds that are pictures in [0, 255] exceed this somewhere in an episode."""


@dataclass(frozen=True)
class PictureForm:
    """How the steps of an entry are pictures."""

    channels: int = 0
    """Of a frame made of it: 1 is grey, 3 is colour; 0: these are no pictures that are read."""
    problem: str = ""
    """Why what has the shape of pictures is not read as such."""
    low: float = 0.0
    """The value that is black."""
    high: float = 255.0
    """The value that is white."""
    n_parts: int = 0
    """Cameras or stacked frames in each step; 0: the step is the picture."""
    axis: int | None = None
    """Of the channels in one picture, -1 or -3; None: (H, W), or a JPEG file."""
    step: tuple[int, ...] = ()
    """Shape of a step; () for JPEG files."""
    dtype: str = ""
    """Of the values; "" for JPEG files."""


def form_of(entry: h5py.Dataset, first: PictureForm | None = None) -> PictureForm:
    """Tell whether and how an entry with one row per step holds pictures; floats without bounds are read.

    Args:
        entry: one row per step.
        first: form of the first episode, which decides where the values fit it: a dark episode alone does not tell its
            range.

    Raises:
        BadInput: floats that are declared, but not stored.
    """
    form = _form_alone(entry)
    if form.channels or first is None or (first.dtype, first.step) != (entry.dtype.name, entry.shape[1:]):
        return form
    low, high = _extremes(entry)
    return first if first.channels and first.low <= low and high <= first.high else form


def _form_alone(entry: h5py.Dataset) -> PictureForm:
    if _is_jpeg(entry):
        return PictureForm(3)
    step, kind = entry.shape[1:], entry.dtype.kind
    short, long = sorted(step)[-2:] if len(step) > 1 else (0, 0)
    if kind not in "biuf" or short < MIN_SIDE or len(entry) == 0:
        return PictureForm()
    shown = f"{entry.dtype} {step} per step"
    if kind not in "uf" or (kind == "u" and entry.dtype != np.uint8):
        return PictureForm(problem=f"{shown}, as depth and labels are, but pictures are uint8 or floats")
    layout = _layout(step)
    if layout is None:
        return PictureForm(problem=f"{shown} is none of (H, W), (H, W, C), (C, H, W) with C of 1, 3 or 4")
    if short * long > MAX_PIXELS or long > MAX_ASPECT * short:
        return PictureForm(problem=f"{shown} is too large or too long")
    n_parts, channels, axis = layout
    bounds = (0.0, 255.0) if kind == "u" else _float_range(entry, is_grey=channels == 1)
    if bounds is None:
        ranges = "[0, 1]" if channels == 1 else "[0, 1], [0, 255] or [-1, 1]"
        return PictureForm(problem=f"{shown}, but not in {ranges} as pictures of floats are")
    form = PictureForm(1 if channels == 1 else 3, "", *bounds, n_parts, axis, step, entry.dtype.name)
    if channels < 4 or _is_opaque(entry[0], form):
        return form
    if axis == -3 and n_parts == 0 and kind == "u":
        return PictureForm(1, "", *bounds, 4, None, step, entry.dtype.name)
    return PictureForm(problem=f"{shown}, of which the fourth channel is not opaque: depth, or stacked frames")


def _layout(step: tuple[int, ...]) -> tuple[int, int, int | None] | None:
    """Return the number of parts, 0 for one picture alone, that of channels, and their axis in one picture."""
    if len(step) == 2:
        return 0, 1, None
    if len(step) == 3:
        for known in ((1, 3), (4,)):
            for axis in (-1, -3):
                if step[axis] in known and min(step[:2] if axis == -1 else step[1:]) >= MIN_SIDE:
                    return 0, step[axis], axis
        return (step[0], 1, None) if step[0] <= MAX_PARTS and min(step[1:]) > max(step[0], MIN_SIDE) else None
    inner = _layout(step[1:]) if len(step) == 4 and 1 <= step[0] <= MAX_PARTS else None
    return None if inner is None or inner[0] else (step[0], *inner[1:])


def _is_opaque(picture: NDArray[Any], form: PictureForm) -> bool:
    return bool((np.take(picture, 3, axis=form.axis) == form.high).all())


def _float_range(entry: h5py.Dataset, *, is_grey: bool) -> tuple[float, float] | None:
    """Return black and white of floats; None where these are numbers."""
    low, high = _declared_bounds(entry)
    is_declared = bool(np.isfinite([low, high]).all())
    if not is_declared:
        if np.isfinite([low, high]).any():
            return None
        low, high = _extremes(entry)
    if low >= 0 and high <= 1:  # NaN is not
        return 0.0, 1.0
    if is_grey:
        return None  # a map of heights or distances
    if low >= -1 and high <= 1:
        return -1.0, 1.0
    if is_declared and (low, high) == (0.0, 255.0):
        return (0.0, 255.0) if _extremes(entry)[1] > 1 else None  # some declare bytes, but divide by 255
    return (0.0, 255.0) if low >= 0 and _BRIGHT <= high <= 255 else None


def _extremes(entry: h5py.Dataset) -> tuple[float, float]:
    """Return the least and the greatest value, NaN if any is."""
    check_stored(entry)
    low, high = np.inf, -np.inf
    for row in range(0, len(entry), ROWS):
        part = entry[row : row + ROWS]
        low, high = np.minimum(low, part.min()), np.maximum(high, part.max())
    return float(low), float(high)


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
    except (OSError, KeyError, IndexError, TypeError, ValueError, AttributeError, RecursionError, MemoryError):
        return -np.inf, np.inf


@functools.lru_cache(maxsize=4)
def _observation_space(metadata: Path, changed: int) -> Any:
    text = json.loads(metadata.read_text(encoding="utf-8"))["observation_space"]
    return json.loads(text)  # large: it has bounds for each pixel


def _is_jpeg(entry: h5py.Dataset) -> bool:
    ragged = h5py.check_vlen_dtype(entry.dtype)
    if ragged is not None:
        return bool(ragged == np.uint8) and len(entry) > 0 and bytes(entry[0][:3]) == _JPEG
    return entry.dtype == np.uint8 and entry.ndim == 2 and len(entry) > 0 and bytes(entry[0, :3]) == _JPEG


def read_pictures(
    entry: h5py.Dataset, rows: slice, form: PictureForm | None = None, part: int | None = None
) -> list[Frame]:
    """Read some rows of an entry of pictures as (H, W, 3) uint8 RGB.

    Args:
        entry: one row per step.
        rows: which.
        form: of the first episode, which decides for all: a dark episode alone does not tell its range.
        part: which of the cameras or stacked frames.

    Raises:
        BadInput: the entry holds no pictures, or others than `form` says; or one of them is damaged.
    """
    form = form_of(entry) if form is None else form
    if not form.channels:
        raise BadInput(f"{entry.name} holds no pictures: {form.problem or f'{entry.dtype} {entry.shape[1:]} per step'}")
    if form.step == () and _is_jpeg(entry):
        from zest_rl.data.images import decode_image  # environments that only export may lack Pillow

        first = rows.indices(len(entry))[0]
        return [decode_image(bytes(row), f"{entry.name} at step {first + i}") for i, row in enumerate(entry[rows])]
    if (entry.dtype.name, entry.shape[1:]) != (form.dtype, form.step):
        raise BadInput(
            f"{entry.name} holds {entry.dtype} {entry.shape[1:]} per step, but the first episode "
            f"{f'{form.dtype} {form.step}' if form.step else 'JPEG files'}; store all episodes alike"
        )
    stored = entry[rows] if part is None else entry[rows, part]
    return [_to_frame(picture, form, entry.name) for picture in stored]


def _to_frame(picture: NDArray[Any], form: PictureForm, what: str) -> Frame:
    if form.axis is not None and picture.shape[form.axis] == 4 and not _is_opaque(picture, form):
        raise BadInput(f"{what}: the fourth channel is not opaque everywhere; store colours alone")
    if picture.dtype.kind == "f":
        low, high = form.low, form.high
        if not (picture.min() >= low and picture.max() <= high):  # also when it is NaN
            raise BadInput(
                f"{what}: pictures of floats must be in [{low:.4g}, {high:.4g}], as its space or its first episode "
                f"says, got {picture.min():.4g} to {picture.max():.4g}; scale them, or store uint8"
            )
        picture = np.round((picture - low) * (255 / (high - low)))
    picture = picture[..., None] if form.axis is None else np.moveaxis(picture, form.axis, -1)[..., :3]
    return np.ascontiguousarray(np.broadcast_to(picture, (*picture.shape[:2], 3)), dtype=np.uint8)
