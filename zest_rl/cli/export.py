"""``zest export``: a dataset → a file that other offline-RL code reads."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from zest_rl.cli.ui import Ui

SUFFIXES = {"npz": "npz", "d4rl": "hdf5", "robomimic": "hdf5"}
NEXT = {
    "npz": "python -c \"import numpy; print({{k: v.shape for k, v in numpy.load('{path}').items()}})\"",
    "d4rl": "python -c \"import h5py; print({{k: v.shape for k, v in h5py.File('{path}').items()}})\"",
    "robomimic": "python -m robomimic.scripts.get_dataset_info --dataset {path}",
}


@dataclass(frozen=True)
class Config:
    """Write a dataset in another format: transitions (o_t, a_t, r_t, o_t+1), nothing shifted, nothing lost; scores and
    ground truth beside the rewards, under names of their own.
    """

    dataset: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATASET")]
    """Minari dataset, relabeled or not."""
    to: Literal["npz", "d4rl", "robomimic"] = "npz"
    """Flat arrays; HDF5 for d4rl.qlearning_dataset(env, dataset=…), which leaves out the last transition before a time
    limit; or robomimic's HDF5 (config: low_dim ["flat"], experiment.rollout.enabled false)."""
    output: Path | None = None
    """The file; default DATASET.npz or DATASET.FORMAT.hdf5 here."""
    shape: Literal["step", "difference", "terminal"] = "step"
    """The rewards as they are, their change, or the last one alone."""
    normalise: bool = False
    """Shift and scale the rewards to [0, 1] over the dataset."""


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Read, shape, write."""
    from zest_rl.export import Rewards, export

    name = config.dataset.split("/")[-1]
    default = f"{name}.npz" if config.to == "npz" else f"{name}.{config.to}.{SUFFIXES[config.to]}"
    written = export(config.dataset, config.to, config.output or Path(default), Rewards(config.shape, config.normalise))
    return {
        "file": str(written.path),
        "n_episodes": written.n_episodes,
        "n_transitions": written.n_transitions,
        "arrays": sorted(written.arrays),
        "bytes": written.path.stat().st_size,
        "next": NEXT[config.to].format(path=written.path),
    }
