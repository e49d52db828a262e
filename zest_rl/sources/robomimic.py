"""robomimic's HDF5 files: ``data/demo_I`` with ``obs/``, ``actions``, ``rewards``, ``dones`` and mostly ``next_obs/``.

Layout: https://robomimic.github.io/docs/datasets/overview.html. obs/KEY has T rows, o_0 … o_{T-1}; o_T is the
last row of next_obs/KEY, or repeats o_{T-1} where there is no next_obs. An episode counts as terminated if the last of
its ``terminals`` is 1, which `zest export` records; without these, of its ``dones``; without either it is truncated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import h5py
import numpy as np

from zest_rl.data.observations import choose_pictures, entries, is_numbers
from zest_rl.errors import BadInput
from zest_rl.sources.conversion import ConvertedEpisode, ConvertedTrajectories
from zest_rl.sources.pictures import Pictures, picture_entries
from zest_rl.types import FloatArray


def read_episodes(path: Path, names: Sequence[str]) -> Iterator[ConvertedEpisode]:
    """Read one episode at a time, from groups such as ``data/demo_0``."""
    with h5py.File(path, "r") as file:
        for name in names:
            yield _read(file[name])


def _read(demo: h5py.Group) -> ConvertedEpisode:
    actions = np.asarray(demo["actions"][()], np.float32)
    rewards = np.asarray(demo["rewards"][()], np.float32) if "rewards" in demo else np.full(len(actions), np.nan, "f4")
    obs = {}
    for path, entry in entries(demo["obs"]).items():
        if is_numbers(entry):
            rows: FloatArray = np.asarray(entry[()], np.float32).reshape(len(entry), -1)
            after = demo.get(f"next_obs/{path}")
            last = rows[-1:] if after is None else np.asarray(after[-1:], np.float32).reshape(1, -1)
            obs[path.replace("/", ".")] = np.concatenate([rows, last])
    ends = next((np.asarray(demo[name][()]) for name in ("terminals", "dones") if name in demo), np.zeros(1))
    try:
        return ConvertedEpisode(obs, actions, rewards, bool(len(ends) and ends[-1]))
    except BadInput as error:
        raise BadInput(f"{demo.name}: {error}") from error


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
    try:
        with h5py.File(path, "r") as file:
            demos = file.get("data")
            members = [name for name in demos if name.startswith("demo_")] if isinstance(demos, h5py.Group) else []
            misnamed = [name for name in members if not name.removeprefix("demo_").isdecimal()]
            if misnamed:
                raise BadInput(f"episodes must be named data/demo_0, data/demo_1, …, got data/{misnamed[0]} in {path}")
            names = [f"data/{name}" for name in sorted(members, key=lambda name: int(name.removeprefix("demo_")))]
            incomplete = [name for name in names if "actions" not in file[name] or "obs" not in file[name]]
            if not names or incomplete:
                raise BadInput(
                    f"{path} must hold data/demo_0, … with actions and obs/, as robomimic's files do; "
                    + (
                        f"{incomplete[0]} lacks one of them (extract observations first)"
                        if incomplete
                        else "it has none"
                    )
                )
            n_steps = tuple(len(file[name]["actions"]) for name in names)
            numbers = [e for e in entries(file[names[0]]["obs"]).values() if is_numbers(e)]
            n_bytes = 4 * sum(n_steps) * (32 + sum(int(np.prod(e.shape[1:])) for e in numbers))
    except OSError as error:
        raise BadInput(f"{path} cannot be read as HDF5 ({error}); relabel takes robomimic's files") from error
    pictures = picture_entries(path, f"{names[0]}/obs")
    read = partial(read_episodes, path.resolve(), names)
    trajectories = ConvertedTrajectories(path.resolve(), "robomimic", n_steps, n_bytes, read)
    if not with_frames or not (keys or any(pictures.values())):
        return trajectories, None
    chosen = choose_pictures(pictures, keys, str(path), "obs")
    after = tuple(f"next_obs/{key}" for key in chosen)
    with h5py.File(path, "r") as file:
        has_last = all(key in file[name] for key in after for name in names)
    views = tuple(f"obs/{key}" for key in chosen)
    return trajectories, Pictures(path.resolve(), tuple(names), views, after if has_last else ())
