"""TorchRL's offline data: a folder of memory maps that `TensorDict.load_memmap` reads, or the TensorDict itself.

Keys as in TorchRL's own offline datasets::

    observation (N, obs_dim)   action (N, act_dim)   episode (N,)   gt_episode_success (N, 1)
    next: observation (N, obs_dim)   reward, done, terminated, truncated, zest_score, gt_reward (N, 1)

Do not use TorchRL's own loader of Minari datasets: `MinariExperienceReplay` of 0.14.1 returns zeros.

Layout of the folder: tensordict 0.14.3, `tensordict/_td_memmap.py`, `_save_metadata` and `_update_metadata`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zest_rl.data.reader import open_dataset
from zest_rl.export.transitions import Shape, TransitionDataset, read_transitions
from zest_rl.runtime import artifacts

if TYPE_CHECKING:
    from tensordict import TensorDict

TYPE = "<class 'tensordict._td.TensorDict'>"


def nested(data: TransitionDataset) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]]]:
    """Return the arrays at the root and those under ``next``."""
    flat = data.flat
    root = {"observation": flat["observations"], "action": flat["actions"], "episode": flat["episode"]}
    after = {
        "observation": flat["next_observations"],
        "reward": flat["rewards"],
        "done": flat["terminals"] | flat["timeouts"],
        "terminated": flat["terminals"],
        "truncated": flat["timeouts"],
    }
    for name in sorted({"zest_score", "gt_reward", "source_reward", "success"} & flat.keys()):
        after[name] = flat[name]
    if "gt_episode_success" in flat:
        root["gt_episode_success"] = flat["gt_episode_success"][:, None]
    return root, {name: values if values.ndim == 2 else values[:, None] for name, values in after.items()}


def write(folder: Path, data: TransitionDataset) -> list[str]:
    """Write one raw little-endian ``KEY.memmap`` per array and ``meta.json``; ``about.json`` beside them."""
    root, after = nested(data)
    (folder / "next").mkdir()
    _write_level(folder, root, {"next": {"type": "TensorDict"}})
    _write_level(folder / "next", after, {})
    artifacts.write_json(folder / "about.json", data.about)
    return [*root, *(f"next/{name}" for name in after)]


def _write_level(folder: Path, arrays: dict[str, NDArray[Any]], children: dict[str, Any]) -> None:
    meta: dict[str, Any] = dict(children)
    for name, values in arrays.items():
        (folder / f"{name}.memmap").write_bytes(np.ascontiguousarray(values).data)
        dtype = f"torch.{values.dtype.name}"
        meta[name] = {"device": "cpu", "shape": list(values.shape), "dtype": dtype, "is_nested": False}
    n_transitions = len(arrays["observation"])
    meta |= {"shape": [n_transitions], "device": "None", "_type": TYPE}
    (folder / "meta.json").write_text(json.dumps(meta), encoding="utf-8")


def to_torchrl(dataset_id: str, *, shape: Shape = "step", normalise: bool = False) -> TensorDict:
    """Read a dataset as a TensorDict of batch size (N,), without a file; arguments and errors as in `transitions`.

    Raises:
        ImportError: tensordict is not installed.
    """
    import torch
    from tensordict import TensorDict

    with open_dataset(dataset_id) as ds:
        root, after = nested(read_transitions(ds, shape, normalise))
    tensors: dict[str, Any] = {name: torch.from_numpy(array) for name, array in root.items()}
    tensors["next"] = {name: torch.from_numpy(array) for name, array in after.items()}
    return TensorDict(tensors, batch_size=[len(root["episode"])])
