"""``zest collect``: an imperfect expert → a Minari dataset with successes and failures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from zest_rl.cli.ui import Ui
from zest_rl.errors import BadInput

if TYPE_CHECKING:
    from zest_rl.data.provenance import CollectRecord
    from zest_rl.kitchen.collect import Behaviour

FLAWS = ("noise_max", "stop_share", "slow_max", "bias_max", "grip_max")


@dataclass(frozen=True)
class Config:
    """Collect a dataset of one task from an imperfect expert; one number may be calibrated to meet --level."""

    task: str = "micro"
    """Which of the kitchen's tasks (knob2, knob3, ldoor, rdoor, sdoor, micro)."""
    n_episodes: int = 100
    """Episodes of 100 steps."""
    noise_max: float | Literal["calibrate"] = "calibrate"
    """Largest level of the action noise, drawn per episode (1 = the whole action range)."""
    stop_share: float | Literal["calibrate"] = 0.0
    """Share of the episodes in which the expert stops early."""
    slow_max: float | Literal["calibrate"] = 0.0
    """Largest share of its speed that the expert lacks, drawn per episode."""
    bias_max: float | Literal["calibrate"] = 0.0
    """Largest constant error of the actions, drawn per episode."""
    grip_max: float | Literal["calibrate"] = 0.0
    """Largest error of the grip in m, drawn per episode."""
    level: float = 81.19
    """Mean normalized return to calibrate to, in percent of the expert; the default is the paper's "Demo"."""
    seed: int = 0
    """Of starts, noise levels and noise."""
    dataset: str = "zest/kitchen-{task}-noisy-v0"
    """Id of the new Minari dataset; {task} stands for the task."""
    n_workers: int | None = None
    """Processes; default one per core."""

    def __post_init__(self) -> None:
        if self.n_episodes < 1:
            raise BadInput(f"n-episodes must be at least 1, got {self.n_episodes}")
        if not 0 < self.level <= 100:
            raise BadInput(f"level must be in (0, 100] percent of the expert, got {self.level}")
        if len(self.calibrated) > 1:
            raise BadInput(
                f"one number can be calibrated, got {' and '.join(self.calibrated)}; give the others a value"
            )

    @property
    def dataset_id(self) -> str:
        """Id of the dataset of this task."""
        return self.dataset.replace("{task}", self.task)

    def behaviour(self) -> Behaviour:
        """Return what acts; a number that is to be calibrated is still 0.

        Raises:
            BadInput: a number is out of range.
        """
        from zest_rl.kitchen.collect import Behaviour

        given = {name: value for name, value in self.flaws.items() if value != "calibrate"}
        return Behaviour(self.task, "expert", seed=self.seed, **given)

    @property
    def flaws(self) -> dict[str, float | Literal["calibrate"]]:
        """What makes the expert imperfect."""
        return {name: getattr(self, name) for name in FLAWS}

    @property
    def calibrated(self) -> list[str]:
        """Names of the numbers that are to be calibrated."""
        return [name for name, value in self.flaws.items() if value == "calibrate"]


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Measure the references, calibrate if asked to, roll out, write."""
    import shutil
    from dataclasses import asdict

    import numpy as np

    from zest_rl.data import reader
    from zest_rl.data.writer import write_dataset
    from zest_rl.kitchen import collect
    from zest_rl.kitchen.env import ENV_ID
    from zest_rl.metrics import statistics
    from zest_rl.runtime import artifacts

    behaviour = config.behaviour()
    dataset_id = config.dataset_id
    asked = {key: value for key, value in asdict(config).items() if key not in ("dataset", "n_workers")}
    asked["env"] = ENV_ID
    path = reader.dataset_path(dataset_id)
    if reader.exists(dataset_id):
        with reader.open_dataset(dataset_id) as ds:
            record = ds.record.collect
        if record is None or not _is_same(asked, record):
            raise BadInput(
                f"dataset {dataset_id} exists and was collected with other arguments, or in another version of the "
                f"environment ({None if record is None else record.asked}); "
                f"choose another id with --dataset, or delete {path}"
            )
        ui.say(f"{dataset_id} is there already, nothing to do")
        return {**record.result, "dataset": dataset_id, "path": str(path), "next": _next(dataset_id)}

    n_reference = collect.N_REFERENCE
    with ui.progress("reference returns (expert, doing nothing)", n_reference + collect.N_NOTHING) as advance:
        references = collect.measure_references(behaviour, n_reference, n_workers=config.n_workers, on_progress=advance)
    ui.say(f"expert: return {references.expert:.2f}, success {references.expert_success:.0%}")
    if config.calibrated:
        (knob,) = config.calibrated
        behaviour = collect.calibrate(
            behaviour,
            knob,
            config.n_episodes,
            references,
            config.level,
            n_workers=config.n_workers,
            on_round=lambda value, level: ui.say(f"{knob} {value:.4f}: {level:.2f} % of the expert"),
        )
    with ui.progress("episodes", config.n_episodes) as advance:
        episodes = collect.run_behaviour(behaviour, config.n_episodes, n_workers=config.n_workers, on_progress=advance)
    normalized = statistics.normalized_return(collect.returns(episodes), references.minimum, references.expert)
    successes = episodes["gt_success"].any(axis=1)
    result = {
        "n_episodes": config.n_episodes,
        **{name: getattr(behaviour, name) for name in FLAWS},
        "expert_return": references.expert,
        "expert_success": references.expert_success,
        "minimum_return": references.minimum,
        "normalized_return": asdict(statistics.bootstrap([normalized])),
        "n_failed": int(np.sum(~successes)),
    }
    ui.say(f"writing {path}")
    write_dataset(
        dataset_id,
        collect.recordings(episodes),
        env_spec=collect.env_spec(config.task).to_json(),
        ref_min_score=references.minimum,
        ref_max_score=references.expert,
        algorithm_name="imperfect scripted expert",
        description=f"Kitchen task {config.task}: {config.n_episodes} episodes of 100 steps by a scripted expert with "
        + (", ".join(f"{name} {value}" for name in FLAWS if (value := getattr(behaviour, name))) or "no flaws")
        + " (drawn per episode, see zest_rl.kitchen.collect.Behaviour).",
        zest={"collect": {"asked": asked, "result": result, "provenance": artifacts.provenance()}},
    )
    shutil.rmtree(collect.behaviour_folder(behaviour), ignore_errors=True)
    return {**result, "dataset": dataset_id, "path": str(path), "next": _next(dataset_id)}


def _is_same(asked: Mapping[str, Any], record: CollectRecord) -> bool:
    """Whether a dataset is what is asked for; a number that calibration found is as good as the same number given."""
    from zest_rl.kitchen.collect import TOLERANCE

    found = {name: record.result[name] for name in FLAWS}
    calibrated = any(asked[name] == "calibrate" for name in FLAWS)
    off_by = abs(record.result["normalized_return"]["value"] - asked["level"])
    wanted = {name: found[name] if asked[name] == "calibrate" else asked[name] for name in FLAWS}
    ignored = {**dict.fromkeys(FLAWS), "level": None}
    return (
        {**asked, **ignored} == {**record.asked, **ignored}
        and wanted == found
        and (not calibrated or off_by <= TOLERANCE)
    )


def _next(dataset_id: str) -> str:
    return f"zest relabel {dataset_id} --goal same-scene"
