"""robomimic's HDF5: one group per demonstration, and masks for training and validation."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np

from zest_rl.export.transitions import TransitionDataset

VALID_SHARE = 0.1
"""Of the episodes, for the mask ``valid``."""


def write(path: Path, data: TransitionDataset) -> None:
    """Write ``data/demo_I`` with ``obs/flat`` and ``next_obs/flat``; ``dones`` includes timeouts.

    A single episode is in the mask ``train``, and ``valid`` is empty, which robomimic's SequenceDataset accepts.

    Raises:
        BadInput: actions are whole numbers.
    """
    data.check_continuous("robomimic")
    episodes = data.episodes
    names = [f"demo_{i}" for i in range(len(episodes))]
    with h5py.File(path, "w") as file:
        group = file.create_group("data")
        for name, episode in zip(names, episodes, strict=True):
            demo = group.create_group(name)
            demo.attrs["num_samples"] = len(episode["rewards"])
            demo.create_dataset("obs/flat", data=episode["observations"])
            demo.create_dataset("next_obs/flat", data=episode["next_observations"])
            for key in ("actions", "rewards"):
                demo.create_dataset(key, data=episode[key])
            demo.create_dataset("dones", data=(episode["terminals"] | episode["timeouts"]).astype(np.int64))
            for key in sorted(episode.keys() - {"observations", "next_observations", "actions", "rewards"}):
                demo.create_dataset(key, data=episode[key])
        group.attrs["total"] = len(data)
        spec = data.record.env or {"id": "unknown"}
        env = {"env_name": spec["id"], "type": 2, "env_kwargs": spec.get("kwargs", {})}  # 2: a Gym environment
        group.attrs["env_args"] = json.dumps(env)
        group.attrs["about"] = json.dumps(data.about)
        n_valid = max(1, round(VALID_SHARE * len(names))) if len(names) > 1 else 0
        valid = set(np.random.default_rng(0).permutation(len(names))[:n_valid].tolist())
        for mask, members in (("valid", valid), ("train", set(range(len(names))) - valid)):
            file.create_dataset(f"mask/{mask}", data=np.array([names[i].encode() for i in sorted(members)], dtype="S"))
