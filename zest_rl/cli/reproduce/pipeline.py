"""A recipe that compares methods → datasets, cells, result.json, table.md, and a page per task and over all."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from zest_rl.cli.reproduce import code
from zest_rl.cli.reproduce.cells import Cell, TaskDatasets, make_cells, run_cells, seconds_of
from zest_rl.cli.reproduce.comparison import Comparison
from zest_rl.cli.reproduce.stopwatch import Stopwatch
from zest_rl.cli.reproduce.tables import as_markdown
from zest_rl.cli.reproduce.tasks import GivenDataset, check_given
from zest_rl.cli.ui import Ui

if TYPE_CHECKING:
    from zest_rl.report.methods import Method
    from zest_rl.report.sections import Report
    from zest_rl.simulation.videos import Video
    from zest_rl.types import FloatArray


def run_comparison(
    comparison: Comparison,
    recipe: str,
    output: Path,
    ui: Ui,
    *,
    n_workers: int | None = None,
    rerun_outdated: bool = False,
) -> dict[str, Any]:
    """Collect, relabel, train, evaluate and report what is not done yet; `recipe` is the name of the recipe's file."""
    from zest_rl.cli import inspect
    from zest_rl.report.html import write_report
    from zest_rl.runtime import artifacts
    from zest_rl.simulation.videos import ensure_videos, missing

    given = {name: task for name, task in comparison.tasks.items() if isinstance(task, GivenDataset)}
    check_given(given, f"recipe {recipe}")
    code.code_now()  # as it is now: cells must not be called outdated because files change while they run
    stopwatch, was_finished = Stopwatch(output / "seconds.json"), (output / "report.html").exists()
    datasets = {task: _make_datasets(comparison, task, n_workers, stopwatch, ui) for task in comparison.tasks}
    if not comparison.methods:
        relabeled = tuple(
            dataset_id for task_datasets in datasets.values() for dataset_id in task_datasets.relabeled.values()
        )
        inspected = inspect.run(inspect.Config(relabeled, output / "report.html", n_workers), ui)
        artifacts.write_json(output / "result.json", {**inspected, "provenance": artifacts.provenance()})
        return inspected
    cells = make_cells(comparison, datasets, output)
    ui.say(f"[3/4] train and evaluate {len(cells)} cells in {output / 'cells'}")
    with stopwatch.stage("train and evaluate"):
        n_run = run_cells(cells, output, ui, n_workers=n_workers, rerun_outdated=rerun_outdated)
    made_by = code.describe(cells)
    for sentence in (about_code := code.caveats(made_by, len(cells))):
        ui.warn(sentence)
    ui.say("[4/4] report")
    with stopwatch.stage("report"):
        videos: list[Video] = []
        details = {"recipe": {"file": recipe, **asdict(comparison.tables)}, "code": made_by}
        task_pages, page = _pages(comparison, cells, datasets, details, about_code, videos)
        seconds = {cell.name: seconds_of(cell, output) for cell in cells}
        result = {
            "summary": page.summary,
            "rows": _rows(page),
            "tasks": {
                task: {
                    "rows": _rows(task_page),
                    "spearman_of_zest_and_true_returns": _rank_correlations(task_page),
                    "train_seconds": _train_seconds(task, cells, seconds),
                    "learning_curves": _learning_curves(task_page),
                    "dataset": datasets[task].collect_result,
                }
                for task, task_page in task_pages.items()
            },
            "seeds": list(comparison.tables.seeds),
            "seconds_by_cell": seconds,
            "code": made_by,
            "provenance": artifacts.provenance(),
        }
        artifacts.write_json(output / "result.json", result)
        artifacts.write_bytes(output / "table.md", as_markdown(result).encode())
        with ui.progress("videos", len(missing(videos))) as advance:
            ensure_videos(videos, n_workers=n_workers, on_done=advance)
        if len(task_pages) > 1:
            for task, task_page in task_pages.items():
                write_report(task_page, output / f"{task}.html")
        html = write_report(page, output / "report.html")
    if n_run == 0:
        ui.say("all cells were done already")
        if was_finished:
            stopwatch.discard()
    result["seconds_by_stage"] = stopwatch.seconds
    artifacts.write_json(output / "result.json", result)
    return {
        **result,
        "report": str(html),
        "result": str(output / "result.json"),
        "n_cells_run": n_run,
        "next": f"open {html} in a browser",
    }


