"""Evaluated runs + their datasets → the report that compares them. Reads ground truth; trains and chooses nothing."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zest_rl import artifacts, data, metrics
from zest_rl.errors import BadInput
from zest_rl.evaluation import Evaluation, evaluation_folder, read_evaluation
from zest_rl.images import list_images, read_image
from zest_rl.relabel import GOAL_FOLDER, SCORER_FILE
from zest_rl.report import Curve, EpisodePanel, GoalPanel, MethodRow, Report, Scatter
from zest_rl.report.data import Kind
from zest_rl.scorer import Scorer
from zest_rl.videos import FPS, representative, write_video


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


def latest_evaluation(run: Path) -> Evaluation:
    """Read the newest evaluation of a run.

    Raises:
        BadInput: the folder is no run, or it was not evaluated.
    """
    results = sorted(run.glob("evaluations/*/result.json"), key=lambda path: path.stat().st_mtime)
    if not results:
        done = (run / "meta.json").exists()
        raise BadInput(
            f"{run} holds no evaluation; run `zest evaluate {run}` first"
            if done
            else f"{run} is not the folder of a finished training; give folders that `zest train` left"
        )
    return read_evaluation(results[-1].parent)


def method_row(method: Method, evaluations: Sequence[Evaluation]) -> MethodRow:
    """Summarise the evaluations of one method, one per seed."""
    groups = [evaluation.normalized() for evaluation in evaluations]
    estimate = metrics.bootstrap(groups)
    episodes = [episode for evaluation in evaluations for episode in evaluation.episodes]
    return MethodRow(
        method=method.name,
        mean=estimate.value,
        ci_low=estimate.low,
        ci_high=estimate.high,
        iqm=metrics.iqm(np.concatenate(groups)),
        success_rate=float(np.mean([episode.success for episode in episodes])),
        n_seeds=len(groups),
        n_episodes=len(episodes),
        kind=method.kind,
        note=method.note,
        paper_value=method.paper,
    )


def dataset_row(dataset_id: str, *, paper: float | None = None) -> MethodRow:
    """Summarise the dataset itself (the paper's "Demo")."""
    facts, truth = data.describe(dataset_id), data.read_ground_truth(dataset_id)
    values = metrics.normalized_return(
        np.array([episode.episode_return for episode in truth]), facts["ref_min_score"], facts["ref_max_score"]
    )
    estimate = metrics.bootstrap([values])
    return MethodRow(
        method="Demo",
        mean=estimate.value,
        ci_low=estimate.low,
        ci_high=estimate.high,
        iqm=metrics.iqm(values),
        success_rate=float(np.mean([episode.success for episode in truth])),
        n_seeds=1,
        n_episodes=len(truth),
        kind="dataset",
        note="the dataset's own episodes",
        paper_value=paper,
    )


def goal_scatter(name: str, dataset_id: str) -> Scatter:
    """ZeST return against ground-truth return of a relabeled dataset's episodes."""
    zest = np.array([score[1:].sum() for score in data.read_scores(dataset_id)], dtype=np.float32)
    truth = np.array([e.episode_return for e in data.read_ground_truth(dataset_id)], dtype=np.float32)
    rho = metrics.spearman(zest.astype(np.float64), truth.astype(np.float64))
    return Scatter(name, zest, truth, rho.value, (rho.low, rho.high))


def goal_panel(name: str, dataset_id: str, scatter: Scatter) -> GoalPanel:
    """The goal of a relabeled dataset, as pictures or sentences."""
    config = data.describe(dataset_id)["zest"]["relabel"]["scorer"]["config"]
    folder = data.dataset_path(dataset_id) / GOAL_FOLDER
    if folder.is_dir():
        start, goal = (tuple(read_image(path) for path in list_images(folder / part)) for part in ("init", "goal"))
        return GoalPanel(name, start, goal, scatter.spearman, len(scatter.gt_returns))
    sides = [side.strip() for side in config["goal"].removeprefix("text:").split("->")]
    return GoalPanel(name, (sides[0],), (sides[-1],), scatter.spearman, len(scatter.gt_returns))


def episode_panels(name: str, evaluation: Evaluation, scorer: Scorer | None) -> list[EpisodePanel]:
    """Best, median and worst episode of an evaluation: video, score over time, ground-truth progress."""
    panels = []
    folder = evaluation_folder(evaluation.run, evaluation.config)
    values = evaluation.normalized()
    for which, index in representative(values).items():
        states: NDArray[np.float64] = evaluation.traces["qpos"][index]
        video = folder / f"{which}.mp4"
        if not video.exists():
            write_video(states, video)
        panels.append(
            EpisodePanel(
                title=f"{name}: {which}",
                method=name,
                seed=evaluation.episodes[index].seed,
                normalized_return=float(values[index]),
                success=evaluation.episodes[index].success,
                video=video,
                fps=FPS,
                gt_progress=np.asarray(evaluation.traces["gt_reward"][index], dtype=np.float32),
                scores=None if scorer is None else scorer.score_episodes([states])[0][0],
            )
        )
    return panels


def learning_curve(method: Method) -> Curve | None:
    """Training loss over gradient steps, the mean over seeds with their range."""
    columns = []
    for run in method.runs:
        with (run / "metrics.csv").open(newline="") as file:
            columns.append([(float(row["update"]), float(row["loss"])) for row in csv.DictReader(file)])
    length = min(map(len, columns))
    if length < 2:
        return None
    losses = np.array([[loss for _, loss in column[:length]] for column in columns], dtype=np.float32)
    steps = np.array([update for update, _ in columns[0][:length]], dtype=np.float32)
    several = len(losses) > 1
    return Curve(
        method.name,
        "training loss (mean squared error of actions)",
        steps,
        losses.mean(axis=0),
        losses.min(axis=0) if several else None,
        losses.max(axis=0) if several else None,
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

    Raises:
        BadInput: a run was not evaluated, or is of another task than the others.
    """
    evaluations = {method.name: [latest_evaluation(run) for run in method.runs] for method in methods}
    metas = {str(run): artifacts.read_json(run / "meta.json") for method in methods for run in method.runs}
    tasks = {json.loads(meta["dataset"]["env_spec"])["kwargs"]["task"] for meta in metas.values()}
    if len(tasks) != 1:
        raise BadInput(f"a report compares runs of one task, got {', '.join(sorted(tasks))}; write one report per task")
    rows = [method_row(method, evaluations[method.name]) for method in methods]
    if source_id is not None:
        rows.insert(0, dataset_row(source_id, paper=paper_demo))
    scatters = {name: goal_scatter(name, dataset_id) for name, dataset_id in goals.items()}
    scorer = None
    if goals:
        scorer = Scorer.load(data.dataset_path(next(iter(goals.values()))) / SCORER_FILE)
    shown = [method for method in methods if method.kind == "method"]
    panels = [p for m in shown for p in episode_panels(m.name, evaluations[m.name][0], scorer)]
    if scorer is not None:
        scorer.states.flush()
    best = max((row for row in rows if row.kind == "method"), key=lambda row: row.mean, default=None)
    return Report(
        title=title,
        summary_sentence=(
            f"{best.method} reaches {best.mean:.1f} % of the expert's return "
            f"(95 % interval {best.ci_low:.1f} to {best.ci_high:.1f}, {best.n_seeds} "
            f"seed{'s' if best.n_seeds > 1 else ''}, {best.n_episodes} episodes)."
            if best is not None
            else ""
        ),
        table=tuple(rows),
        goals=tuple(goal_panel(name, dataset_id, scatters[name]) for name, dataset_id in goals.items()),
        episodes=tuple(panels),
        scatters=tuple(scatters.values()),
        curves=tuple(curve for method in methods if (curve := learning_curve(method)) is not None),
        details={**(details or {}), **{f"run {Path(run).name}": meta for run, meta in metas.items()}},
        caveats=tuple(caveats),
    )
