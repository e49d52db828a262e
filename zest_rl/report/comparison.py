"""Evaluated runs + their datasets → the report that compares them. Reads ground truth; trains and chooses nothing."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zest_rl.agents.foreign import FOREIGN
from zest_rl.data import reader
from zest_rl.errors import BadInput
from zest_rl.evaluation.evaluate import Evaluation, EvaluationConfig, check_finished, evaluation_folder, read_evaluation
from zest_rl.kitchen.videos import Film, ensure_video
from zest_rl.metrics import statistics
from zest_rl.report import Curve, MethodRow, Report, Section
from zest_rl.report.content import Kind
from zest_rl.report.panels import episode_panels, goal_panel, goal_scatter, paired_panels
from zest_rl.rewards.relabel import SCORER_FILE
from zest_rl.rewards.state_scorer import StateScorer
from zest_rl.runtime import artifacts
from zest_rl.training.checkpoints import snapshots


@dataclass(frozen=True)
class Method:
    """One row of the comparison: the same training with different seeds."""

    name: str
    runs: tuple[Path, ...]
    """Evaluated run folders, one per training seed."""
    kind: Kind = "method"
    note: str = ""
    paper: float | None = None
    """The paper's figure, in percent of the expert."""
    evaluation: EvaluationConfig | None = None
    """Which evaluation of each run; None takes the newest."""

    def evaluations(self) -> list[Evaluation]:
        """Read the evaluations, one per run.

        Raises:
            BadInput: a run was not evaluated.
        """
        if self.evaluation is None:
            return [latest_evaluation(run) for run in self.runs]
        return [read_evaluation(evaluation_folder(run, self.evaluation)) for run in self.runs]


def methods_of_runs(runs: Sequence[Path]) -> tuple[Method, ...]:
    """Make one method of the runs that differ in their training seed alone.

    A method is called after its agent and goal, or as `zest adopt` was told; where that does not tell two apart, also
    by the settings that do.

    Raises:
        BadInput: a folder is no finished run, or two runs are the same training with the same seed.
    """
    groups: dict[str, dict[int, Path]] = {}
    settings: dict[str, dict[str, Any]] = {}
    for run in runs:
        meta = read_meta(run)
        dataset = f"{meta['dataset']['id']} ({meta['data_sha256'][:8]})"
        own = {"name": _short_name(meta), **meta["config"], "n_updates": meta["n_updates"], "dataset": dataset}
        key = artifacts.hash_json(own)
        settings[key] = own
        earlier = groups.setdefault(key, {}).setdefault(meta["seed"], run)
        if earlier != run:
            raise BadInput(
                f"{earlier} and {run} are the same training with the same seed; give one of them"
                + (", or tell them apart by --name or --seed of `zest adopt`" if meta["agent"] == FOREIGN else "")
            )
    methods = []
    for group, seeds in groups.items():
        own = settings[group]
        others = [other for other in settings.values() if other["name"] == own["name"]]
        telling = [key for key in own if any(other.get(key) != own[key] for other in others)]
        name = ", ".join([own["name"], *(f"{key} {own[key]}" for key in telling)])
        methods.append(Method(name, tuple(seeds.values())))
    return tuple(methods)


def read_meta(run: Path) -> dict[str, Any]:
    """Read the ``meta.json`` of a finished run.

    Raises:
        BadInput: the folder is no finished run.
    """
    check_finished(run)
    meta: dict[str, Any] = artifacts.read_json(run / "meta.json")
    return meta


def goal_name(meta: dict[str, Any]) -> str | None:
    """Short name of the goal whose scores a run was trained on; None for ground-truth rewards."""
    relabel = meta["dataset"]["zest"].get("relabel")
    return None if relabel is None else Path(relabel["scorer"]["config"]["goal"]).name


def _short_name(meta: dict[str, Any]) -> str:
    if meta["agent"] == FOREIGN:
        return str(meta["name"])
    agent = str(meta["agent"]).upper()
    return agent if agent == "BC" else f"{agent} on {goal_name(meta) or 'ground truth'}"


def latest_evaluation(run: Path) -> Evaluation:
    """Read the newest evaluation of a run.

    Raises:
        BadInput: the folder is no run, or it was not evaluated.
    """
    check_finished(run)
    results = sorted(run.glob("evaluations/*/result.json"), key=lambda path: path.stat().st_mtime)
    if not results:
        raise BadInput(f"{run} holds no evaluation; run `zest evaluate {run}` first")
    return read_evaluation(results[-1].parent)


