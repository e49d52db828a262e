"""Evaluated runs → the methods that a report compares, each with one run per training seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from zest_rl.agents.configs import FOREIGN
from zest_rl.analysis.inspection import names_with_settings
from zest_rl.data.provenance import DatasetRecord, RelabelRecord
from zest_rl.errors import BadInput
from zest_rl.evaluation.evaluate import Evaluation, EvaluationConfig, check_finished, evaluation_folder, read_evaluation
from zest_rl.report.content import Kind
from zest_rl.runtime import artifacts
from zest_rl.runtime.records import reading_record


@dataclass(frozen=True)
class Method:
    """One row of the comparison: one training with several seeds."""

    name: str
    runs: tuple[Path, ...]
    """Evaluated run folders, one per training seed."""
    kind: Kind = "method"
    note: str = ""
    paper: float | None = None
    """The paper's figure, in percent of the expert."""
    evaluation: EvaluationConfig | None = None
    """Config of the evaluation of each run; None takes the newest evaluation."""

    def evaluations(self) -> list[Evaluation]:
        """Read the evaluations, one per run.

        Raises:
            BadInput: a run was not evaluated.
        """
        if self.evaluation is None:
            return [latest_evaluation(run) for run in self.runs]
        return [read_evaluation(evaluation_folder(run, self.evaluation)) for run in self.runs]


def methods_of_runs(runs: Sequence[Path]) -> tuple[Method, ...]:
    """Group runs that differ in their training seed alone into one method each.

    A method is named after its agent and goal, or as `zest adopt` named it; methods of equal name also by the settings
    in which they differ.

    Raises:
        BadInput: a folder is not a finished run, or two runs are the same training with the same seed.
    """
    groups: dict[str, dict[int, Path]] = {}
    described: dict[str, tuple[str, dict[str, Any]]] = {}
    for run in runs:
        meta = read_meta(run)
        with reading_record(run / "meta.json"):
            dataset = f"{meta['dataset']['id']} ({meta['data_sha256'][:8]})"
            name, settings = _short_name(meta), {**meta["config"], "n_updates": meta["n_updates"], "dataset": dataset}
            key = artifacts.hash_json([name, settings])
            described[key] = name, settings
            earlier = groups.setdefault(key, {}).setdefault(meta["seed"], run)
        if earlier != run:
            raise BadInput(
                f"{earlier} and {run} are the same training with the same seed; give one of them"
                + (", or tell them apart by --name or --seed of `zest adopt`" if meta["agent"] == FOREIGN else "")
            )
    names = names_with_settings(list(described.values()))
    return tuple(Method(name, tuple(seeds.values())) for name, seeds in zip(names, groups.values(), strict=True))


def read_meta(run: Path) -> dict[str, Any]:
    """Read the ``meta.json`` of a finished run.

    Raises:
        BadInput: the folder is not a finished run.
    """
    check_finished(run)
    meta: dict[str, Any] = artifacts.read_json(run / "meta.json")
    with reading_record(run / "meta.json"):
        str(meta["agent"]), DatasetRecord.of_run(meta)
    return meta


def goal_name(relabel: RelabelRecord) -> str:
    """Return a short name of the goal of a relabeled dataset."""
    name = Path(relabel.scorer.goal).name
    return name if relabel.learned is None else f"T-REX by {name}"


def _short_name(meta: dict[str, Any]) -> str:
    if meta["agent"] == FOREIGN:
        return str(meta["name"])
    agent, dataset = str(meta["agent"]).upper(), DatasetRecord.of_run(meta)
    if agent == "BC":
        return agent
    if dataset.relabel is not None:
        return f"{agent} on {goal_name(dataset.relabel)}"
    own = "ground truth" if dataset.task is not None else "its own rewards"
    return f"{agent} on {own if dataset.given is None else dataset.given.label}"


def latest_evaluation(run: Path) -> Evaluation:
    """Read the newest evaluation of a run.

    Raises:
        BadInput: the folder is not a run, or it was not evaluated.
    """
    check_finished(run)
    results = sorted(run.glob("evaluations/*/result.json"), key=lambda path: path.stat().st_mtime)
    if not results:
        raise BadInput(f"{run} holds no evaluation; run `zest evaluate {run}` first")
    return read_evaluation(results[-1].parent)
