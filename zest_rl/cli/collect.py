"""``zest collect``: an expert with noise → a Minari dataset with successes and failures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from zest_rl.cli.ui import Ui
from zest_rl.errors import BadInput


@dataclass(frozen=True)
class Config:
    """Collect a noisy dataset of one task: the expert's actions get uniform noise of a level drawn per episode."""

    task: str = "micro"
    """Which of the kitchen's tasks (knob2, knob3, ldoor, rdoor, sdoor, micro)."""
    n_episodes: int = 100
    """Episodes of 100 steps."""
    noise_max: float | None = None
    """Largest noise level (1 = the whole action range); default: calibrated so that the dataset meets --level."""
    level: float = 81.19
    """Mean normalized return to calibrate to, in percent of the expert; the default is the paper's "Demo"."""
    seed: int = 0
    """Of starts, noise levels and noise."""
    dataset: str | None = None
    """Id of the new Minari dataset; default zest/kitchen-TASK-noisy-v0."""
    n_workers: int | None = None
    """Processes; default one per core."""

    def __post_init__(self) -> None:
        if self.n_episodes < 1:
            raise BadInput(f"n-episodes must be at least 1, got {self.n_episodes}")


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Measure the references, calibrate if asked to, roll out, write."""
    import shutil
    from dataclasses import asdict, replace

    import numpy as np

    from zest_rl import artifacts, collect, data, metrics
    from zest_rl.data_writer import write_dataset
    from zest_rl.tasks import get_task

    get_task(config.task)
    dataset_id = config.dataset or f"zest/kitchen-{config.task}-noisy-v0"
    asked = {key: value for key, value in asdict(config).items() if key not in ("dataset", "n_workers")}
    path = data.dataset_path(dataset_id)
    if data.exists(dataset_id):
        made_by = data.read_metadata(dataset_id).get("zest", {}).get("collect", {})
        if made_by.get("asked") != asked:
            raise BadInput(
                f"dataset {dataset_id} exists and was collected with other arguments ({made_by.get('asked')}); "
                f"choose another id with --dataset, or delete {path}"
            )
        ui.say(f"{dataset_id} is there already, nothing to do")
        return {**made_by["result"], "dataset": dataset_id, "path": str(path), "next": _next(dataset_id)}

    behaviour = collect.Behaviour(config.task, "expert", seed=config.seed, noise_max=config.noise_max or 0.0)
    n_reference = collect.N_REFERENCE
    with ui.progress("reference returns (expert, doing nothing)", n_reference + collect.N_NOTHING) as advance:
        references = collect.measure_references(behaviour, n_reference, n_workers=config.n_workers, on_progress=advance)
    ui.say(f"expert: return {references.expert:.2f}, success {references.expert_success:.0%}")
    noise_max = config.noise_max
    if noise_max is None:
        noise_max = collect.calibrate(
            behaviour,
            config.n_episodes,
            references,
            config.level,
            n_workers=config.n_workers,
            on_round=lambda noise, level: ui.say(f"noise up to {noise:.4f}: {level:.2f} % of the expert"),
        )
    behaviour = replace(behaviour, noise_max=noise_max)
    with ui.progress("episodes", config.n_episodes) as advance:
        episodes = collect.run_behaviour(behaviour, config.n_episodes, n_workers=config.n_workers, on_progress=advance)
    normalized = metrics.normalized_return(collect.returns(episodes), references.minimum, references.expert)
    successes = episodes["gt_success"].any(axis=1)
    result = {
        "n_episodes": config.n_episodes,
        "noise_max": noise_max,
        "expert_return": references.expert,
        "expert_success": references.expert_success,
        "minimum_return": references.minimum,
        "normalized_return": asdict(metrics.bootstrap([normalized])),
        "n_failed": int(np.sum(~successes)),
    }
    ui.say(f"writing {path}")
    write_dataset(
        dataset_id,
        collect.recordings(episodes),
        env_spec=collect.env_spec(config.task).to_json(),
        ref_min_score=references.minimum,
        ref_max_score=references.expert,
        algorithm_name="scripted expert with uniform action noise",
        description=f"Kitchen task {config.task}: scripted expert with uniform action noise of a level "
        f"s ~ U(0, {noise_max}) drawn per episode, {config.n_episodes} episodes of 100 steps.",
        zest={"collect": {"asked": asked, "result": result, "provenance": artifacts.provenance()}},
    )
    shutil.rmtree(collect.behaviour_folder(behaviour), ignore_errors=True)
    return {**result, "dataset": dataset_id, "path": str(path), "next": _next(dataset_id)}


def _next(dataset_id: str) -> str:
    return f"zest relabel {dataset_id} --goal same-scene"
