"""Inspected datasets → one page: all figures side by side, and which task each goal scores highest."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zest_rl.analysis.episode_view import Look
from zest_rl.analysis.inspection import FIGURES, Inspection
from zest_rl.data import reader
from zest_rl.metrics.statistics import Estimate, bootstrap, spearman
from zest_rl.report import (
    Curve,
    Matrix,
    QualityRow,
    QualityTable,
    Report,
    Scatter,
    Strip,
)
from zest_rl.report.panels import MIN_EPISODES_TO_RANK, goal_panel
from zest_rl.rewards.relabel import SCORER_FILE
from zest_rl.rewards.state_scorer import StateScorer
from zest_rl.types import FloatArray


def labels(inspections: Sequence[Inspection]) -> list[str]:
    """Name each by task and goal, and by the settings that tell it from others of the same task and goal."""
    own = [(f"{one.task} by {_goal(one)}", _settings(one)) for one in inspections]
    names = []
    for base, settings in own:
        rivals = [other for name, other in own if name == base]
        telling = [key for key in settings if any(other[key] != settings[key] for other in rivals)]
        names.append(", ".join([base, *(f"{key} {settings[key]}" for key in telling)]))
    return [
        f"{name} ({one.dataset_id})" if names.count(name) > 1 else name
        for name, one in zip(names, inspections, strict=True)
    ]


def _goal(inspection: Inspection) -> str:
    goal = str(inspection.made["scorer"]["config"]["goal"])
    return Path(goal).name if Path(goal).is_absolute() else goal


def _settings(inspection: Inspection) -> dict[str, Any]:
    """What can tell two rewards of one task and goal apart, by the words of a label."""
    made, config = inspection.made, inspection.made["scorer"]["config"]
    return {
        "embedder": config["embedder"],
        "features": config["features"],
        "similarity": config["similarity"],
        "views": config["views"]["n_views"] if "views" in config else len(made["frames"]["views"]),
        "share of goals": config["goal_share"],
        "reward": made["reward"],
        "shuffled": "no" if made["shuffle"] is None else made["shuffle"],
    }


@dataclass(frozen=True)
class Confusion:
    """Where the episodes of each source end, by the goal of each dataset."""

    sources: Mapping[tuple[str, str], str]
    """Id and sha256 of what was relabeled → its task; one row each, however often one was relabeled."""
    own: tuple[int, ...]
    """The row of each dataset's own episodes."""
    means: FloatArray
    """Mean score (n_sources, n_datasets) float32."""
    low: FloatArray
    """Lower ends of their 95 % bootstrap intervals over episodes, of the same shape."""
    high: FloatArray
    """Upper ends."""

    def row_names(self) -> tuple[str, ...]:
        """Name each row by its task; sources of the same task by their ids, too, and if need be by their hashes."""
        tasks, ids, names = list(self.sources.values()), [source for source, _ in self.sources], []
        for (source, sha256), task in self.sources.items():
            place = f"{source}, {sha256[:8]}" if ids.count(source) > 1 else source
            names.append(f"{task} ({place})" if tasks.count(task) > 1 else task)
        return tuple(names)


def confusion(
    inspections: Sequence[Inspection], *, n_workers: int | None = None, on_done: Callable[[], object] = lambda: None
) -> Confusion:
    """Score where the episodes of all end by the goal of each.

    Episodes are seen from the views of their own task, whatever the goal is of. A goal that is worth something scores
    those of its own task highest. Needs no ground truth.

    Args:
        inspections: of datasets of several tasks.
        n_workers: processes that embed, default one per core.
        on_done: called after each goal.

    Raises:
        ZestError: a scorer is gone, or was made with another embedder or renderer than the ones here.
    """
    seen = {_source(one): one for one in inspections}
    ends = [np.stack([e[[0, -1]] for e in reader.read_states(one.dataset_id)], axis=1) for one in seen.values()]
    found = np.empty((3, len(seen), len(inspections)), dtype=np.float32)
    for column, goal_of in enumerate(inspections):
        goal = StateScorer.load(reader.dataset_path(goal_of.dataset_id) / SCORER_FILE, n_workers=n_workers)
        for row, ((first, last), shown) in enumerate(zip(ends, seen.values(), strict=True)):
            scores = goal.seen_as(shown.task).score_pairs(first, last).astype(np.float64)
            mean = bootstrap([scores], n_resamples=1000)
            found[:, row, column] = mean.value, mean.low, mean.high
        on_done()
    rows = list(seen)
    own = tuple(rows.index(_source(one)) for one in inspections)
    return Confusion({source: one.task for source, one in seen.items()}, own, *found)


def _source(inspection: Inspection) -> tuple[str, str]:
    return str(inspection.made["source"]), str(inspection.made["source_sha256"])


def confusion_warnings(inspections: Sequence[Inspection], found: Confusion) -> dict[str, str]:
    """Find the goals that score another task's episodes higher than their own, or all alike: dataset → sentence."""
    tasks, warnings = list(found.sources.values()), {}
    for column, (goal_of, own) in enumerate(zip(inspections, found.own, strict=True)):
        means, low, high = found.means[:, column], found.low[:, column], found.high[:, column]
        others = [row for row, task in enumerate(tasks) if task != goal_of.task]
        best = max(others, key=means.__getitem__)
        if means[best] > means[own]:
            warnings[goal_of.dataset_id] = (
                f"Its goal scores the episodes of {found.row_names()[best]} higher ({means[best]:.2f}) than its own "
                f"({means[own]:.2f})."
            )
        elif (high[others] >= low[own]).all():
            warnings[goal_of.dataset_id] = (
                f"Its goal scores the episodes of every task alike ({means.min():.2f} to {means.max():.2f}): it does "
                "not tell its own from the others."
            )
    return warnings


