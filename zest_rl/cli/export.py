"""``zest export``: a dataset → files that other offline-RL code reads."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from zest_rl.cli.ui import Ui

NEXT = {
    "npz": "python -c \"import numpy; print({{k: v.shape for k, v in numpy.load('{path}').items()}})\"",
    "d4rl": "python -c \"import h5py; print({{k: v.shape for k, v in h5py.File('{path}').items()}})\"",
    "robomimic": "python -m robomimic.scripts.get_dataset_info --dataset {path}",
    "d3rlpy": 'python -c "from d3rlpy.dataset import ReplayBuffer, InfiniteBuffer; '
    "print(ReplayBuffer.load(open('{path}', 'rb'), InfiniteBuffer()).dataset_info)\"",
    "torchrl": "python -c \"from tensordict import TensorDict; print(TensorDict.load_memmap('{path}'))\"",
    "lerobot": 'python -c "from lerobot.datasets.lerobot_dataset import LeRobotDataset; '
    "print(LeRobotDataset('zest/{name}', root='{path}'))\"",
    "lerobot-progress": "cp {path} YOUR_LEROBOT_DATASET/sarm_progress.parquet",
}


@dataclass(frozen=True)
class Config:
    """Write a dataset in another format: transitions (o_t, a_t, r_t, o_t+1), nothing shifted, nothing lost; scores and
    ground truth beside the rewards, under names of their own.
    """

    dataset: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATASET")]
    """Minari dataset, relabeled or not."""
    to: Literal["npz", "d4rl", "robomimic", "d3rlpy", "torchrl", "lerobot", "lerobot-progress"] = "npz"
    """Flat arrays; HDF5 for d4rl.qlearning_dataset(env, dataset=…), which leaves out the last transition before a time
    limit; robomimic's HDF5 (config: low_dim ["flat"], experiment.rollout.enabled false); HDF5 for d3rlpy's
    ReplayBuffer.load; a folder for TensorDict.load_memmap; a LeRobotDataset v3.0; or the scores alone, as LeRobot's
    sarm_progress.parquet. The last two need zest-rl[lerobot]. docs/interop.md has a recipe for each."""
    output: Path | None = None
    """The file or folder; default DATASET.FORMAT here."""
    shape: Literal["step", "difference", "terminal"] = "step"
    """The rewards as they are, their change, or the last one alone."""
    normalise: bool = False
    """Shift and scale the rewards to [0, 1] over the dataset."""
    fps: int | None = None
    """Steps per second, which LeRobot's timestamps are made of; default: those of the LeRobot folder that the dataset
    comes from, else the kitchen's, 12."""


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Read, shape, write."""
    from zest_rl.export import export

    written = export(
        config.dataset, config.to, config.output, shape=config.shape, normalise=config.normalise, fps=config.fps
    )
    if written.left_out:
        ui.warn(f"left out, as they are pictures or text: {', '.join(written.left_out)}")
    return {
        "file": str(written.path),
        "n_episodes": written.n_episodes,
        "n_transitions": written.n_transitions,
        "arrays": sorted(written.arrays),
        "left_out": list(written.left_out),
        "bytes": written.n_bytes,
        "next": NEXT[config.to].format(path=written.path, name=config.dataset.split("/")[-1]),
    }
