"""robomimic's HDF5: one group per demonstration, and masks for training and validation."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from zest_rl.export.hdf5 import write_hdf5
from zest_rl.export.transitions import TransitionDataset

VALID_SHARE = 0.1
"""Of the episodes, for the mask ``valid``."""


def write(path: Path, data: TransitionDataset) -> list[str]:
    """Write ``data/demo_I`` with ``obs/flat`` and ``next_obs/flat``; ``dones`` includes timeouts.

    A single episode is in the mask ``train``, and ``valid`` is empty, which robomimic's SequenceDataset accepts.

    Raises:
        BadInput: actions are whole numbers.
    """
    data.check_continuous("robomimic")
    episodes = data.episodes
    names = [f"demo_{i}" for i in range(len(episodes))]
    arrays: dict[str, Any] = {}
    attributes: dict[str, dict[str, Any]] = {}
    for name, episode in zip(names, episodes, strict=True):
        demo = f"data/{name}"
        attributes[demo] = {"num_samples": len(episode["rewards"])}
        renamed = {"observations": "obs/flat", "next_observations": "next_obs/flat"}
        arrays |= {f"{demo}/{renamed.get(key, key)}": values for key, values in episode.items()}
        arrays[f"{demo}/dones"] = (episode["terminals"] | episode["timeouts"]).astype(np.int64)
    spec = data.record.env or {"id": "unknown"}
    env = {"env_name": spec["id"], "type": 2, "env_kwargs": spec.get("kwargs", {})}  # 2: a Gym environment
    attributes["data"] = {"total": len(data), "env_args": json.dumps(env), "about": json.dumps(data.about)}
    n_valid = max(1, round(VALID_SHARE * len(names))) if len(names) > 1 else 0
    valid = set(np.random.default_rng(0).permutation(len(names))[:n_valid].tolist())
    for mask, members in (("valid", valid), ("train", set(range(len(names))) - valid)):
        arrays[f"mask/{mask}"] = np.array([names[i].encode() for i in sorted(members)], dtype="S")
    write_hdf5(path, arrays, attributes)
    return [name.replace("demo_0", "demo_I") for name in arrays if name.startswith("data/demo_0/")]
