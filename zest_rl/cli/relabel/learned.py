"""``zest relabel DATASET --reward RUN``: the rewards that `zest train trex` learned."""

from __future__ import annotations

from typing import Any

from zest_rl.cli.relabel.arguments import Config
from zest_rl.cli.ui import Ui


def by_run(config: Config, ui: Ui) -> dict[str, Any]:
    """Write the rewards of a run of `zest train trex`."""
    from zest_rl.data.reader import open_dataset
    from zest_rl.rewards.by_learned import relabel_by_run

    relabeled = relabel_by_run(config.dataset, config.reward, device=config.device, n_workers=config.n_workers)
    if relabeled.already_there:
        ui.say(f"{relabeled.dataset_id} is there already, nothing to do")
    with open_dataset(relabeled.dataset_id) as ds:
        returns = [float(rewards.sum()) for rewards in ds.rewards()]
    return {
        "dataset": relabeled.dataset_id,
        "path": str(relabeled.path),
        "return_min": min(returns),
        "return_max": max(returns),
        "next": f"zest inspect {relabeled.dataset_id}",
    }
