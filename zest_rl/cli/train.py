"""``zest train AGENT``: a dataset → a policy. One sub-verb per entry of the agents' registry."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, ClassVar

import tyro

from zest_rl.cli.ui import SilentUi, Ui
from zest_rl.training.distributed import launched


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """What every agent's training needs; the agent's own fields are flags beside these."""

    agent: ClassVar[str]
    dataset: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATASET")]
    """Minari dataset; its rewards are the output of `zest relabel`, or the ground truth of `zest collect`."""
    run_dir: Path | None = None
    """Folder of this run; default runs/DATASET-AGENT-seedN."""
    n_updates: int = 5000
    """Gradient steps."""
    seed: int = 0
    """Of weights, batches and dropout."""
    device: str = "auto"
    """auto, cpu, cuda, cuda:1, …"""
    threads: int | None = None
    """CPU threads; default torch's own. The last digits of the result depend on it."""
    checkpoint_every: int = 500
    """Updates between checkpoints, from which a cut run goes on."""
    log_every: int = 50
    """Updates between log rows (metrics.csv, TensorBoard)."""
    snapshot_every: int | None = None
    """Updates between policies kept in RUN/snapshots, which `zest evaluate` takes too; default none."""


def __getattr__(name: str) -> Any:
    """Build ``CONFIGS`` when asked for: the registry imports torch."""
    if name != "CONFIGS":
        raise AttributeError(name)
    from zest_rl.agents import AGENTS

    return {agent: _with_arguments(agent, entry.config) for agent, entry in AGENTS.items()}


def _with_arguments(agent: str, config: type[Any]) -> type[Any]:
    members = {"agent": agent, "__doc__": f"Train {(config.__doc__ or agent).splitlines()[0]}", "__annotations__": {}}
    return dataclass(frozen=True, kw_only=True)(type(f"{config.__name__}Arguments", (Arguments, config), members))


def run(config: Arguments, ui: Ui) -> dict[str, Any]:
    """Train, or go on training; of several processes under ``torchrun`` the first one tells."""
    from zest_rl.agents import AGENTS
    from zest_rl.evaluation.evaluate import is_evaluable

    first = launched().leads
    agent_class = AGENTS[config.agent].config
    agent_config = agent_class(**{field.name: getattr(config, field.name) for field in fields(agent_class)})
    name = config.dataset.split("/")[-1]
    run_dir = config.run_dir or Path("runs") / f"{name}-{config.agent}-seed{config.seed}"
    meta = train_on_dataset(config, agent_config, run_dir, ui if first else SilentUi())
    if not first:
        return {}
    quoted = shlex.quote(str(run_dir))
    return {
        "run": str(run_dir),
        "agent": config.agent,
        "n_params": meta["n_params"],
        "n_updates": meta["n_updates"],
        "train_seconds": meta["train_seconds"],
        "next": f"zest evaluate {quoted}" if is_evaluable(meta["dataset"]) else f"zest export {config.dataset}",
    }


def train_on_dataset(config: Arguments, agent_config: Any, run_dir: Path, ui: Ui) -> dict[str, Any]:
    """Train `agent_config` on a dataset and leave its scorer, if it has one, in the run folder; return the meta."""
    from zest_rl.data import reader
    from zest_rl.rewards.relabel import SCORER_FILE
    from zest_rl.runtime import artifacts
    from zest_rl.training.checkpoints import snapshots
    from zest_rl.training.loop import train

    ui.say(f"training in {run_dir}")
    with ui.progress(f"{config.agent} updates", config.n_updates) as advance:
        shown = 0

        def on_progress(done: int, row: Any) -> None:
            nonlocal shown
            advance(done - shown, loss=row["loss"])
            shown = done

        train(
            config.agent,
            agent_config,
            reader.read_episodes(config.dataset),
            run_dir,
            n_updates=config.n_updates,
            seed=config.seed,
            meta={"dataset": reader.describe(config.dataset)},
            device=config.device,
            threads=config.threads,
            checkpoint_every=config.checkpoint_every,
            log_every=config.log_every,
            snapshot_every=config.snapshot_every,
            on_progress=on_progress,
        )
    scorer = reader.dataset_path(config.dataset) / SCORER_FILE
    if scorer.exists() and launched().leads:
        for folder in (run_dir, *snapshots(run_dir)):
            artifacts.write_bytes(folder / SCORER_FILE, scorer.read_bytes())
    meta: dict[str, Any] = artifacts.read_json(run_dir / "meta.json")
    return meta
