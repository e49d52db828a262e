"""``zest adopt``: a policy that another program trained → a run folder, as `zest train` leaves one."""

from __future__ import annotations

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
    from zest_rl.runtime import artifacts
    from zest_rl.runtime.privacy import masked
    from zest_rl.training.adoption import adopt

    run_dir = adopt(
        config.policy,
        config.dataset,
        name=config.name,
        seed=config.seed,
        python=config.python,
        run_dir=config.run_dir,
        on_start=lambda folder: ui.say(f"trying {config.policy} and copying it to {folder}"),
    )
    meta = artifacts.read_json(run_dir / "meta.json")
    return {
        "run": str(run_dir),
        "name": meta["name"],
        "files": masked(meta["policy"]["files"]),
        "next": f"zest evaluate {shlex.quote(str(run_dir))}",
    }
