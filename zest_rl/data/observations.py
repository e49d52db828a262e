"""Observations as Minari, robomimic and others keep them in HDF5: which entries are pictures, and which are numbers.

A Dict or Tuple space is a group, each entry a dataset with one row per step; entries go by their paths within the
group. Pictures are told by `zest_rl.data.picture_forms`.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from zest_rl.data.hdf5 import read_array
from zest_rl.data.picture_forms import ROWS, PictureForm, form_of
from zest_rl.errors import BadInput, Notice
from zest_rl.types import FloatArray

MAX_STANDARDIZED = 10.0
"""Standard deviations; so many a joint is away that moves for the first time after the data."""


def standardized(obs: FloatArray, mean: Sequence[float] | FloatArray, std: Sequence[float] | FloatArray) -> FloatArray:
    """Return ``(obs - mean) / std`` clipped to ± `MAX_STANDARDIZED`; obs and result (…, obs_dim) float32."""
    scaled = (obs - np.asarray(mean, dtype=np.float32)) / np.asarray(std, dtype=np.float32)
    return np.minimum(np.maximum(scaled, -MAX_STANDARDIZED), MAX_STANDARDIZED).astype(np.float32, copy=False)


def entries(node: h5py.Group | h5py.Dataset, prefix: str = "") -> dict[str, h5py.Dataset]:
    """Return all datasets at or below a node by their paths, sorted; the path of the node itself is ""."""
    if isinstance(node, h5py.Dataset):
        return {prefix: node}
    datasets: dict[str, h5py.Dataset] = {}
    for name in sorted(node):
        datasets |= entries(node[name], f"{prefix}/{name}" if prefix else name)
    return datasets


def is_numbers(entry: h5py.Dataset, first: PictureForm | None = None) -> bool:
    """Whether an entry holds numbers that a policy can observe: no pictures, no text, one row per step.

    A `Notice` names what has the shape of pictures that are not read; unsigned integers of it are left out. `first` is
    the form of the first episode, see `form_of`.
    """
    form = form_of(entry, first)
    is_left_out = bool(form.problem) and entry.dtype.kind == "u"
    if form.problem:
        name = re.sub(r"^/(data/)?[^/]*/", "", entry.name)
        effect = "is left out" if is_left_out else f"counts as {math.prod(entry.shape[1:])} numbers per step"
        warnings.warn(f"{name} {effect}: {form.problem}", Notice, stacklevel=2)
    return not form.channels and not is_left_out and entry.dtype.kind in "biuf" and entry.ndim > 0


def acts_discretely(episode: h5py.Group) -> bool:
    """Whether the actions of an episode are whole numbers: Discrete, MultiDiscrete, MultiBinary."""
    return bool(episode["actions"].dtype.kind != "f")


def choose_pictures(forms: Mapping[str, PictureForm], wanted: Iterable[str], where: str, prefix: str = "") -> list[str]:
    """Choose the entries whose pictures are the frames: the ones asked for, or the only one.

    Args:
        forms: of each entry.
        wanted: names of entries, with or without `prefix`; empty: the only one in colour, else the only one.
        where: names the dataset in an error.
        prefix: put before each name in messages, such as ``observations``.

    Raises:
        BadInput: no such entry, none at all, or several; the message lists them, and why others are not read.
    """
    full_names = {name: joined(prefix, name) for name, form in forms.items() if form.channels}
    listing = (", ".join(full_names.values()) or "(none)") + rejected(forms, prefix)
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
    colour = [name for name in full_names if forms[name].channels == 3]
    pictures = colour or list(full_names)
    if len(pictures) != 1:
        several = ", ".join(full_names[name] for name in pictures)
        problem = f"several entries with pictures: {several}" if pictures else "no entry with pictures"
        raise BadInput(
            f"{where} has {problem}; "
            + ("choose with --frames KEY, or several keys to average them as views" if pictures else "see --help")
            + rejected(forms, prefix)
        )
    return pictures


def joined(prefix: str, name: str) -> str:
    """Return the path of an entry below a group; ``[i]`` is a part of the group itself, and "" is the group."""
    return f"{prefix}{name}" if not (prefix and name) or name.startswith("[") else f"{prefix}/{name}"


def rejected(forms: Mapping[str, PictureForm], prefix: str = "") -> str:
    """Say which entries have the shape of pictures but are not read, and why; empty if there are none."""
    problems = [f"{joined(prefix, name)} ({form.problem})" for name, form in forms.items() if form.problem]
    return f"; not read as pictures: {', '.join(problems)}" if problems else ""


def stored_rows(entry: h5py.Dataset) -> Iterator[NDArray[Any]]:
    """Yield the raw values of an entry, `ROWS` steps at a time; text as the bytes of each row."""
    blocks = (entry[row : row + ROWS] for row in range(0, len(entry), ROWS))
    if h5py.check_vlen_dtype(entry.dtype) is None:
        yield from blocks
    else:  # read so, a row takes a fortieth of the time that it takes alone
        yield from (np.frombuffer(row, np.uint8) if isinstance(row, bytes) else row for rows in blocks for row in rows)


def numbers(node: h5py.Group | h5py.Dataset, forms: Mapping[str, PictureForm] | None = None) -> FloatArray:
    """Flatten the numbers of an observation: one row per step.

    The entries of a Dict are concatenated in the alphabetical order of their paths, as by Gymnasium's ``flatten``;
    pictures and text are left out, and a Discrete stays one number.

    Args:
        node: the observations of an episode.
        forms: of the entries of the first episode, by their paths below its node, see `form_of`.

    Returns:
        (T+1, n) float32.

    Raises:
        BadInput: there are no numbers.
    """
    numeric = {path: entry for path, entry in entries(node).items() if is_numbers(entry, (forms or {}).get(path))}
    if not numeric:
        raise BadInput(f"{node.name} holds pictures only; a policy here needs numbers to act on")
    if len({len(entry) for entry in numeric.values()}) > 1:
        raise BadInput(f"the entries of {node.name} must be equally long, got {[len(e) for e in numeric.values()]}")
    return flatten({path: read_array(entry, np.float32) for path, entry in numeric.items()})


def flatten(numeric: Mapping[str, NDArray[Any]]) -> FloatArray:
    """Concatenate the numbers of observations, (n, …) by their paths, in the order of `entries`: (n, width) float32."""
    ordered = sorted(numeric, key=lambda path: path.split("/"))
    columns = [np.asarray(numeric[path], np.float32) for path in ordered]
    return np.concatenate([column.reshape(len(column), -1) for column in columns], axis=1)


def by_path(values: Any, prefix: str = "") -> dict[str, Any]:
    """Return the entries of nested dictionaries by their keys with ``/`` between them."""
    if not isinstance(values, Mapping):
        return {prefix: values}
    found: dict[str, Any] = {}
    for name, part in values.items():
        path = f"{prefix}/{name}" if prefix else str(name).lstrip("/")
        found |= by_path(part, path) if isinstance(part, Mapping) else {path: part}
    return found


def at_path(values: Mapping[Any, Any], path: str) -> Any:
    """Return ``by_path(values).get(path)``, without visiting all entries where the keys are the parts of the path."""
    part: Any = values
    for name in path.split("/"):
        if not isinstance(part, Mapping) or name not in part:
            return by_path(values).get(path)
        part = part[name]
    return by_path(values).get(path) if isinstance(part, Mapping) else part


def observed(observations: Sequence[Any]) -> dict[str, NDArray[Any]]:
    """Stack the observations of n environments: (n, …) by the paths that they have in a file of Minari's."""
    first = observations[0]
    if isinstance(first, Mapping):
        parts = {str(name): [each[name] for each in observations] for name in first}
    elif isinstance(first, tuple):
        parts = {f"_index_{i}": [each[i] for each in observations] for i in range(len(first))}
    else:
        return {"": np.stack([np.asarray(each) for each in observations])}
    stacked = {name: observed(part) for name, part in parts.items()}
    return {f"{name}/{path}".rstrip("/"): array for name, arrays in stacked.items() for path, array in arrays.items()}


def numeric_paths(observations: Sequence[Any]) -> tuple[str, ...]:
    """Return the paths of what a policy is given of the observations of n environments, by the rule of `numbers`."""
    with h5py.File("observations", "w", driver="core", backing_store=False) as file:
        for path, array in observed(observations).items():
            if array.dtype.kind in "biufS":
                file[f"observations/{path}".rstrip("/")] = array
        return tuple(path for path, entry in entries(file["observations"]).items() if is_numbers(entry))