def look_at(inspection: Inspection, *, n_workers: int | None = None) -> dict[str, Look]:
    """Look at the episodes with the highest and the lowest return: "best" and "worst".

    None where scores were shuffled, or where the frames were not rendered by us.

    Args:
        inspection: of a dataset.
        n_workers: processes that embed, default one per core.

    Raises:
        ZestError: the scorer is gone, or was made with another embedder or renderer than the ones here.
    """
    if inspection.made["shuffle"] is not None or "frames" in inspection.made:
        return {}
    scorer = StateScorer.load(reader.dataset_path(inspection.dataset_id) / SCORER_FILE, n_workers=n_workers)
    states = reader.read_states(inspection.dataset_id)
    return {
        "best": Look(scorer, states[int(np.argmax(inspection.returns))]),
        "worst": Look(scorer, states[int(np.argmin(inspection.returns))]),
    }


def _scatter(name: str, inspection: Inspection) -> Scatter | None:
    """The returns that were inspected, against the true ones."""
    if inspection.true_returns is None:
        return None
    rho = inspection.figures["Spearman ρ"]
    returns, truth = (np.asarray(one, dtype=np.float32) for one in (inspection.returns, inspection.true_returns))
    return Scatter(name, returns, truth, rho.value, (rho.low, rho.high))


def _strips(name: str, dataset_id: str, looks: Mapping[str, Look]) -> list[Strip]:
    scores = np.concatenate(reader.read_scores(dataset_id))
    low, size = float(scores.min()), float(np.ptp(scores)) or 1.0
    return [
        Strip(
            f"{name}: {which}", tuple(look.frames), tuple(map(int, look.steps)), (look.scores[look.steps] - low) / size
        )
        for which, look in looks.items()
    ]


def _views(name: str, look: Look) -> list[Curve]:
    steps = np.arange(len(look.scores), dtype=np.float32)
    by_view = [(f"view {view}", scores) for view, scores in enumerate(look.by_view, 1)]
    return [Curve(view, f"{name}: score", steps, scores) for view, scores in [("all views", look.scores), *by_view]]


def _pixels(name: str, look: Look) -> Scatter:
    changed, scores = look.pixel_difference[1:], look.scores[1:]
    rho = float("nan")
    if len(scores) >= MIN_EPISODES_TO_RANK:  # the interval of steps that follow each other would be far too narrow
        rho = spearman(changed.astype(np.float64), scores.astype(np.float64), n_resamples=1).value
    return Scatter(name, scores, changed, rho, upward="ZeST score", across="mean pixel difference", point="step")


def inspection_report(
    inspections: Sequence[Inspection],
    compared: Confusion | None,
    warnings: Mapping[str, Sequence[str]],
    looks: Mapping[str, Mapping[str, Look]],
) -> Report:
    """Build the page.

    Args:
        inspections: one per dataset.
        compared: of `confusion`.
        warnings: by dataset.
        looks: of `look_at`, by dataset; those that are missing are not shown.
    """
    names = tuple(labels(inspections))
    judged = [one.known_figures() for one in inspections]
    rows = [
        QualityRow(figure.name, figure.meaning, tuple(_interval(known.get(figure.name)) for known in judged))
        for figure in FIGURES
    ]
    scatters = [_scatter(name, one) for name, one in zip(names, inspections, strict=True)]
    curves = [
        Curve(group, f"{name}: mean reward", np.arange(1, len(mean) + 1, dtype=np.float32), mean)
        for name, one in zip(names, inspections, strict=True)
        for group, mean in one.over_time.items()
    ]
    seen = {one.dataset_id: name for name, one in zip(names, inspections, strict=True) if looks.get(one.dataset_id)}
    n_warnings = sum(map(len, warnings.values()))
    return Report(
        title="What these rewards are worth",
        summary_sentence=f"Datasets: {len(names)}, warnings: {n_warnings}. Nothing was trained.",
        warnings=tuple(f"{dataset}: {sentence}" for dataset, found in warnings.items() for sentence in found),
        quality=QualityTable(names, tuple(rows)),
        matrix=None
        if compared is None
        else Matrix(compared.row_names(), names, compared.means, compared.low, compared.high),
        goals=tuple(
            goal_panel(name, one.dataset_id, scatter)
            for name, one, scatter in zip(names, inspections, scatters, strict=True)
        ),
        scatters=tuple(scatter for scatter in scatters if scatter is not None),
        strips=tuple(s for dataset, name in seen.items() for s in _strips(name, dataset, looks[dataset])),
        views=tuple(c for dataset, name in seen.items() for c in _views(name, looks[dataset]["best"])),
        pixels=tuple(_pixels(name, looks[dataset]["best"]) for dataset, name in seen.items()),
        details={name: {"dataset": one.dataset_id, **one.made} for name, one in zip(names, inspections, strict=True)},
        scores_over_time=tuple(curves),
    )


def _interval(estimate: Estimate | None) -> tuple[float, float, float] | None:
    return None if estimate is None else (estimate.value, estimate.low, estimate.high)
