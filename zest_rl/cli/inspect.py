"""``zest inspect``: what the rewards of a dataset are worth, before anything is trained on them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from zest_rl.cli.ui import Ui, progress_in_parts


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
    trust: bool = False
    """Load the embedder that a dataset of somebody else names; remembered for this embedder."""


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Measure, warn, write the page."""
    from zest_rl.analysis.cross_task import inspect_datasets
    from zest_rl.report.html import write_report
    from zest_rl.report.inspection_page import inspection_report

    with progress_in_parts(ui, "inspecting") as on_progress:
        inspected = inspect_datasets(
            config.datasets, n_workers=config.n_workers, trust=config.trust, on_progress=on_progress
        )
    for sentence in inspected.left_out:
        ui.warn(sentence)
    for dataset, sentences in inspected.warnings.items():
        for sentence in sentences:
            ui.warn(f"{dataset}: {sentence}")
    page = write_report(inspection_report(inspected), config.output)
    return {**inspected.to_json(), "report": str(page), "next": f"open {page} in a browser"}


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
