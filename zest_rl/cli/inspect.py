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
    """Judge the rewards of relabeled datasets: a verdict first, then rankings against the ground truth where there is
    one, and what can be said without it. With datasets of several tasks, also which task each goal scores highest.
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
    """Measure, judge, write the page; or find it written."""
    from zest_rl.report.finished import PageRecord, dataset_contents

    record = PageRecord(config.output, "inspect", [*map(dataset_contents, config.datasets)])
    if not config.trust and (made := record.result()) is not None:
        ui.say(f"{config.output} is there already, nothing to do")
        return made
    from zest_rl.analysis.cross_task import inspect_datasets
    from zest_rl.report.html import write_report
    from zest_rl.report.inspection_page import inspection_report

    with progress_in_parts(ui, "inspecting") as on_progress:
        how: dict[str, Any] = {"n_workers": config.n_workers, "trust": config.trust}
        inspected = inspect_datasets(config.datasets, **how, on_progress=on_progress)
    for sentence in inspected.left_out:
        ui.warn(sentence)
    page = write_report(inspection_report(inspected), config.output)
    command = f"open {page} in a browser"
    usable = (each for each in inspected.inspections if each.verdict.advice != "do not")
    if first := next(usable, None):
        name = first.dataset_id
        command = f"zest train dt {name}" if first.suits_agents else f"zest export {name} --to npz"
    result = {**inspected.to_json(), "report": str(page), "next": command}
    may_change = inspected.left_out or any(each.relabel.is_foreign for each in inspected.inspections)
    return result if may_change else record.keep(result)  # as films that lie elsewhere, or what was left out


def summary(result: Mapping[str, Any]) -> str:
    """The verdicts, then warnings and figures as text, one block per dataset."""
    from zest_rl.analysis.reward_figures import FIGURES
    from zest_rl.analysis.verdict import Verdict

    verdicts = {dataset: Verdict.from_json(verdict) for dataset, verdict in result["verdicts"].items()}
    lines = [f"{dataset}: {verdict}" for dataset, verdict in verdicts.items()]
    for dataset, judged in result["datasets"].items():
        lines += ["", f"{dataset}: {judged['label']}"]
        lines += [f"  warning: {sentence}" for sentence in result["warnings"][dataset]]
        figures = judged["figures"]
        for figure in (figure for figure in FIGURES if figure.key in figures):
            value = figures[figure.key]
            lines.append(f"{_cell(value)}  {figure.label}. {figure.sentence(is_defined=value is not None)}")
    return "\n".join([*lines, "", f"report: {result['report']}"])


def _cell(figure: Mapping[str, Any] | None) -> str:
    if figure is None:
        return f"  {'undefined':<23}"
    low, high = figure["ci95"]
    return f"  {figure['value']:6.3f} {f'[{low:.3f}, {high:.3f}]':<16}"
