"""Datasets → what other offline-RL code reads, as files or, for d3rlpy and TorchRL, as their own objects.

Transition t of an episode is (o_t, a_t, r_t, o_{t+1}); nothing is shifted and nothing is lost. Ground truth and scores
go along under names of their own, and are never the reward unless the dataset's rewards are them.

- ``npz``: flat arrays (N, …) of all transitions, in the order of episodes, which `episode` tells apart.
- ``d4rl``: the same names at the root of an HDF5 file, as ``d4rl.qlearning_dataset(env, dataset=…)`` reads them; that
  function leaves out the last transition of every episode that a time limit ended.
- ``robomimic``: ``data/demo_I`` per episode with ``obs/flat`` and ``next_obs/flat``, and masks ``train`` and ``valid``.
- ``d3rlpy``: HDF5 for ``ReplayBuffer.load``; its Q-learning leaves out the same transition as D4RL's.
- ``torchrl``: a folder for ``TensorDict.load_memmap``.
- ``lerobot``: a folder, LeRobotDataset v3.0 without videos; ``lerobot-progress``: its side-car of scores alone.

docs/interop.md has a recipe for each, and what of it is tested against which version. To read and to write, NumPy,
h5py and filelock are enough (and pyarrow for LeRobot's), so this works in the environments that those libraries pin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from zest_rl.errors import BadInput, nearest
from zest_rl.export import d3rlpy, flat, lerobot, robomimic, torchrl
from zest_rl.export.d3rlpy import to_d3rlpy
from zest_rl.export.torchrl import to_torchrl
from zest_rl.export.transitions import (
    AS_RECORDED,
    Contents,
    Rewards,
    Shape,
    Transitions,
    read,
    read_scores,
    transitions,
)
from zest_rl.runtime import artifacts

__all__ = [
    "AS_RECORDED", "Exported", "Format", "Rewards", "Shape", "Transitions", "export", "to_d3rlpy", "to_torchrl",
    "transitions",
]  # fmt: skip

Format = Literal["npz", "d4rl", "robomimic", "d3rlpy", "torchrl", "lerobot", "lerobot-progress"]

WRITERS: dict[str, Callable[[Path, Contents], None]] = {
    "npz": flat.write_npz,
    "d4rl": flat.write_d4rl,
    "robomimic": robomimic.write,
    "d3rlpy": d3rlpy.write,
    "torchrl": torchrl.write,
    "lerobot": lerobot.write,
    "lerobot-progress": lerobot.write_progress,
}
FOLDERS = ("torchrl", "lerobot")
"""Formats of several files; their writers fill an empty folder."""
WITHOUT_LAST_STEP = {"d4rl": "D4RL's loader", "d3rlpy": "d3rlpy's Q-learning"}
"""Who leaves out the last transition of an episode that a time limit ended."""


@dataclass(frozen=True)
class Exported:
    """What `export` wrote."""

    path: Path
    n_episodes: int
    n_transitions: int
    arrays: tuple[str, ...]
    """Names of the arrays of `transitions` that went into it."""
    n_bytes: int
    left_out: tuple[str, ...]
    """Entries of the observations that are no numbers: pictures and text."""


def export(dataset_id: str, to: Format, path: Path, rewards: Rewards = AS_RECORDED, fps: int | None = None) -> Exported:
    """Write a dataset in another format, atomically.

    Args:
        dataset_id: any dataset with numbers among its observations; of pictures alone for ``lerobot-progress``.
        to: the format.
        path: the file, or the folder (`FOLDERS`); it must not exist.
        rewards: how the dataset's rewards are handed on.
        fps: steps per second, which LeRobot alone records; None: as the dataset was recorded, if that is known, else
            the kitchen's.

    Raises:
        BadInput: no such dataset, an unknown format, there is a file already, or the format would lose the rewards.
        ZestError: the disk is full or read-only, or pyarrow is missing.
    """
    if to not in WRITERS:
        raise BadInput(f"unknown format {to!r}; {nearest(to, WRITERS)}")
    if path.exists():
        raise BadInput(f"{path} exists; delete it, or choose another --output")
    if to == "lerobot-progress" and rewards != AS_RECORDED:
        raise BadInput("lerobot-progress holds scores of frames and no rewards; leave --shape and --normalise out")
    contents = read_scores(dataset_id) if to == "lerobot-progress" else read(dataset_id, rewards)
    if (
        to in WITHOUT_LAST_STEP
        and rewards.shape == "terminal"
        and any(one["timeouts"].any() for one in contents.episodes)
    ):
        raise BadInput(
            f"{WITHOUT_LAST_STEP[to]} leaves out the transition at a time limit, which holds the only reward of "
            "'terminal'; export 'step' or 'difference', or to npz"
        )
    writer = partial(lerobot.write, fps=fps) if to == "lerobot" else WRITERS[to]
    size = sum(array.nbytes for episode in contents.episodes for array in episode.values())
    artifacts.check_free_space(path.parent, 2 * size)
    if to in FOLDERS:
        with artifacts.lock(path), artifacts.staged_folder(path) as staging:
            writer(staging, contents)
    else:
        with artifacts.atomic_path(path) as temporary:
            writer(temporary, contents)
    files = [file for file in (path, *path.rglob("*")) if file.is_file()]
    n_bytes = sum(file.stat().st_size for file in files)
    arrays, left_out = tuple(contents.episodes[0]), tuple(contents.about["left_out"])
    return Exported(path, len(contents.episodes), len(contents), arrays, n_bytes, left_out)
