"""``zest relabel``: a dataset, and a goal or a learned reward → a copy with ZeST scores, or that reward."""

from __future__ import annotations

import shlex
from dataclasses import replace
from typing import TYPE_CHECKING, Any, get_args

from zest_rl.cli.arguments import words_of
from zest_rl.cli.relabel.arguments import Config
from zest_rl.cli.ui import Ui, progress_in_parts
from zest_rl.rewards.scores import Reward

if TYPE_CHECKING:
    from zest_rl.sources import Source

__all__ = ["Config", "run"]


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Render or read, embed, score, write; or apply a run of `zest train trex`."""
    import time

    import numpy as np

    from zest_rl.analysis.reward_figures import FALLEN, VIEW_CANNOT_TELL, ends_lower
    from zest_rl.data.reader import open_dataset
    from zest_rl.metrics.reward_quality import share_fallen
    from zest_rl.rewards.by_learned import RelabeledByRun, relabel_by_run
    from zest_rl.rewards.preview import preview
    from zest_rl.rewards.relabel import Relabeled, relabel
    from zest_rl.sources import KitchenStates

    def tell(source: Source) -> None:
        facts = source.frames.describe()
        if facts["kind"] == "scene":
            ui.say(f"looking at {facts['look_at']}, hidden: {', '.join(facts['robot']) or 'nothing'}")
        if not isinstance(source.frames, KitchenStates):
            ui.say(f"frames: {', '.join(source.frames.views)}")
        if facts.get("qpos_is_noisy"):
            ui.warn("states are read from observations that the environment blurred: what is shown trembles a little")

    options = {name: value for name, value in vars(config).items() if name != "preview"}
    if config.preview is not None:
        shown = preview(config.preview, **options)
        command = shlex.join(["zest", "relabel", *words_of(replace(config, preview=None))])
        return {"preview": str(config.preview), "episode": shown, "next": command}
    started, facts = time.monotonic(), dict[str, Any]()
    relabeled: Relabeled | RelabeledByRun
    if config.reward in get_args(Reward):
        with progress_in_parts(ui, "embedding frames") as on_progress:
            relabeled = relabel(**options, on_start=tell, on_progress=on_progress)
        facts = {
            "n_frames": relabeled.n_frames,
            "views": list(relabeled.source.frames.views),
            f"n_{relabeled.unit}_embedded": relabeled.n_embedded,
            "n_still_frames": relabeled.n_still,
        }
        if relabeled.view_cannot_tell:
            ui.warn(VIEW_CANNOT_TELL)
    else:
        relabeled = relabel_by_run(config.dataset, config.reward, device=config.device, n_workers=config.n_workers)
    if relabeled.already_there:
        ui.say(f"{relabeled.dataset_id} is there already, nothing to do")
    with open_dataset(relabeled.dataset_id) as ds:
        returns = np.array([rewards.sum() for rewards in ds.rewards()])
        fallen = share_fallen(ds.scores()).value
    if np.ptp(returns) == 0:
        ui.warn("all episodes have the same return: these rewards tell nothing apart")
    if facts and fallen >= FALLEN:
        ui.warn(f"{ends_lower(fallen)} `zest inspect` says more")
    return {
        "dataset": relabeled.dataset_id,
        "path": str(relabeled.path),
        **facts,
        "return_min": float(returns.min()),
        "return_max": float(returns.max()),
        "seconds": round(time.monotonic() - started, 2),
        "next": f"zest inspect {relabeled.dataset_id}",
    }
