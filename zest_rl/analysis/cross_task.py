"""Several relabeled datasets → the inspection of each, and which task's episodes each goal scores highest."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from zest_rl.analysis.episode_view import EpisodeView, best_and_worst
from zest_rl.analysis.inspection import Inspection, inspect, labels
from zest_rl.analysis.reward_figures import FIGURES
from zest_rl.analysis.verdict import Verdict
from zest_rl.data.reader import dataset_path
from zest_rl.errors import BadInput, ZestError
from zest_rl.metrics.statistics import bootstrap
from zest_rl.rewards.scorer import SCORER_FILE, check_scorer
from zest_rl.rewards.state_scorer import StateScorer
from zest_rl.types import FloatArray


@dataclass(frozen=True)
class Confusion:
    """Scores of the last frames of each source's episodes, by the goal of each dataset."""

    sources: Mapping[tuple[str, str], str]
    """Id and sha256 of each source dataset → its task: one row per source, however often relabeled."""
    own_rows: tuple[int, ...]
    """Per dataset, the row of its episodes."""
    means: FloatArray
    """Mean score (n_sources, n_datasets) float32."""
    low: FloatArray
    """Lower ends of their 95 % bootstrap intervals over episodes, of the same shape."""
    high: FloatArray
    """Upper ends."""

    def row_names(self) -> tuple[str, ...]:
        """Name each row by its task; add the ids where tasks are equal, and the hashes where ids are equal."""
        tasks, ids, names = list(self.sources.values()), [source for source, _ in self.sources], []
        for (source, sha256), task in self.sources.items():
            place = f"{source}, {sha256[:8]}" if ids.count(source) > 1 else source
            names.append(f"{task} ({place})" if tasks.count(task) > 1 else task)
        return tuple(names)


def confusion(
    inspections: Sequence[Inspection], *, n_workers: int | None = None, on_done: Callable[[], object] = lambda: None
) -> Confusion:
    """Score the last frames of all datasets' episodes by the goal of each.

    Episodes are rendered from the views of their own task, whatever the goal's. A useful goal scores the episodes of
    its own task highest. Needs no ground truth.

    Args:
        inspections: of kitchen datasets of several tasks.
        n_workers: processes that embed, default one per core.
        on_done: called after each goal.

    Raises:
        ZestError: a scorer is missing, or was made with another embedder or renderer than those installed.
    """
    by_source = {_source(inspection): inspection for inspection in inspections}
    ends = []
    for inspection in by_source.values():
        if inspection.states is None:
            raise BadInput(f"the frames of {inspection.dataset_id} are not rendered from kitchen states")
        ends.append(np.stack([episode[[0, -1]] for episode in inspection.states], axis=1))
    estimates = np.empty((3, len(by_source), len(inspections)), dtype=np.float32)
    for column, inspection in enumerate(inspections):
        goal = StateScorer.load(dataset_path(inspection.dataset_id) / SCORER_FILE, n_workers=n_workers)
        for row, ((first, last), source) in enumerate(zip(ends, by_source.values(), strict=True)):
            scores = goal.seen_as(source.task).score_pairs(first, last).astype(np.float64)
            mean = bootstrap([scores], n_resamples=1000)
            estimates[:, row, column] = mean.value, mean.low, mean.high
        on_done()
    sources = list(by_source)
    own_rows = tuple(sources.index(_source(inspection)) for inspection in inspections)
    return Confusion({source: each.task for source, each in by_source.items()}, own_rows, *estimates)


def _source(inspection: Inspection) -> tuple[str, str]:
    return inspection.relabel.source, inspection.relabel.source_sha256


def confusion_warnings(inspections: Sequence[Inspection], compared: Confusion) -> dict[str, str]:
    """Return sentences on goals that score another task's episodes higher than their own, or all alike, by dataset."""
    tasks, warnings = list(compared.sources.values()), {}
    for column, (inspection, own_row) in enumerate(zip(inspections, compared.own_rows, strict=True)):
        means, low, high = compared.means[:, column], compared.low[:, column], compared.high[:, column]
        others = [row for row, task in enumerate(tasks) if task != inspection.task]
        best = max(others, key=means.__getitem__)
        if means[best] > means[own_row]:
            warnings[inspection.dataset_id] = (
                f"Its goal scores the episodes of {compared.row_names()[best]} higher ({means[best]:.2f}) than its own "
                f"({means[own_row]:.2f})."
            )
        elif (high[others] >= low[own_row]).all():
            warnings[inspection.dataset_id] = (
                f"Its goal scores the episodes of every task alike ({means.min():.2f} to {means.max():.2f}): it does "
                "not tell its own from the others."
            )
    return warnings


