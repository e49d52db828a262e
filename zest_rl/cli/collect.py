"""``zest collect``: an imperfect expert → a Minari dataset with successes and failures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from zest_rl.cli.ui import Ui, progress_in_parts
from zest_rl.kitchen.collect_config import CollectConfig


@dataclass(frozen=True)
class Config(CollectConfig):
    """Collect a dataset of one task from an imperfect expert; one number may be calibrated to meet --level."""

    n_workers: int | None = None
    """Processes; default one per core."""


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Measure the references, calibrate if asked to, roll out, write."""
    from zest_rl.kitchen.collect import collect_dataset

    with progress_in_parts(ui, "episodes of the references and of the dataset") as on_progress:
        collected = collect_dataset(config, n_workers=config.n_workers, on_progress=on_progress, on_result=ui.say)
    if collected.already_there:
        ui.say(f"{collected.dataset_id} is there already, nothing to do")
    return {
        **collected.result,
        "dataset": collected.dataset_id,
        "path": str(collected.path),
        "next": f"zest relabel {collected.dataset_id} --goal same-scene",
    }
