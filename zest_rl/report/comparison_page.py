"""Evaluated runs + their datasets → the report that compares them. Reads ground truth; trains and selects nothing."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zest_rl.analysis.reward_figures import true_returns
from zest_rl.data.provenance import DatasetRecord
from zest_rl.data.reader import dataset_path, exists, open_dataset
from zest_rl.errors import BadInput
from zest_rl.evaluation.evaluate import Evaluation, evaluation_folder, read_evaluation
from zest_rl.metrics.statistics import Estimate, bootstrap, iqm, normalized_return
from zest_rl.report.content import MethodRow, Series, TaskTable
from zest_rl.report.episodes import paired_episodes, representative_episodes
from zest_rl.report.goals import goal_panel, goal_scatter
from zest_rl.report.headline import headline
from zest_rl.report.methods import Method, goal_name, latest_evaluation, methods_of_runs, read_meta
from zest_rl.report.sections import (
    CAVEATS,
    DETAILS,
    EPISODES,
    GOALS,
    LEARNING_CURVES,
    ONLINE_CURVES,
    RANKING,
    RESULTS,
    TASK_TABLES,
    Report,
)
from zest_rl.rewards.scorer import SCORER_FILE, check_scorer
from zest_rl.rewards.state_scorer import StateScorer
from zest_rl.runtime.files import check_file
from zest_rl.runtime.records import reading_record
from zest_rl.simulation.videos import Film, ensure_video
from zest_rl.training.request import snapshots


def method_row(method: Method, *tasks: Sequence[Evaluation]) -> MethodRow:
    """Summarise the evaluations of one method: per task, one per seed."""
    groups = [[evaluation.returns() for evaluation in evaluations] for evaluations in tasks]
    episodes = [episode for evaluations in tasks for evaluation in evaluations for episode in evaluation.episodes]
    return _row(
        groups,
        [episode.success for episode in episodes],
        method=method.name,
        kind=method.kind,
        note=method.note,
        paper_value=method.paper,
        is_normalized=all(evaluation.is_normalized for evaluations in tasks for evaluation in evaluations),
    )


def dataset_row(*dataset_ids: str, paper: float | None = None, is_normalized: bool = True) -> MethodRow:
    """Summarise the datasets themselves, one per task (the paper's "Demo"), normalized if asked and if they can be."""
    groups, successes = [], list[bool | None]()
    for dataset_id in dataset_ids:
        with open_dataset(dataset_id) as ds:
            record, truth = ds.record, ds.truth()
        returns, minimum, expert = true_returns(truth), record.ref_min_score, record.ref_max_score
        if minimum is None or expert is None or not is_normalized:
            is_normalized = False
        else:
            returns = normalized_return(returns, minimum, expert)
        groups.append([returns])
        successes += [episode.success for episode in truth]
    return _row(
        groups,
        successes,
        method="Demo",
        kind="dataset",
        note="the dataset's own episodes",
        paper_value=paper,
        is_normalized=is_normalized,
    )


def gain(before: Sequence[Sequence[Evaluation]], after: Sequence[Sequence[Evaluation]]) -> Estimate | None:
    """Estimate what one method returns more than another from the same starts, in percent; None if these differ.

    Args:
        before: evaluations of one method: per task, one per seed.
        after: of the other. With as many seeds, seed is paired with seed, else the means over seeds.
    """
    differences = []
    for task_before, task_after in zip(before, after, strict=True):
        played = [(each.config.starts, each.environment) for each in (*task_before, *task_after)]
        if any(each != played[0] for each in played):
            return None
        groups = [[each.returns() for each in evaluations] for evaluations in (task_before, task_after)]
        if len(groups[0]) != len(groups[1]):
            groups = [[np.mean(group, axis=0)] for group in groups]
        differences.append([b - a for a, b in zip(*groups, strict=True)])
    return bootstrap(*differences)


def _row(groups: list[list[NDArray[np.float64]]], successes: Sequence[bool | None], **named: Any) -> MethodRow:
    """Summarise returns, one (N,) array per task and seed, and successes; None is one that nothing tells."""
    estimate = bootstrap(*groups)
    values = np.concatenate([group for task in groups for group in task])
    return MethodRow(
        mean=estimate.value,
        ci_low=estimate.low,
        ci_high=estimate.high,
        iqm=float(iqm(values)),
        success_rate=float(np.mean([math.nan if success is None else success for success in successes])),
        n_seeds=len(groups[0]),
        n_episodes=len(values),
        **named,
    )


def return_curve(method: Method) -> Series | None:
    """Return returns over gradient steps, with their range over seeds; None without evaluated snapshots."""
    if not all(map(snapshots, method.runs)):
        return None
    columns: list[dict[int, float]] = []
    for run in method.runs:
        config = method.evaluation or latest_evaluation(run).config
        column = {}
        for policy in (*snapshots(run), run):
            folder = evaluation_folder(policy, config)
            if (folder / "result.json").exists():
                evaluation = read_evaluation(folder)
                column[read_meta(policy)["n_updates"]] = float(evaluation.returns().mean())
        columns.append(column)
    steps = sorted(set.intersection(*(set(column) for column in columns)))
    if len(steps) < 2:
        return None
    quantity = "normalized return, %" if method.evaluations()[0].is_normalized else "return"
    return _curve(method.name, quantity, steps, [[column[step] for step in steps] for column in columns])


def learning_curve(method: Method) -> Series | None:
    """Return the training loss over gradient steps; None for what learned in the environment, or as in `_log`."""
    log = _log(method, "loss")
    return log and _curve(method.name, "training loss (mean squared error of actions)", *log)


def online_curve(method: Method) -> Series | None:
    """Return the returns while a policy learned in its environment over its steps; None for others, or as in `_log`."""
    log = _log(method, "return")
    if log is None:
        return None
    quantity, (steps, columns), dataset = "return", log, DatasetRecord.of_run(read_meta(method.runs[0]))
    if dataset.ref_min_score is not None and dataset.ref_max_score is not None:
        quantity = "normalized return, %"
        columns = [[*normalized_return(np.array(c), dataset.ref_min_score, dataset.ref_max_score)] for c in columns]
    return _curve(method.name, quantity, steps, columns)


def _log(method: Method, column: str) -> tuple[list[float], list[list[float]]] | None:
    """Read what is counted, and one column of the log for each seed, cut to the shortest.

    None without a log, as a snapshot, or such a column, or if logged less than twice.
    """
    logs = []
    for path in (run / "metrics.csv" for run in method.runs):
        if not path.exists():
            return None
        check_file(path)
        with reading_record(path), path.open(newline="", encoding="utf-8") as file:
            names, *rows = csv.reader(file)
            if column not in names:
                return None
            logs.append([(float(row[0]), float(row[names.index(column)])) for row in rows])
    length = min(map(len, logs))
    if length < 2:
        return None
    return [step for step, _ in logs[0][:length]], [[value for _, value in log[:length]] for log in logs]


def _curve(name: str, quantity: str, steps: Sequence[float], columns: Sequence[Sequence[float]]) -> Series:
    """Return mean and range over seeds; `columns` has one column per seed, each as long as `steps`."""
    values = np.array(columns, dtype=np.float32)
    band = (values.min(axis=0), values.max(axis=0)) if len(values) > 1 else None
    return Series(name, quantity, np.array(steps, dtype=np.float32), values.mean(axis=0), band)


def compare_runs(runs: Sequence[Path], *, title: str, trust: bool = False) -> Report:
    """Build the report of evaluated runs of one task, with the goals and the source that their datasets name.

    Args:
        runs: folders; those that differ in their seed alone become one row.
        title: of the page.
        trust: load the embedder that the runs' datasets name, now and from now on (`zest_rl.runtime.trust`).

    Raises:
        BadInput: no run is given, or as in `methods_of_runs` and `compare`.
    """
    if not runs:
        raise BadInput("`zest report` needs at least 1 run folder; `zest train` and `zest evaluate` make them")
    methods = methods_of_runs(tuple(dict.fromkeys(runs)))
    goals: dict[str, str] = {}
    sources: set[str] = set()
    for run in runs:
        dataset = DatasetRecord.of_run(read_meta(run))
        sources.add(dataset.source_id)
        if dataset.relabel is not None and exists(dataset.id):
            goal = goal_name(dataset.relabel)
            if goals.setdefault(goal, dataset.id) != dataset.id:
                goals[f"{goal} ({dataset.id})"] = dataset.id
    source = sources.pop() if len(sources) == 1 else None
    if trust and goals and DatasetRecord.of_run(read_meta(runs[0])).task is not None:
        check_scorer(_scorer_file(goals), trust=True)
    known = source if source is not None and exists(source) and _has_truth(source) else None
    return compare(title, methods, source_id=known, goals=goals)


def _has_truth(dataset_id: str) -> bool:
    with open_dataset(dataset_id) as ds:
        return ds.has_truth


def _scorer_file(goals: Mapping[str, str]) -> Path:
    """Return the scorer that scores the episodes of the page: that of the first goal."""
    return dataset_path(next(iter(goals.values()))) / SCORER_FILE


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
        title: of the page.
        methods: rows, in the order of the table.
        source_id: the dataset that was relabeled, for the "Demo" row, with ground truth; None leaves the row out.
        goals: name → relabeled dataset.
        paper_demo: the paper's figure for "Demo", in percent.
        caveats: sentences below the results.
        details: name → JSON, in collapsed blocks with the runs' meta.
        film: makes the episodes' videos.

    Raises:
        BadInput: a run was not evaluated, or is of another task than the others (outside the kitchen: of another
            dataset).
    """
    metas = {str(run): read_meta(run) for method in methods for run in method.runs}
    records = [DatasetRecord.of_run(meta) for meta in metas.values()]
    tasks = {record.task or record.source_id for record in records}
    if len(tasks) != 1:
        raise BadInput(f"a report compares runs of one task, got {', '.join(sorted(tasks))}; write one report per task")
    evaluations = {method.name: method.evaluations() for method in methods}
    rows = [method_row(method, evaluations[method.name]) for method in methods]
    if source_id is not None:
        in_percent = all(row.is_normalized for row in rows)
        rows.insert(0, dataset_row(source_id, paper=paper_demo, is_normalized=in_percent))
    scatters, goal_panels = [], []
    for name, dataset_id in goals.items():
        with open_dataset(dataset_id) as ds:
            scatter = goal_scatter(name, ds) if ds.has_truth else None
            scatters += [] if scatter is None else [scatter]
            if ds.record.relabel is not None:
                goal_panels.append(goal_panel(name, ds.record.relabel, ds.path, scatter))
    scorer = None
    if goals and records[0].task is not None and (file := _scorer_file(goals)).exists():
        scorer = StateScorer.load(file)  # elsewhere the scores of the rollouts are shown
    contenders = [method for method in methods if method.kind == "method"]
    episodes = [
        episode
        for method in contenders
        for episode in representative_episodes(method.name, evaluations[method.name][0], scorer, film)
    ]
    if scorer is not None:
        scorer.flush()
    agents = {method.name: metas[str(method.runs[0])]["agent"] for method in contenders}
    cloned = next((name for name, agent in agents.items() if agent == "bc"), None)
    if cloned is not None:
        first = {name: (name, of_seeds[0]) for name, of_seeds in evaluations.items()}
        for name in (name for name, agent in agents.items() if agent != "bc"):
            episodes += paired_episodes(first[cloned], first[name], film)
    curves = (draw(method) for draw in (return_curve, learning_curve) for method in methods)
    online = map(online_curve, methods)
    return Report(
        title,
        headline(
            rows,
            {method.name: metas[str(method.runs[0])] for method in methods},
            lambda before, after: gain([evaluations[before]], [evaluations[after]]),
        ),
        (
            RESULTS(rows),
            CAVEATS([*caveats, *_unequal_starts(evaluations)]),
            GOALS(goal_panels),
            RANKING(scatters),
            EPISODES(episodes),
            ONLINE_CURVES(curve for curve in online if curve is not None),
            LEARNING_CURVES(curve for curve in curves if curve is not None),
            DETAILS([*(details or {}).items(), *((f"run {Path(run).name}", meta) for run, meta in metas.items())]),
        ),
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
        title: of the page.
        methods: task → rows; the same methods, in the same order, for every task.
        reports: task → its own report.
        pages: task → file name of that report, beside this one.
        sources: the collected datasets.
        paper_demo: the paper's figure for "Demo", in percent.
        caveats: sentences below the results.
        details: name → JSON, in collapsed blocks.
    """
    by_name = [*zip(*methods.values(), strict=True)]
    evaluations = {group[0].name: [method.evaluations() for method in group] for group in by_name}
    rows = [method_row(group[0], *evaluations[group[0].name]) for group in by_name]
    rows.insert(0, dataset_row(*sources, paper=paper_demo))
    metas = {method.name: read_meta(method.runs[0]) for method in next(iter(methods.values()))}
    scatters = [(task, scatter) for task, report in reports.items() for scatter in report.items(RANKING)]
    return Report(
        title,
        headline(rows, metas, lambda before, after: gain(evaluations[before], evaluations[after]), len(reports)),
        (
            RESULTS(rows),
            TASK_TABLES(TaskTable(task, report.items(RESULTS), pages[task]) for task, report in reports.items()),
            CAVEATS(caveats),
            RANKING(replace(scatter, name=f"{task}: {scatter.name}") for task, scatter in scatters),
            *(
                kind(
                    replace(curve, quantity=f"{task}: {curve.quantity}")
                    for task, report in reports.items()
                    for curve in report.items(kind)
                )
                for kind in (ONLINE_CURVES, LEARNING_CURVES)
            ),
            DETAILS((details or {}).items()),
        ),
    )


def _unequal_starts(evaluations: dict[str, list[Evaluation]]) -> list[str]:
    """Return a sentence if the methods were evaluated on different starts, or in different environments."""
    horizons = {
        (each.environment.name, each.traces["gt_reward"].shape[1] - 1)
        for group in evaluations.values()
        for each in group
    }
    sentences = []
    if len(horizons) > 1:
        listed = ", ".join(f"{name} for {steps} steps" for name, steps in sorted(horizons))
        sentences = [f"The methods were not evaluated in one environment of one horizon ({listed})."]
    starts = {name: {evaluation.config.starts for evaluation in group} for name, group in evaluations.items()}
    if len(set().union(*starts.values())) == 1:
        return sentences
    listed = "; ".join(
        f"{name}: {' and '.join(sorted(f'{len(seeds)} from seed {seeds.start}' for seeds in group))}"
        for name, group in starts.items()
    )
    unpaired = f"The methods were not evaluated on the same starts, so their numbers are not paired ({listed})."
    return [*sentences, unpaired]
