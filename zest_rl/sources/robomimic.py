"""robomimic's HDF5 files: ``data/demo_I`` with ``obs/``, ``actions``, ``rewards``, ``dones`` and mostly ``next_obs/``.

Layout: https://robomimic.github.io/docs/datasets/overview.html. obs/KEY has T rows, o_0 … o_{T-1}; o_T is the
last row of next_obs/KEY, or repeats o_{T-1} where there is no next_obs. An episode counts as terminated if the last of
its ``terminals`` is 1, which `zest export` records; without these, of its ``dones``; without either it is truncated.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import h5py
import numpy as np

from zest_rl.data.hdf5 import check_rows, mapped_errors, open_hdf5, read_array
from zest_rl.data.observations import choose_pictures, entries, is_numbers
from zest_rl.data.picture_forms import PictureForm, form_of
from zest_rl.errors import BadInput, Notice
from zest_rl.sources.conversion import ConvertedEpisode, ConvertedTrajectories
from zest_rl.sources.pictures import Pictures, picture_entries, split_part
from zest_rl.types import FloatArray


def read_episodes(path: Path, names: Sequence[str]) -> Iterator[ConvertedEpisode]:
    """Read one episode at a time, from groups such as ``data/demo_0``.

    Raises:
        BadInput: an episode that breaks a rule, or has other numbers than the first; the message names it.
    """
    first: dict[str, int] = {}
    with open_hdf5(path) as file:
        with _named(names[0], path):
            forms = {key: form_of(entry) for key, entry in entries(file[names[0]]["obs"], "obs").items()}
        for name in names:
            with _named(name, path):
                episode = _read(file[name], forms)
                widths = {
                    **{f"obs/{key}": v.shape[1] for key, v in episode.obs.items()},
                    "actions": episode.actions.shape[1],
                }
                first = first or widths
                if widths != first:
                    raise BadInput(
                        f"every demo must hold the same numbers; {_difference(widths, first)} in {names[0]}; repair it"
                    )
            yield episode


@contextmanager
def _named(name: str, path: Path) -> Iterator[None]:
    try:
        with mapped_errors(f"{name} of {path}"):
            yield
    except BadInput as error:
        raise BadInput(
            f"{name} of {path.name}: {error}. To drop it: "
            f"""`python -c "import h5py; del h5py.File('{path.name}', 'r+')['{name}']"`"""
        ) from error


def _demos(file: h5py.File, path: Path) -> list[str]:
    """Return the groups of all demos that have steps, in order; says which have none, as failed takes of Isaac Lab."""
    data = file.get("data")
    members = list(data) if isinstance(data, h5py.Group) else []
    demos = [name for name in members if name.startswith("demo_")]
    if misnamed := [name for name in demos or members if not name.removeprefix("demo_").isdecimal()]:
        raise BadInput(
            f"episodes must be named data/demo_0, data/demo_1, …, got data/{misnamed[0]} in {path}; rename them in "
            "their order (h5py: `file.move(OLD, NEW)`)"
        )
    names = [f"data/{name}" for name in sorted(demos, key=lambda name: int(name.removeprefix("demo_")))]
    lengths = {name: _length(file[name]) for name in names}
    empty, names = [name for name in names if lengths[name] == 0], [name for name in names if lengths[name] != 0]
    incomplete = [name for name in names if lengths[name] is None or "obs" not in file[name]]
    if not names or incomplete:
        raise BadInput(
            f"{path} must hold data/demo_0, … with actions and obs/, as robomimic's files do; "
            + (f"{incomplete[0]} lacks one of them (extract observations first)" if incomplete else "it has none")
        )
    if empty:
        warnings.warn(f"left out, as they have no steps: {', '.join(empty)}", Notice, stacklevel=2)
    return names


def _length(demo: h5py.Group | h5py.Dataset) -> int | None:
    """Return T; None where there are no actions beside other arrays."""
    if not isinstance(demo, h5py.Group):
        return None
    actions = demo.get("actions")
    if isinstance(actions, h5py.Dataset) and actions.shape:
        return int(actions.shape[0])
    return None if len(demo) else 0


def _difference(widths: dict[str, int], first: dict[str, int]) -> str:
    """Say where the numbers of a demo are not those of the first."""
    key = next(key for key in {**first, **widths} if widths.get(key) != first.get(key))
    return f"{key} has {widths.get(key, 'none')} per step here, but {first.get(key, 'none')}"


def _arrays(demo: h5py.Group) -> dict[str, h5py.Dataset]:
    """Return the arrays of a demo that count, by their paths: T rows each. None is read."""
    parts, n_steps = ("actions", "rewards", "terminals", "dones", "obs", "next_obs"), _length(demo) or 0
    arrays = {path: entry for part in parts if part in demo for path, entry in entries(demo[part], part).items()}
    for path, entry in arrays.items():
        check_rows(path, entry, n_steps)
        before = arrays.get(path.removeprefix("next_"), entry)
        if entry.shape != before.shape:
            raise BadInput(f"{path} must have the shape of {before.name}, {before.shape}, got {entry.shape}")
    return arrays


def _read(demo: h5py.Group, forms: Mapping[str, PictureForm]) -> ConvertedEpisode:
    arrays = _arrays(demo)
    actions = read_array(arrays["actions"], np.float32)
    rewards = read_array(arrays["rewards"], np.float32) if "rewards" in arrays else np.full(len(actions), np.nan, "f4")
    obs = {}
    for path, entry in arrays.items():
        if path.startswith("obs") and is_numbers(entry, forms.get(path)):
            rows: FloatArray = read_array(entry, np.float32).reshape(len(entry), -1)
            after = arrays.get(f"next_{path}")
            last = rows[-1:] if after is None else read_array(after, np.float32)[-1:].reshape(1, -1)
            obs[path.removeprefix("obs/").replace("/", ".")] = np.concatenate([rows, last])
    ends = next((arrays[name] for name in ("terminals", "dones") if name in arrays), None)
    return ConvertedEpisode(
        obs,
        actions,
        rewards[:, 0] if rewards.shape[1:] == (1,) else rewards,
        terminated=ends is not None and bool(read_array(ends, np.float32)[-1].any()),
    )


def open_robomimic(
    path: Path, keys: Sequence[str], *, with_frames: bool = True
) -> tuple[ConvertedTrajectories, Pictures | None]:
    """Open a robomimic file.

    Args:
        path: the file.
        keys: entries of obs/ that are the frames, one per view; empty: the only pictures.
        with_frames: False where the frames are elsewhere.

    Returns:
        The episodes; and their pictures, None without any or without `with_frames`.

    Raises:
        BadInput: another kind of file, no demos, or the choice of pictures is ambiguous.
    """
    with open_hdf5(path) as file:
        names, n_steps = _demos(file, path), []
        for name in names:
            with _named(name, path):
                n_steps.append(len(_arrays(file[name])["actions"]))
        numbers = [entry for entry in entries(file[names[0]]["obs"]).values() if is_numbers(entry)]
        n_bytes = 4 * sum(n_steps) * (32 + sum(int(np.prod(entry.shape[1:])) for entry in numbers))
    pictures = picture_entries(path, f"{names[0]}/obs")
    read = partial(read_episodes, path.resolve(), names)
    demos = tuple(name.removeprefix("data/") for name in names)
    trajectories = ConvertedTrajectories(path.resolve(), "robomimic", demos, tuple(n_steps), n_bytes, read)
    if not with_frames or not (keys or any(form.channels for form in pictures.values())):
        return trajectories, None
    chosen = choose_pictures(pictures, keys, str(path), "obs")
    after = tuple(f"next_obs/{key}" for key in chosen)
    with open_hdf5(path) as file:
        has_last = all(split_part(key)[0] in file[name] for key in after for name in names)
    views = tuple(f"obs/{key}" for key in chosen)
    return trajectories, Pictures(path.resolve(), tuple(names), views, after if has_last else ())
