"""Inspected datasets → one page: figures side by side, episodes, and which task each goal scores highest."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from zest_rl.analysis.cross_task import JointInspection
from zest_rl.analysis.episode_view import EpisodeView
from zest_rl.analysis.inspection import Inspection, labels
from zest_rl.analysis.reward_figures import FIGURES
from zest_rl.data.reader import dataset_path
from zest_rl.metrics.statistics import MIN_EPISODES_TO_RANK, spearman
from zest_rl.report.content import Film, QualityRow, QualityTable, Scatter, ScoreMatrix, Series, Strip
from zest_rl.report.goals import goal_panel, return_scatter
from zest_rl.report.sections import (
    DETAILS,
    FILMS,
    FRAMES,
    GOALS,
    NOT_SHOWN,
    PIXELS,
    RANKING,
    REWARD_QUALITY,
    SCORES_OVER_TIME,
    TASKS_AGAINST_GOALS,
    VERDICT,
    VIEWS,
    WARNINGS,
    Report,
)
from zest_rl.runtime.privacy import masked


def inspection_report(joint: JointInspection) -> Report:
    """Build the page; frames are rendered and scored for it."""
    names = tuple(labels(joint.inspections))
    inspections = dict(zip(names, joint.inspections, strict=True))
    scatters = {name: _scatter(name, each) for name, each in inspections.items()}
    views = {
        name: joint.views[each.dataset_id] for name, each in inspections.items() if joint.views.get(each.dataset_id)
    }
    ends = joint.confusion
    matrices = [] if ends is None else [ScoreMatrix(ends.row_names(), names, ends.means, ends.low, ends.high)]
    advice = Counter(each.verdict.advice for each in joint.inspections)
    return Report(
        "What these rewards are worth",
        f"Datasets: {len(names)}. {', '.join(f'{text.capitalize()}: {n}' for text, n in advice.items())}.",
        (
            VERDICT((name, each.verdict) for name, each in inspections.items()),
            WARNINGS(f"{dataset}: {text}" for dataset, texts in joint.warnings.items() for text in texts),
            REWARD_QUALITY([_quality(inspections)]),
            TASKS_AGAINST_GOALS(matrices),
            GOALS(
                goal_panel(name, each.relabel, dataset_path(each.dataset_id), scatters[name])
                for name, each in inspections.items()
            ),
            RANKING(scatter for scatter in scatters.values() if scatter is not None),
            FRAMES(strip for name in views for strip in _strips(name, inspections[name], views[name])),
            FILMS(film for name in views for film in _films(name, views[name])),
            NOT_SHOWN(map(masked, joint.left_out)),
            VIEWS(curve for name in views for curve in _by_view(name, views[name]["best"])),
            PIXELS(_pixels(name, views[name]["best"]) for name in views),
            SCORES_OVER_TIME(curve for name, each in inspections.items() for curve in _over_time(name, each)),
            DETAILS((name, {"dataset": i.dataset_id, **i.relabel.to_json()}) for name, i in inspections.items()),
        ),
    )


def _quality(inspections: Mapping[str, Inspection]) -> QualityTable:
    measured = [inspection.known_figures() for inspection in inspections.values()]
    rows = []
    for figure in FIGURES:
        estimates = [figures.get(figure.key) for figures in measured]
        values = tuple(None if each is None else (each.value, each.low, each.high) for each in estimates)
        is_defined = all(figures[figure.key] is not None for figures in measured if figure.key in figures)
        rows.append(QualityRow(figure.label, figure.sentence(is_defined=is_defined), values))
    return QualityTable(tuple(inspections), tuple(rows))


def _scatter(name: str, inspection: Inspection) -> Scatter | None:
    """Plot the inspected returns against the true ones."""
    if inspection.true_returns is None:
        return None
    return return_scatter(name, inspection.returns, inspection.true_returns, inspection.figures["spearman"])


def _strips(name: str, inspection: Inspection, views: Mapping[str, EpisodeView]) -> list[Strip]:
    low, high = inspection.score_range
    size = high - low or 1.0
    return [
        Strip(f"{name}: {which}", tuple(view.frames), view.steps, (view.scores[view.steps] - low) / size)
        for which, view in views.items()
    ]


def _films(name: str, views: Mapping[str, EpisodeView]) -> list[Film]:
    films = []
    with TemporaryDirectory() as folder:
        for which, view in views.items():
            path = Path(folder) / f"{which}.mp4"
            fps = view.write_video(path)
            films.append(Film(f"{name}: {which}", path.read_bytes(), fps, view.scores))
    return films


def _by_view(name: str, view: EpisodeView) -> list[Series]:
    if not len(view.by_view):
        return []
    steps = np.arange(len(view.scores), dtype=np.float32)
    curves = {"all views": view.scores, **{f"view {i}": scores for i, scores in enumerate(view.by_view, 1)}}
    return [Series(label, f"{name}: score", steps, scores) for label, scores in curves.items()]


def _pixels(name: str, view: EpisodeView) -> Scatter:
    changed, scores = view.pixel_difference[1:], view.scores[1:]
    rho = math.nan
    if len(scores) >= MIN_EPISODES_TO_RANK:  # no interval: consecutive steps are not independent
        rho = spearman(changed.astype(np.float64), scores.astype(np.float64), n_resamples=1).value
    return Scatter(name, changed, scores, rho, x_name="mean pixel difference", y_name="ZeST score", point="step")


def _over_time(name: str, inspection: Inspection) -> list[Series]:
    return [
        Series(group, f"{name}: mean reward", np.arange(1, len(mean) + 1, dtype=np.float32), mean)
        for group, mean in inspection.over_time.items()
    ]