def _make_datasets(
    comparison: Comparison, task: str, n_workers: int | None, stopwatch: Stopwatch, ui: Ui
) -> TaskDatasets:
    """Collect what is not given, and relabel."""
    from zest_rl.cli import collect, relabel

    config, evaluate = comparison.tasks[task], dict[str, Any]()
    if isinstance(config, GivenDataset):
        ui.say(f"[1/4] {task}: given dataset {config.dataset}")
        source, evaluate = {"dataset": config.dataset}, config.arguments(*GivenDataset.OF_EVALUATE)
    else:
        ui.say(f"[1/4] collect {task}")
        with stopwatch.stage("collect"):
            source = collect.run(replace(config, n_workers=n_workers), ui)
    relabeled = {}
    for name, how in comparison.relabel[task].items():
        ui.say(f"[2/4] relabel {task} by goal {name!r}")
        with stopwatch.stage("relabel"):
            made = relabel.run(replace(how, dataset=source["dataset"], n_workers=n_workers), ui)
        relabeled[name] = made["dataset"]
    facts = {key: value for key, value in source.items() if key not in ("path", "next")}
    return TaskDatasets(source["dataset"], relabeled, facts, evaluate)


def _pages(
    comparison: Comparison,
    cells: Sequence[Cell],
    datasets: Mapping[str, TaskDatasets],
    details: dict[str, Any],
    about_code: Sequence[str],
    videos: list[Video],
) -> tuple[dict[str, Report], Report]:
    """Build the page of each task, and the one over all; `videos` takes up what they show and nobody has written."""
    from zest_rl.report.comparison_page import compare, overview

    def film(video: Video) -> Path:
        videos.append(video)
        return video.path

    tables = comparison.tables
    shared: dict[str, Any] = {"paper_demo": tables.paper_demo, "caveats": [*tables.caveats, *about_code]}
    methods = {task: _methods(comparison, cells, task) for task in datasets}
    pages = {
        task: compare(
            tables.title if len(datasets) == 1 else f"{tables.title}: {task}",
            methods[task],
            source_id=task_datasets.source,
            goals=dict(task_datasets.relabeled),
            details={**details, "collected": task_datasets.collect_result},
            film=film,
            **shared,
        )
        for task, task_datasets in datasets.items()
    }
    if len(pages) == 1:
        return pages, next(iter(pages.values()))
    files = {task: f"{task}.html" for task in pages}
    sources = [task_datasets.source for task_datasets in datasets.values()]
    return pages, overview(tables.title, methods, pages, files, sources=sources, details=details, **shared)


def _methods(comparison: Comparison, cells: Sequence[Cell], task: str) -> list[Method]:
    from zest_rl.report.methods import Method

    methods = []
    for name, method in comparison.methods.items():
        of_method, table = [cell for cell in cells if (cell.task, cell.method) == (task, name)], method.table
        runs = tuple(cell.run for cell in of_method)
        methods.append(Method(name, runs, table.kind, table.note, table.paper, of_method[0].evaluation))
    return methods


def _rows(page: Report) -> dict[str, Any]:
    from zest_rl.report.sections import RESULTS

    return {
        row.method: {
            "normalized_return": row.mean,
            "ci95": [row.ci_low, row.ci_high],
            "iqm": row.iqm,
            "success": None if math.isnan(row.success_rate) else row.success_rate,
            "n_seeds": row.n_seeds,
            "n_episodes": row.n_episodes,
            "paper": row.paper_value,
            "kind": row.kind,
        }
        for row in page.items(RESULTS)
    }


def _rank_correlations(page: Report) -> dict[str, Any]:
    """Return Spearman's ρ of ZeST and true returns by goal; None where it is undefined."""
    from zest_rl.report.sections import RANKING

    return {
        scatter.name: None if math.isnan(scatter.spearman) else {"value": scatter.spearman, "ci95": scatter.ci}
        for scatter in page.items(RANKING)
    }


def _train_seconds(task: str, cells: Sequence[Cell], seconds: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """Return how long each seed of each method was trained on a task, where that is known."""
    found: dict[str, list[float]] = {}
    for cell in cells:
        if cell.task == task and "train_seconds" in seconds[cell.name]:
            found.setdefault(cell.method, []).append(seconds[cell.name]["train_seconds"])
    return found


def _learning_curves(page: Report) -> dict[str, Any]:
    """Return the returns while policies learned in the environment, by method: mean over seeds, and range."""
    from zest_rl.report.sections import ONLINE_CURVES

    return {
        curve.name: {
            "quantity": curve.quantity,
            "steps": [int(step) for step in curve.steps],
            "mean": _rounded(curve.values),
            **({} if curve.band is None else {"low": _rounded(curve.band[0]), "high": _rounded(curve.band[1])}),
        }
        for curve in page.items(ONLINE_CURVES)
    }


def _rounded(values: FloatArray) -> list[float]:
    return [round(float(value), 2) for value in values]