@dataclass(frozen=True, repr=False)
class JointInspection:
    """Inspections of several datasets, and their comparison where they are of several tasks.

    Its `repr` is the verdict and the warnings of each dataset.
    """

    inspections: tuple[Inspection, ...]
    views: Mapping[str, Mapping[str, EpisodeView]]
    """The best and the worst episode by dataset; empty where they cannot be rendered."""
    confusion: Confusion | None
    """None where all datasets are of one task, or the goals could not be compared."""
    warnings: Mapping[str, tuple[str, ...]]
    """Sentences that speak against training on the rewards, by dataset."""
    left_out: tuple[str, ...]
    """Sentences on what could not be rendered or compared, and why."""

    @property
    def verdicts(self) -> dict[str, Verdict]:
        """Whether to train on each dataset, and why."""
        return {inspection.dataset_id: inspection.verdict for inspection in self.inspections}

    def __repr__(self) -> str:
        lines = []
        for dataset, verdict in self.verdicts.items():
            lines += [f"{dataset}: {verdict}", *(f"  warning: {sentence}" for sentence in self.warnings[dataset])]
        return "\n".join(lines)

    def to_json(self) -> dict[str, Any]:
        """Return the output of `zest inspect --json`."""
        return {
            "verdicts": {dataset: verdict.to_json() for dataset, verdict in self.verdicts.items()},
            "datasets": {
                inspection.dataset_id: {"label": label, "figures": _figures_to_json(inspection)}
                for label, inspection in zip(labels(self.inspections), self.inspections, strict=True)
            },
            "warnings": {dataset: list(sentences) for dataset, sentences in self.warnings.items()},
            "goals_against_tasks": None
            if self.confusion is None
            else {
                "episodes_of": [source for source, _ in self.confusion.sources],
                "by_goal_of": [inspection.dataset_id for inspection in self.inspections],
                "mean_scores": self.confusion.means.tolist(),
                "ci95": np.stack([self.confusion.low, self.confusion.high], axis=-1).tolist(),
            },
        }


def _figures_to_json(inspection: Inspection) -> dict[str, Any]:
    estimates = inspection.known_figures()
    known = [(figure.key, estimates[figure.key]) for figure in FIGURES if figure.key in estimates]
    return {key: None if estimate is None else estimate.as_json() for key, estimate in known}


def inspect_datasets(
    datasets: Sequence[str],
    *,
    n_workers: int | None = None,
    trust: bool = False,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> JointInspection:
    """Inspect relabeled datasets and, where they are of several tasks, compare their goals across the tasks.

    Args:
        datasets: ids; duplicates are ignored.
        n_workers: processes that embed, default one per core.
        trust: load the embedders that the datasets name, now and from now on (`zest_rl.runtime.trust`).
        on_progress: called with (parts done, parts in all).

    Raises:
        BadInput: no dataset is given, or as in `inspect`.
    """
    ids = tuple(dict.fromkeys(datasets))
    if not ids:
        raise BadInput("`zest inspect` needs at least 1 dataset; `zest relabel` makes them")
    n_parts, numbers = 2 * len(ids), itertools.count(1)

    def advance() -> None:
        on_progress(next(numbers), n_parts)

    inspections, views, left_out = [], {}, []
    for dataset in ids:
        inspections.append(inspect(dataset))
        try:
            if trust:
                check_scorer(dataset_path(dataset) / SCORER_FILE, trust=True)
            views[dataset] = best_and_worst(inspections[-1], n_workers=n_workers)
        except ZestError as error:
            left_out.append(f"no episode of {dataset} is shown: {error}")
        advance()
    warnings = {inspection.dataset_id: inspection.warnings for inspection in inspections}
    compared = None
    if len({inspection.task for inspection in inspections}) > 1:
        try:
            compared = confusion(inspections, n_workers=n_workers, on_done=advance)
        except ZestError as error:
            left_out.append(f"goals were not compared across tasks: {error}")
        else:
            for dataset, sentence in confusion_warnings(inspections, compared).items():
                warnings[dataset] = (*warnings[dataset], sentence)
    if next(numbers) <= n_parts:
        on_progress(n_parts, n_parts)
    return JointInspection(tuple(inspections), views, compared, warnings, tuple(left_out))
