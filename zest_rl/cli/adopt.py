"""``zest adopt``: a policy that another program trained → a run folder, as `zest train` leaves one."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from zest_rl.cli.ui import Ui


@dataclass(frozen=True)
class Config:
    """Take over a policy that another program trained, so that it is evaluated and compared like those trained here.

    POLICY is torchscript:FILE.pt, onnx:FILE.onnx, d3rlpy:FILE.d3, "command:PROGRAM …", or NAME:REST of an installed
    package. It runs code of whoever made it. docs/foreign_policies.md shows each.
    """

    policy: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="POLICY")]
    """What acts: raw observations (N, obs_dim) in, actions (N, act_dim) in [-1, 1] out."""
    dataset: str
    """Minari dataset that it was trained on; says task, goal and the references of normalized returns."""
    name: str | None = None
    """Row of tables, such as "IQL, d3rlpy"; default the file's name and the kind. Equal names are one method."""
    seed: int = 0
    """Seed that it was trained with; tells policies of one name apart."""
    python: str | None = None
    """For d3rlpy:, the Python that has d3rlpy, such as other-venv/bin/python."""
    run_dir: Path | None = None
    """Folder of this run; default runs/DATASET-NAME-seedN-HASH, where a changed file has another HASH."""


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Hash, copy, try."""
    from zest_rl.agents.foreign import identify
    from zest_rl.data import reader
    from zest_rl.rewards.relabel import SCORER_FILE
    from zest_rl.runtime import artifacts
    from zest_rl.training.adoption import adopt

    source = identify(config.policy, config.python)
    name = config.name if config.name is not None else f"{_stem(source.words[-1])} ({source.family})"
    described = reader.describe(config.dataset)
    slug = re.sub(r"[^A-Za-z0-9]+", "-", name).strip("-")
    digest = artifacts.hash_json([source.described(), name, described])[:8]
    default = Path("runs") / f"{config.dataset.split('/')[-1]}-{slug}-seed{config.seed}-{digest}"
    run_dir = config.run_dir or default
    ui.say(f"trying {config.policy} and copying it to {run_dir}")
    scorer = reader.dataset_path(config.dataset) / SCORER_FILE
    adopt(
        source,
        name,
        reader.read_episodes(config.dataset),
        run_dir,
        seed=config.seed,
        meta={"dataset": described},
        files={SCORER_FILE: scorer.read_bytes()} if scorer.exists() else {},
    )
    return {
        "run": str(run_dir),
        "name": name,
        "files": dict(source.files),
        "next": f"zest evaluate {shlex.quote(str(run_dir))}",
    }


def _stem(word: str) -> str:
    return Path(word).stem or word
