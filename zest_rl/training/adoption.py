"""Policies that other programs trained → run folders, evaluated and compared like those of `zest_rl.training.runs`.

A folder holds copies of the policy's files under ``policy/`` (a command's files stay where they are) and a
``meta.json`` with those keys of a trained run that do not depend on the training, and these::

    name        row of tables
    policy      family, words and files with their sha256: see `zest_rl.agents.foreign.PolicyIdentity`
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from zest_rl.agents import foreign
from zest_rl.agents.base import describe_data
from zest_rl.agents.configs import FOREIGN
from zest_rl.data.folders import CARD_FILE
from zest_rl.data.reader import open_dataset
from zest_rl.errors import BadInput
from zest_rl.rewards.cards import policy_card
from zest_rl.runtime import artifacts
from zest_rl.runtime.privacy import masked
from zest_rl.runtime.trust import remember
from zest_rl.training.request import data_sha256, default_run_dir
from zest_rl.training.runs import scorer_files
from zest_rl.types import Episode

N_TRIED = 8
"""Episodes whose first observations a policy must act on before it is adopted."""


def adopt(
    policy: str,
    dataset_id: str,
    *,
    name: str | None = None,
    seed: int = 0,
    python: str | None = None,
    run_dir: Path | None = None,
    on_start: Callable[[Path], None] | None = None,
) -> Path:
    """Make a run folder of a policy, after a trial; a folder that already holds it is left as it is.

    Args:
        policy: a spec as in the table of `zest_rl.agents.foreign`.
        dataset_id: Minari dataset that it was trained on, whose observations it is tried on.
        name: row of tables; default the file's name and the family. Policies with equal names are one method, one for
            each training seed.
        seed: of its training.
        python: for ``d3rlpy:``, the Python that has d3rlpy.
        run_dir: folder of this run alone; default runs/DATASET-NAME-seedN-HASH, where a changed file has another HASH.
        on_start: called with the run folder before the policy is tried.

    Returns:
        The run's folder. It holds the dataset's scorer, if the dataset has one.

    Raises:
        BadInput: there is no such policy or dataset, the name is empty, or the folder holds something else.
        ZestError: the policy fails, or its actions have the wrong shape or are not finite. Then no folder is left.
    """
    identity = foreign.identify(policy, python)
    if name is None:
        last = masked(identity.words)[-1]
        name = f"{Path(last).stem or last} ({identity.family})"
    if not name.strip() or seed < 0:
        raise BadInput(f"a policy needs a name and a seed of at least 0, got {name!r} and {seed}")
    with open_dataset(dataset_id) as dataset:
        episodes, description, files = dataset.episodes(), dataset.describe(), scorer_files(dataset)
    if run_dir is None:
        slug = re.sub(r"[^A-Za-z0-9]+", "-", name).strip("-")
        digest = artifacts.hash_json([identity.to_json(), name, description])[:8]
        run_dir = Path(f"{default_run_dir(slug, dataset_id, seed)}-{digest}")
    if on_start is not None:
        on_start(run_dir)
    facts = describe_data(episodes)
    request: dict[str, Any] = {
        "agent": FOREIGN,
        "name": name,
        "config": {},
        "n_updates": None,
        "seed": seed,
        "policy": identity.to_json(),
        "obs_dim": facts.obs_dim,
        "act_dim": facts.act_dim,
        "data_sha256": data_sha256(episodes),
        "dataset": description,
    }
    remember("policy", request["policy"])
    with artifacts.lock(run_dir):
        if (run_dir / "meta.json").exists():
            before = artifacts.read_json(run_dir / "meta.json")
            differing = sorted(key for key, value in request.items() if before.get(key) != value)
            if differing:
                raise BadInput(f"{run_dir} holds another run ({', '.join(differing)} differ); give another --run-dir")
            return run_dir
        if run_dir.exists() and any(run_dir.iterdir()):
            raise BadInput(f"{run_dir} is not empty and holds no policy; give another --run-dir")
        with artifacts.staged_folder(run_dir) as staging:
            for place, original in identity.originals.items():
                (staging / place).parent.mkdir(exist_ok=True)
                shutil.copyfile(original, staging / place)
            for file, content in files.items():
                artifacts.write_bytes(staging / file, content)
            _try(foreign.load(staging, request, torch.device("cpu")), episodes[:N_TRIED])
            told = {"max_steps": facts.max_steps, "made_by": artifacts.provenance()}
            artifacts.write_json(staging / "meta.json", request | told)
            artifacts.write_bytes(staging / CARD_FILE, policy_card(request).encode())
    return run_dir


def _try(policy: foreign.ForeignPolicy, episodes: Sequence[Episode]) -> None:
    """Let the policy act on the first two observations of some episodes in lockstep."""
    try:
        policy.begin(len(episodes))
        for step in range(2):
            policy.act(np.stack([episode.obs[step] for episode in episodes]))
    finally:
        policy.end()
