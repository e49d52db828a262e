"""``zest inspect``: what the rewards of a dataset are worth, before anything is trained on them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from zest_rl.cli.ui import Ui


@dataclass(frozen=True)
class Config:
    """Judge the rewards of relabeled datasets: rankings against the ground truth where there is one, and what can be
    said without it. With datasets of several tasks, also which task each goal scores highest.
    """

    datasets: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="DATASET [DATASET …]")] = ()
    """Relabeled Minari datasets."""
    output: Path = Path("inspection.html")
    """The HTML page."""
    n_workers: int | None = None
    """Processes that embed; default one per core."""


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Measure, warn, write the page."""
    import numpy as np

    from zest_rl.analysis.cross_task import confusion, confusion_warnings, inspection_report, labels, look_at
    from zest_rl.analysis.inspection import inspect
    from zest_rl.errors import BadInput, ZestError
    from zest_rl.report import write_report

    if not config.datasets:
        raise BadInput("`zest inspect` needs at least 1 dataset; `zest relabel` makes them")
    ids = tuple(dict.fromkeys(config.datasets))
    inspections = []
    with ui.progress("datasets", len(ids)) as advance:
        for dataset in ids:
            inspections.append(inspect(dataset))
            advance()
    warnings = {one.dataset_id: list(one.warnings) for one in inspections}
    looks = {}
    with ui.progress("episodes to look at", len(ids)) as advance:
        for one in inspections:
            try:
                looks[one.dataset_id] = look_at(one, n_workers=config.n_workers)
            except ZestError as error:
                ui.warn(f"no episode of {one.dataset_id} is shown: {error}")
            advance()
    compared = None
    if len({one.task for one in inspections}) > 1:
        try:
            with ui.progress("goals against tasks", len(ids)) as advance:
                compared = confusion(inspections, n_workers=config.n_workers, on_done=advance)
        except ZestError as error:
            ui.warn(f"goals were not compared across tasks: {error}")
        else:
            for dataset, warning in confusion_warnings(inspections, compared).items():
                warnings[dataset].append(warning)
    for dataset, found in warnings.items():
        for warning in found:
            ui.warn(f"{dataset}: {warning}")
    page = write_report(inspection_report(inspections, compared, warnings, looks), config.output)
    return {
        "datasets": {
            one.dataset_id: {
                "label": label,
                "figures": {
                    name: None if estimate is None else estimate.as_json()
                    for name, estimate in one.known_figures().items()
                },
            }
            for label, one in zip(labels(inspections), inspections, strict=True)
        },
        "warnings": warnings,
        "goals_against_tasks": None
        if compared is None
        else {
            "episodes_of": [source for source, _ in compared.sources],
            "by_goal_of": list(ids),
            "mean_scores": compared.means.tolist(),
            "ci95": np.stack([compared.low, compared.high], axis=-1).tolist(),
        },
        "report": str(page),
        "next": f"open {page} in a browser",
    }


def summary(result: Mapping[str, Any]) -> str:
    """The figures as text, one block per dataset."""
    lines = []
    for dataset, judged in result["datasets"].items():
        lines.append(f"{dataset}: {judged['label']}")
        for name, figure in judged["figures"].items():
            value = (
                "undefined"
                if figure is None
                else f"{figure['value']:.3f}  [{figure['ci95'][0]:.3f}, {figure['ci95'][1]:.3f}]"
            )
            lines.append(f"  {name:<26}{value}")
    n_warnings = sum(map(len, result["warnings"].values()))
    return "\n".join([*lines, f"{n_warnings} warnings", f"report: {result['report']}"])
