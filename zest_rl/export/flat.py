"""Equally long arrays of all transitions: NumPy's npz, and HDF5 as D4RL's and CORL's loaders read it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from zest_rl.export.hdf5 import write_hdf5
from zest_rl.export.transitions import TransitionDataset


def write_npz(path: Path, data: TransitionDataset) -> list[str]:
    """Write the arrays of `transitions` under the same names, and ``about`` as JSON."""
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, about=np.array(json.dumps(data.about)), **data.flat)
    return list(data.flat)


def write_d4rl(path: Path, data: TransitionDataset) -> list[str]:
    """Write the same arrays at the root of an HDF5 file, and ``about`` as an attribute."""
    write_hdf5(path, data.flat, {"/": {"about": json.dumps(data.about)}}, compression="gzip")
    return list(data.flat)