def method_row(method: Method, *tasks: Sequence[Evaluation]) -> MethodRow:
    """Summarise the evaluations of one method: for each task one per seed."""
    groups = [[evaluation.normalized() for evaluation in evaluations] for evaluations in tasks]
    episodes = [episode for evaluations in tasks for evaluation in evaluations for episode in evaluation.episodes]
    return _row(
        groups,
        float(np.mean([episode.success for episode in episodes])),
        method=method.name,
        kind=method.kind,
        note=method.note,
        paper_value=method.paper,
    )


def dataset_row(*dataset_ids: str, paper: float | None = None) -> MethodRow:
    """Summarise the datasets themselves, one per task (the paper's "Demo")."""
    groups, successes = [], []
    for dataset_id in dataset_ids:
        facts, truth = reader.describe(dataset_id), reader.read_ground_truth(dataset_id)
        returns = np.array([episode.episode_return for episode in truth])
        groups.append([statistics.normalized_return(returns, facts["ref_min_score"], facts["ref_max_score"])])
        successes += [episode.success for episode in truth]
    return _row(
        groups,
        float(np.mean(successes)),
        method="Demo",
        kind="dataset",
        note="the dataset's own episodes",
        paper_value=paper,
    )


def _row(groups: list[list[NDArray[np.float64]]], success_rate: float, **named: Any) -> MethodRow:
    """Summarise normalized returns, one (N,) array per task and seed."""
    estimate = statistics.bootstrap(*groups)
    values = np.concatenate([group for task in groups for group in task])
    return MethodRow(
        mean=estimate.value,
        ci_low=estimate.low,
        ci_high=estimate.high,
        iqm=float(statistics.iqm(values)),
        success_rate=success_rate,
        n_seeds=len(groups[0]),
        n_episodes=len(values),
        **named,
    )


def return_curve(method: Method) -> Curve | None:
    """Normalized return over gradient steps, mean and range over seeds; None without snapshots evaluated alike."""
    if not all(map(snapshots, method.runs)):
        return None
    columns: list[dict[int, float]] = []
    for run in method.runs:
        config = method.evaluation or latest_evaluation(run).config
        found = {policy: evaluation_folder(policy, config) for policy in (*snapshots(run), run)}
        returns = {
            policy: float(read_evaluation(folder).normalized().mean())
            for policy, folder in found.items()
            if (folder / "result.json").exists()
        }
        columns.append({read_meta(policy)["n_updates"]: value for policy, value in returns.items()})
    steps = sorted(set.intersection(*(set(column) for column in columns)))
    if len(steps) < 2:
        return None
    return _curve(method.name, "normalized return, %", steps, [[column[step] for step in steps] for column in columns])


def learning_curve(method: Method) -> Curve | None:
    """Training loss over gradient steps, the mean over seeds with their range; None where it was not logged twice."""
    columns = []
    if not all((run / "metrics.csv").exists() for run in method.runs):
        return None  # a snapshot has no log of its own
    for run in method.runs:
        with (run / "metrics.csv").open(newline="") as file:
            columns.append([(float(row["update"]), float(row["loss"])) for row in csv.DictReader(file)])
    length = min(map(len, columns))
    if length < 2:
        return None
    return _curve(
        method.name,
        "training loss (mean squared error of actions)",
        [update for update, _ in columns[0][:length]],
        [[loss for _, loss in column[:length]] for column in columns],
    )


def _curve(name: str, quantity: str, steps: Sequence[float], columns: Sequence[Sequence[float]]) -> Curve:
    """Mean and range over seeds: one column per seed, each as long as `steps`."""
    values = np.array(columns, dtype=np.float32)
    several = len(values) > 1
    return Curve(
        name,
        quantity,
        np.array(steps, dtype=np.float32),
        values.mean(axis=0),
        values.min(axis=0) if several else None,
        values.max(axis=0) if several else None,
    )


