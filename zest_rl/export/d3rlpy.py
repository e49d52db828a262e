"""d3rlpy's replay buffers: the HDF5 file that `ReplayBuffer.load` reads, or the buffer itself.

A d3rlpy episode has as many observations as actions, so the last observation is left out, and d3rlpy's Q-learning
uses the last step of an episode only if it is terminal. Do not use d3rlpy's own loader of Minari datasets: `get_minari`
of 2.8.1 shifts episode i by i observations.

Layout: d3rlpy 2.8.1, `d3rlpy/dataset/io.py`, `dump` and `load`, DATASET_VERSION 2.1.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from zest_rl.errors import BadInput
from zest_rl.export.hdf5 import write_hdf5
from zest_rl.export.transitions import Shape, TransitionDataset, Transitions, transitions

if TYPE_CHECKING:
    import d3rlpy

VERSION = "2.1"


def fields(episode: Transitions) -> dict[str, object]:
    """The fields of d3rlpy's `Episode`: observations (T, obs_dim), actions, rewards (T, 1), terminated.

    Actions are (T, act_dim) float32 or, for a Discrete space, (T, 1) int64; d3rlpy infers the space from the dtype.

    Raises:
        BadInput: several whole numbers per action, which d3rlpy would read as one.
    """
    actions = episode["actions"].reshape(len(episode["actions"]), -1)
    if actions.dtype.kind == "i" and actions.shape[1] > 1:
        raise BadInput(
            f"d3rlpy takes one whole number per action, got {actions.shape[1]}; export to npz, d4rl or torchrl"
        )
    return {
        "observations": episode["observations"],
        "actions": actions,
        "rewards": episode["rewards"][:, None],
        "terminated": bool(episode["terminals"][-1]),
    }


def write(path: Path, data: TransitionDataset) -> list[str]:
    """Write `NAME_I` of every episode; d3rlpy ignores names that are not in ``columns``, such as ``zest_score_I``."""
    arrays = {"columns": list(fields(data.episodes[0])), "num_episodes": len(data.episodes), "version": VERSION}
    for i, episode in enumerate(data.episodes):
        arrays |= {f"{name}_{i}": values for name, values in {**episode, **fields(episode)}.items()}
    write_hdf5(path, arrays, {"/": {"about": json.dumps(data.about)}})
    return [f"{name}_I" for name in {**data.episodes[0], **fields(data.episodes[0])}]


def to_d3rlpy(dataset_id: str, *, shape: Shape = "step", normalise: bool = False) -> d3rlpy.dataset.ReplayBuffer:
    """Read a dataset as a d3rlpy `ReplayBuffer`, without a file; arguments and errors as in `transitions`.

    Raises:
        ImportError: d3rlpy is not installed.
    """
    from d3rlpy.dataset import Episode, create_infinite_replay_buffer

    episodes = transitions(dataset_id, shape=shape, normalise=normalise)
    return create_infinite_replay_buffer([Episode(**fields(episode)) for episode in episodes])
