"""``zest evaluate``: a policy → returns and success in MuJoCo, with videos of its best, median and worst episode."""

from __future__ import annotations

import shlex
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from zest_rl.cli.ui import Ui

if TYPE_CHECKING:
    from zest_rl.evaluation.evaluate import EvaluationConfig


@dataclass(frozen=True)
class Config:
    """Evaluate a policy in the environment of its dataset: return (normalized if there are references), success."""

    run: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="RUN")]
    """Folder that `zest train` or `zest adopt` left, or hf://OWNER/NAME, which `zest push` uploaded."""
    n_episodes: int = 50
    """Episodes; equal seeds give equal starts to every policy."""
    seed: int = 1_000_000
    """First seed of the starts."""
    env: str | None = None
    """package.module:make, a function that makes the environment. Default: the dataset names it."""
    horizon: int | None = None
    """Steps of an episode. Default: those of the dataset's longest."""
    success_key: str | None = None
    """Of success in info, such as task/solved. Default: success or is_success."""
    rtg: Literal["online", "constant", "schedule"] = "online"
    """How the return-to-go falls: by the online score, not at all, or as in the best training episode."""
    target_quantile: float = 1.0
    """The return that is asked for, as a quantile of the training returns."""
    score: bool = False
    """Record ZeST scores also where the policy does not need them (only for runs on relabeled datasets)."""
    videos: bool = True
    """Write videos of the best, median and worst episode."""
    device: str = "cpu"
    """Where the policy runs; one with a process of its own decides itself."""
    n_workers: int | None = None
    """Processes; default one per core."""
    trust: bool = False
    """Run the policy, load the embedder and make the scene that a run of somebody else names; remembered for these."""


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Roll out, summarise, write videos."""
    from zest_rl.evaluation.evaluate import episode_videos, evaluate, evaluation_folder
    from zest_rl.runtime.hub import local_run
    from zest_rl.simulation.videos import ensure_videos

    started, asked, folder = time.monotonic(), settings(config), local_run(config.run)
    with ui.progress("episodes", config.n_episodes) as advance:
        options = {name: getattr(config, name) for name in ("score", "device", "n_workers", "trust")}
        result = evaluate(folder, asked, **options, on_progress=advance)
    seconds, summary = round(time.monotonic() - started, 2), result.summary()
    if clipped := summary.get("clipped_actions"):
        ui.warn(f"{clipped:.1%} of the actions left [-1, 1] and were clipped, as the environment does")
    videos = episode_videos(result) if config.videos else {}
    ensure_videos(videos.values(), n_workers=config.n_workers)
    results = evaluation_folder(folder, asked)
    return {
        "run": str(folder),
        **summary,
        "result": str(results / "result.json"),
        "videos": {name: str(results / video.path.name) for name, video in videos.items()},
        "seconds": seconds,
        "next": f"zest report {shlex.quote(str(folder))}",
    }


def settings(config: Config) -> EvaluationConfig:
    """Return what is to be run; raises `BadInput` if a value is out of range."""
    from zest_rl.evaluation.evaluate import EvaluationConfig

    return EvaluationConfig(**{name: getattr(config, name) for name in EvaluationConfig.__dataclass_fields__})
