"""Policies that other programs trained → run folders, evaluated and compared like those of `zest_rl.training.loop`.

A folder has the policy's own files under ``policy/`` (those that are one: a command's stay where they are), and a
``meta.json`` with the keys of a training's that do not depend on how it was trained, and these::

    name        row of tables
    policy      family, words and files with their sha256: see `zest_rl.agents.foreign.Source`
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from zest_rl.agents import foreign
from zest_rl.agents.base import describe_data
from zest_rl.errors import BadInput
from zest_rl.runtime import artifacts
from zest_rl.types import Episode

N_TRIED = 8
"""Episodes whose first observations a policy has to act on before it is adopted."""


def adopt(
    source: foreign.Source,
    name: str,
    episodes: Sequence[Episode],
    run_dir: Path,
    *,
    seed: int,
    meta: Mapping[str, Any],
    files: Mapping[str, bytes],
) -> Path:
    """Try a policy, and make the run folder of it; return `run_dir`. A folder that holds it already is left as it is.

    Args:
        source: the policy.
        name: row of tables; policies with equal names are one method, one for each training seed.
        episodes: the data that it was trained on; it is tried on observations of some.
        run_dir: folder of this run alone.
        seed: that it was trained with.
        meta: facts about the data (JSON), as for `zest_rl.training.loop.train`.
        files: name → content of what else the folder holds.

    Raises:
        BadInput: the policy cannot be read, the name is empty, or the folder holds something else.
        ZestError: the policy fails, or its actions are not what they must be. No folder is left then.
    """
    if not name.strip() or seed < 0:
        raise BadInput(f"a policy needs a name and a seed of at least 0, got {name!r} and {seed}")
    facts = describe_data(episodes)
    request: dict[str, Any] = {
        "agent": foreign.FOREIGN,
        "name": name,
        "config": {},
        "n_updates": None,
        "seed": seed,
        "policy": source.described(),
        "obs_dim": facts.obs_dim,
        "act_dim": facts.act_dim,
        "data_sha256": artifacts.hash_arrays(*(a for e in episodes for a in (e.obs, e.actions, e.rewards))),
        **meta,
    }
    with artifacts.lock(run_dir):
        if (run_dir / "meta.json").exists():
            before = artifacts.read_json(run_dir / "meta.json")
            differing = sorted(key for key, value in request.items() if before.get(key) != value)
            if differing:
                raise BadInput(f"{run_dir} holds another run ({', '.join(differing)} differ); choose another folder")
            return run_dir
        if run_dir.exists() and any(run_dir.iterdir()):
            raise BadInput(f"{run_dir} is not empty and holds no policy; choose another folder")
        with artifacts.staged_folder(run_dir) as staging:
            for place, original in source.originals.items():
                (staging / place).parent.mkdir(exist_ok=True)
                shutil.copyfile(original, staging / place)
            for file, content in files.items():
                artifacts.write_bytes(staging / file, content)
            _try(foreign.load(staging, request, torch.device("cpu")), episodes[:N_TRIED])
            artifacts.write_json(staging / "meta.json", request | {"made_by": artifacts.provenance()})
    return run_dir


def _try(policy: foreign.ForeignPolicy, episodes: Sequence[Episode]) -> None:
    """Let it act on the first two observations of some episodes in step."""
    try:
        policy.begin(len(episodes))
        for step in range(2):
            policy.act(np.stack([episode.obs[step] for episode in episodes]))
    finally:
        policy.end()
