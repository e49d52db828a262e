"""Imperfect expert → a Minari dataset with successes and failures, at a chosen level of the expert's return."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from zest_rl.data import reader
from zest_rl.data.provenance import CollectRecord
from zest_rl.data.writer import write_dataset
from zest_rl.errors import BadInput
from zest_rl.kitchen import calibration
from zest_rl.kitchen.behaviour import Behaviour, recordings, remove_parts, returns, run_behaviour
from zest_rl.kitchen.calibration import TOLERANCE, References, calibrate, measure_references
from zest_rl.kitchen.collect_config import LARGEST, CollectConfig
from zest_rl.kitchen.env import ENV_ID, env_spec
from zest_rl.metrics import statistics
from zest_rl.runtime import artifacts
from zest_rl.runtime.arrays import Arrays
from zest_rl.runtime.records import reading_record


@dataclass(frozen=True)
class Collected:
    """Result of `collect_dataset`."""

    dataset_id: str
    path: Path
    """Its folder."""
    result: Mapping[str, Any]
    """Flaws with their values, returns of the references, normalized return; JSON-ready, as in the dataset's record."""
    already_there: bool
    """Whether the dataset existed."""


def collect_dataset(
    config: CollectConfig,
    *,
    n_workers: int | None = None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    on_result: Callable[[str], None] = lambda sentence: None,
) -> Collected:
    """Measure the references, calibrate if asked to, roll out, write; finished episodes are kept after an interruption.

    Args:
        config: of the dataset.
        n_workers: processes, default one per core.
        on_progress: called with (episodes done, episodes in all), of the references and of the dataset.
        on_result: called with a sentence about references, each try of a calibration, and where the dataset is written.

    Raises:
        BadInput: a dataset of this id was collected with other arguments.
        ZestError: the level cannot be met, a process died, or the disk is full.
    """
    path = reader.dataset_path(config.dataset_id)
    asked = {field.name: getattr(config, field.name) for field in fields(CollectConfig) if field.name != "dataset"}
    if config.expert == "scripted":
        del asked["expert"]  # it is not in the records of datasets that are older than the other kind
    asked["env"] = ENV_ID
    if not reader.exists(config.dataset_id):
        with artifacts.lock(path):  # of two equal commands the second one finds the work done
            if not reader.exists(config.dataset_id):
                result = _collect(config, asked, path, n_workers, on_progress, on_result)
                return Collected(config.dataset_id, path, result, already_there=False)
    with reading_record(path, "choose another id with --dataset, or delete it"):
        before = _collected_before(config, asked, path)
        behaviour = _behaviour(config, {name: before[name] for name in LARGEST})
    remove_parts(behaviour)  # which a kill at the very end may leave
    return Collected(config.dataset_id, path, before, already_there=True)


def _behaviour(config: CollectConfig, flaws: Mapping[str, float]) -> Behaviour:
    return Behaviour(config.task, "rl" if config.expert == "rl" else "expert", seed=config.seed, **flaws)


def _collect(
    config: CollectConfig,
    asked: Mapping[str, Any],
    path: Path,
    n_workers: int | None,
    on_progress: Callable[[int, int], None],
    on_result: Callable[[str], None],
) -> dict[str, Any]:
    """Do the work of `collect_dataset`, and return its result."""
    n_references = calibration.N_REFERENCE + calibration.N_NOTHING
    done = 0

    def count(n: int) -> None:
        nonlocal done
        done += n
        on_progress(done, n_references + config.n_episodes)

    behaviour = _behaviour(config, config.given_flaws)
    references = measure_references(behaviour, calibration.N_REFERENCE, n_workers=n_workers, on_progress=count)
    on_result(f"expert: return {references.expert:.2f}, success {references.expert_success:.0%}")
    if (name := config.calibrated) is not None:
        behaviour = calibrate(
            behaviour,
            name,
            config.n_episodes,
            references,
            config.level,
            n_workers=n_workers,
            on_round=lambda value, level: on_result(f"{name} {value:.4f}: {level:.2f} % of the expert"),
        )
    episodes = run_behaviour(behaviour, config.n_episodes, n_workers=n_workers, on_progress=count)
    flaws = {name: getattr(behaviour, name) for name in LARGEST}
    result = _result(episodes, flaws, references)
    kind = "scripted expert" if config.expert == "scripted" else "randomized expert found by soft actor-critic"
    on_result(f"writing {path}")
    write_dataset(
        config.dataset_id,
        recordings(episodes),
        env_spec=env_spec(config.task).to_json(),
        ref_min_score=references.minimum,
        ref_max_score=references.expert,
        algorithm_name=f"imperfect {kind}",
        description=f"Kitchen task {config.task}: {config.n_episodes} episodes of 100 steps by a {kind} with "
        + (", ".join(f"{name} {value}" for name, value in flaws.items() if value) or "no flaws")
        + " (drawn per episode, see zest_rl.kitchen.behaviour.Behaviour).",
        zest={"collect": {"asked": dict(asked), "result": result, "provenance": artifacts.provenance()}},
    )
    remove_parts(behaviour)
    return result


def _result(episodes: Arrays, flaws: Mapping[str, float], references: References) -> dict[str, Any]:
    normalized = statistics.normalized_return(returns(episodes), references.minimum, references.expert)
    return {
        "n_episodes": len(normalized),
        **flaws,
        "expert_return": references.expert,
        "expert_success": references.expert_success,
        "minimum_return": references.minimum,
        "normalized_return": asdict(statistics.bootstrap([normalized])),
        "n_failed": int(np.sum(~episodes["gt_success"].any(axis=1))),
    }


def _collected_before(config: CollectConfig, asked: Mapping[str, Any], path: Path) -> Mapping[str, Any]:
    """Return the result of the dataset on disk, if it was collected with equal arguments."""
    with reader.open_dataset(config.dataset_id) as ds:
        record = ds.record.collect
    if record is None or not _is_same(asked, record):
        raise BadInput(
            f"dataset {config.dataset_id} exists and was collected with other arguments, or in another version of the "
            f"environment ({None if record is None else record.asked}); "
            f"choose another id with --dataset, or delete {path}"
        )
    return record.result


def _is_same(asked: Mapping[str, Any], record: CollectRecord) -> bool:
    """Whether a dataset fits the arguments; a calibrated value counts as equal to the same value given."""
    values = {name: record.result[name] for name in LARGEST}
    calibrated = any(asked[name] == "calibrate" for name in LARGEST)
    off_by = abs(record.result["normalized_return"]["value"] - asked["level"])
    wanted = {name: values[name] if asked[name] == "calibrate" else asked[name] for name in LARGEST}
    ignored = {**dict.fromkeys(LARGEST), "level": None}
    return (
        {**asked, **ignored} == {**record.asked, **ignored}
        and wanted == values
        and (not calibrated or off_by <= TOLERANCE)
    )