def compare(
    title: str,
    methods: Sequence[Method],
    *,
    source_id: str | None,
    goals: dict[str, str],
    paper_demo: float | None = None,
    caveats: Sequence[str] = (),
    details: dict[str, Any] | None = None,
    film: Film = ensure_video,
) -> Report:
    """Build the report of several methods on one task.

    Args:
        title: headline.
        methods: rows, in the order of the table.
        source_id: the collected dataset, for the "Demo" row; None leaves the row out.
        goals: name → relabeled dataset.
        paper_demo: the paper's figure for "Demo", in percent.
        caveats: sentences shown at the end.
        details: shown as collapsed JSON, beside the runs' own meta.
        film: makes the episodes' videos.

    Raises:
        BadInput: a run was not evaluated, or is of another task than the others.
    """
    metas = {str(run): read_meta(run) for method in methods for run in method.runs}
    tasks = {json.loads(meta["dataset"]["env_spec"])["kwargs"]["task"] for meta in metas.values()}
    if len(tasks) != 1:
        raise BadInput(f"a report compares runs of one task, got {', '.join(sorted(tasks))}; write one report per task")
    evaluations = {method.name: method.evaluations() for method in methods}
    rows = [method_row(method, evaluations[method.name]) for method in methods]
    if source_id is not None:
        rows.insert(0, dataset_row(source_id, paper=paper_demo))
    scatters = {name: goal_scatter(name, dataset_id) for name, dataset_id in goals.items()}
    scorer = None
    if goals:
        scorer = StateScorer.load(reader.dataset_path(next(iter(goals.values()))) / SCORER_FILE)
    shown = [method for method in methods if method.kind == "method"]
    panels = [p for m in shown for p in episode_panels(m.name, evaluations[m.name][0], scorer, film)]
    if scorer is not None:
        scorer.flush()
    cloned = next((method.name for method in shown if _agent(metas, method) == "bc"), None)
    if cloned is not None:
        first = {name: (name, of_seeds[0]) for name, of_seeds in evaluations.items()}
        others = [method.name for method in shown if _agent(metas, method) != "bc"]
        panels += [p for name in others for p in paired_panels(first[cloned], first[name], film)]
    return Report(
        title=title,
        summary_sentence=_best_sentence(rows),
        table=tuple(rows),
        goals=tuple(goal_panel(name, dataset_id, scatters[name]) for name, dataset_id in goals.items()),
        episodes=tuple(panels),
        scatters=tuple(scatters.values()),
        curves=tuple(
            curve
            for draw in (return_curve, learning_curve)
            for method in methods
            if (curve := draw(method)) is not None
        ),
        details={**(details or {}), **{f"run {Path(run).name}": meta for run, meta in metas.items()}},
        caveats=(*caveats, *_unequal_starts(evaluations)),
    )


def overview(
    title: str,
    methods: Mapping[str, Sequence[Method]],
    reports: Mapping[str, Report],
    pages: Mapping[str, str],
    *,
    sources: Sequence[str],
    paper_demo: float | None = None,
    caveats: Sequence[str] = (),
    details: dict[str, Any] | None = None,
) -> Report:
    """Build the page over several tasks: every method over all tasks together, then each task.

    Args:
        title: headline.
        methods: task → rows; the same names for every task.
        reports: task → its own report.
        pages: task → file name of that report, beside this one.
        sources: the collected datasets.
        paper_demo: the paper's figure for "Demo", in percent.
        caveats: sentences shown at the end.
        details: shown as collapsed JSON.
    """
    by_name = {name: [m for of_task in methods.values() for m in of_task if m.name == name] for name in _names(methods)}
    rows = [method_row(group[0], *(method.evaluations() for method in group)) for group in by_name.values()]
    rows.insert(0, dataset_row(*sources, paper=paper_demo))
    return Report(
        title=title,
        summary_sentence=_best_sentence(rows, f" over {len(reports)} datasets"),
        table=tuple(rows),
        sections=tuple(Section(task, report.table, pages[task]) for task, report in reports.items()),
        scatters=tuple(
            replace(scatter, name=f"{task}: {scatter.name}")
            for task, report in reports.items()
            for scatter in report.scatters
        ),
        curves=tuple(
            replace(curve, quantity=f"{task}: {curve.quantity}")
            for task, report in reports.items()
            for curve in report.curves
        ),
        details=details or {},
        caveats=tuple(caveats),
    )


def _agent(metas: Mapping[str, dict[str, Any]], method: Method) -> str:
    return str(metas[str(method.runs[0])]["agent"])


def _names(methods: Mapping[str, Sequence[Method]]) -> list[str]:
    return [method.name for method in next(iter(methods.values()))]


def _best_sentence(rows: Sequence[MethodRow], where: str = "") -> str:
    best = max((row for row in rows if row.kind == "method"), key=lambda row: row.mean, default=None)
    if best is None:
        return ""
    return (
        f"{best.method} reaches {best.mean:.1f} % of the expert's return{where} (95 % interval {best.ci_low:.1f} to "
        f"{best.ci_high:.1f}, {best.n_seeds} seed{'s' if best.n_seeds > 1 else ''}, {best.n_episodes} episodes)."
    )


def _unequal_starts(evaluations: dict[str, list[Evaluation]]) -> list[str]:
    """Say so when methods did not meet the same starts."""
    starts = {name: {evaluation.config.starts for evaluation in group} for name, group in evaluations.items()}
    if len(set().union(*starts.values())) == 1:
        return []
    listed = "; ".join(
        f"{name}: {' and '.join(sorted(f'{len(seeds)} from seed {seeds.start}' for seeds in group))}"
        for name, group in starts.items()
    )
    return [f"The methods were not evaluated on the same starts, so their numbers are not paired ({listed})."]
