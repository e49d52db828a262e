"""``zest train AGENT``: a dataset → a policy. One sub-verb per entry of the agents' registry."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, ClassVar

import tyro

from zest_rl.api import trainer
from zest_rl.cli.ui import SilentUi, Ui
from zest_rl.training.distributed import launched


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """What is trained on; beside these, the fields of the agent's config and of its trainer's are flags."""

    agent: ClassVar[str]
    dataset: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATASET")]
    """Minari dataset; its rewards are the output of `zest relabel`, or the ground truth of `zest collect`."""
    run_dir: Path | None = None
    """Folder of this run; default runs/DATASET-AGENT-seedN."""


def __getattr__(name: str) -> Any:
    """Build ``CONFIGS`` when asked for."""
    if name != "CONFIGS":
        raise AttributeError(name)
    from zest_rl.agents.configs import CONFIGS

    return {agent: _with_arguments(agent, agent_class) for agent, agent_class in CONFIGS.items()}


def _with_arguments(agent: str, agent_class: type[Any]) -> type[Any]:
    summary = f"Train {(agent_class.__doc__ or agent).splitlines()[0]}"
    members = {"agent": agent, "__doc__": summary, "__annotations__": {}, "__post_init__": split_config}
    bases = (Arguments, trainer(agent).config, agent_class)
    return dataclass(frozen=True, kw_only=True)(type(f"{agent_class.__name__}Arguments", bases, members))


def split_config(config: Any) -> tuple[Any, Any]:
    """Return the agent's config and that of the training that flags stand for; both check their values."""
    from zest_rl.agents.configs import config_of

    parts = config_of(config.agent), trainer(config.agent).config
    agent_config, training = (part(**{f.name: getattr(config, f.name) for f in fields(part)}) for part in parts)
    return agent_config, training


def run(config: Arguments, ui: Ui) -> dict[str, Any]:
    """Train, or go on training; of several processes under ``torchrun`` the first one tells."""
    from zest_rl.runtime import artifacts
    from zest_rl.training.request import default_run_dir

    ui = ui if launched().leads else SilentUi()
    agent_config, training = split_config(config)
    how, run_dir = trainer(config.agent), config.run_dir or default_run_dir(config.agent, config.dataset, training.seed)
    ui.say(f"training in {run_dir}")
    with ui.progress(f"{config.agent} {how.counts}", getattr(config, f"n_{how.counts}")) as advance:

        def show(n: int, **row: float) -> None:
            advance(n, **dict([*row.items()][:1]))  # the loss, or the reward

        how.train(config.agent, config.dataset, agent_config, training, run_dir=run_dir, on_progress=show)
    if not launched().leads:
        return {}
    from zest_rl.evaluation.environments import is_evaluable  # brings a simulator, and nothing should wait for that

    meta, folder = artifacts.read_json(run_dir / "meta.json"), shlex.quote(str(run_dir))
    following = f"evaluate {folder}" if is_evaluable(meta) else f"export {config.dataset}"
    learned, is_reward = f"relabel {config.dataset} --reward {folder}", config.agent == "trex"
    return {
        "run": str(run_dir),
        **{key: meta[key] for key in ("agent", "n_params", "n_updates", "train_seconds")},
        **meta.get("held_out", {}),
        "next": f"zest {learned if is_reward else following}",
    }
