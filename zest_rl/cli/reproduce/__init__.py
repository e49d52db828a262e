"""``zest reproduce``: a recipe → collected and relabeled datasets, trained and evaluated methods, tables and reports.

What a recipe may hold is drawn in `zest_rl.cli.reproduce.plan`, and in `study` for what trains nothing; with a key
``verb = "follow …"`` or ``"select …"`` it holds the arguments of that verb. Cells run side by side, one core each; a
finished cell is never run again.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from zest_rl.cli import follow, inspect, select
from zest_rl.cli.config import load_config, read_recipe
from zest_rl.cli.reproduce import study
from zest_rl.cli.reproduce.plan import (
    Cell,
    Plan,
    TaskData,
    config_of,
    plan_cells,
    read_plan,
)
from zest_rl.cli.ui import SilentUi, Ui

if TYPE_CHECKING:
    from zest_rl.kitchen.videos import Video
    from zest_rl.report.content import MethodRow
    from zest_rl.report.methods import Method
    from zest_rl.report.sections import Report

POLL_SECONDS = 2.0

STUDIES = {
    f"{verb} {what}": (module, config)
    for verb, module in (("follow", follow), ("select", select))
    for what, config in module.CONFIGS.items()
}
"""Verbs that a recipe may be of: their module and arguments."""


@dataclass(frozen=True)
class Config:
    """Reproduce a whole comparison from a recipe; rerun the same command to go on or to find everything done."""

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RECIPE.toml")]
    """Recipe, e.g. eval/demo.toml."""
    output: Path | None = None
    """Folder of runs, result.json, table.md and report.html; default runs/RECIPE."""
    n_workers: int | None = None
    """Cells side by side; default one per core."""


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Run all stages that are not done yet."""
    started = time.monotonic()
    result = _run(config, ui)
    return {**result, "seconds": round(time.monotonic() - started, 1)}


def _run(config: Config, ui: Ui) -> dict[str, Any]:
    from zest_rl.kitchen.videos import ensure_videos, missing
    from zest_rl.report.comparison_page import overview
    from zest_rl.report.html import write_report
    from zest_rl.runtime import artifacts

    output = config.output or Path("runs") / config.file.stem
    recipe = read_recipe(config.file)
    if str(recipe.get("verb")) in STUDIES:
        return _run_verb(config, recipe, output, ui)
    if "study" in recipe:
        return study.run(config.file, output, ui, n_workers=config.n_workers)
    plan = read_plan(config.file)
    collected, datasets = {}, {}
    for task, collect_config in plan.collect.items():
        collected[task], datasets[task] = _make_datasets(plan, task, collect_config, config.n_workers, ui)
    if not plan.methods:
        relabeled = tuple(dataset for of_task in datasets.values() for dataset in of_task.by_goal.values())
        inspected = inspect.run(inspect.Config(relabeled, output / "report.html", config.n_workers), ui)
        artifacts.write_json(output / "result.json", {**inspected, "provenance": artifacts.provenance()})
        return inspected
    cells = plan_cells(plan, datasets, output)
    ui.say(f"[3/4] train and evaluate {len(cells)} cells in {output / 'cells'}")
    n_run = run_cells(cells, output, ui, n_workers=config.n_workers)
    ui.say("[4/4] report")
    details = {"recipe": {"file": config.file.name, **asdict(plan.recipe)}}
    methods = {task: _methods(plan, cells, task) for task in datasets}
    videos: list[Video] = []
    reports = {
        task: _task_report(plan, task, methods[task], datasets[task], {**details, "collected": collected[task]}, videos)
        for task in datasets
    }
    if len(reports) == 1:
        (report,) = reports.values()
    else:
        pages = {task: f"{task}.html" for task in reports}
        sources = [of_task.source for of_task in datasets.values()]
        report = overview(
            plan.recipe.title,
            methods,
            reports,
            pages,
            sources=sources,
            paper_demo=plan.recipe.paper_demo,
            caveats=plan.recipe.caveats,
            details=details,
        )
    result = _result(plan, report, reports, collected, cells, output)
    artifacts.write_json(output / "result.json", result)
    artifacts.write_bytes(output / "table.md", markdown(result).encode())
    with ui.progress("videos", len(missing(videos))) as advance:
        ensure_videos(videos, n_workers=config.n_workers, on_done=advance)
    if len(reports) > 1:
        for task, page in reports.items():
            write_report(page, output / f"{task}.html")
    html = write_report(report, output / "report.html")
    if n_run == 0:
        ui.say("all cells were done already")
    return {
        **result,
        "report": str(html),
        "result": str(output / "result.json"),
        "n_cells_run": n_run,
        "next": f"open {html} in a browser",
    }


def _run_verb(config: Config, recipe: dict[str, Any], output: Path, ui: Ui) -> dict[str, Any]:
    """Run the verb that the recipe is of; write result.json and, where the verb has a page, report.html."""
    from zest_rl.runtime import artifacts

    module, config_class = STUDIES[recipe.pop("verb")]
    given = {"output": str(output / "report.html"), "n_workers": config.n_workers}
    of_verb = {field.name for field in fields(config_class)}
    recipe |= {key: value for key, value in given.items() if key in of_verb and value is not None}
    result = module.run(load_config(config_class, recipe, f"recipe {config.file}"), ui)
    kept = {key: value for key, value in result.items() if key not in ("report", "next")}
    artifacts.write_json(output / "result.json", {**kept, "provenance": artifacts.provenance()})
    return {**result, "result": str(output / "result.json")}


def _result(
    plan: Plan,
    report: Report,
    reports: Mapping[str, Report],
    collected: Mapping[str, Any],
    cells: list[Cell],
    output: Path,
) -> dict[str, Any]:
    """What is written to result.json."""
    from zest_rl.report.sections import Ranking, Results
    from zest_rl.runtime import artifacts

    return {
        "rows": _rows(report.items(Results)),
        "tasks": {
            task: {
                "rows": _rows(page.items(Results)),
                "spearman_of_zest_and_true_returns": {
                    scatter.name: None
                    if math.isnan(scatter.spearman)
                    else {"value": scatter.spearman, "ci95": scatter.ci}
                    for scatter in page.items(Ranking)
                },
                "dataset": collected[task],
            }
            for task, page in reports.items()
        },
        "seeds": list(plan.recipe.seeds),
        "seconds_by_cell": {cell.name: _seconds(cell, output) for cell in cells},
        "provenance": artifacts.provenance(),
    }


def _make_datasets(plan: Plan, task: str, collect_config: Any, n_workers: int | None, ui: Ui) -> tuple[Any, TaskData]:
    """Collect and relabel; return the result of `zest collect` and the datasets."""
    from zest_rl.cli import collect, relabel

    ui.say(f"[1/4] collect {task}")
    collected = collect.run(replace(collect_config, n_workers=n_workers), ui)
    made = {key: value for key, value in collected.items() if key not in ("path", "next")}
    by_goal = {}
    for name, goal in plan.goals.items():
        ui.say(f"[2/4] relabel {task} by goal {name!r}")
        relabeled = relabel.run(replace(goal, dataset=collected["dataset"], n_workers=n_workers), ui)
        by_goal[name] = relabeled["dataset"]
    return made, TaskData(collected["dataset"], by_goal)


def _methods(plan: Plan, cells: list[Cell], task: str) -> list[Method]:
    from zest_rl.report.methods import Method

    return [
        Method(
            name,
            tuple(cell.run for cell in cells if (cell.task, cell.method) == (task, name)),
            method.entry.kind,
            method.entry.note,
            method.entry.paper,
            method.evaluation,
        )
        for name, method in plan.methods.items()
    ]


def _task_report(
    plan: Plan, task: str, methods: list[Method], datasets: TaskData, details: dict[str, Any], videos: list[Video]
) -> Report:
    """Compare the methods on one task; `videos` takes up those that the report shows and somebody has yet to write."""
    from zest_rl.report.comparison_page import compare

    def film(video: Video) -> Path:
        videos.append(video)
        return video.path

    return compare(
        plan.recipe.title if len(plan.collect) == 1 else f"{plan.recipe.title}: {task}",
        methods,
        source_id=datasets.source,
        goals=dict(datasets.by_goal),
        paper_demo=plan.recipe.paper_demo,
        caveats=plan.recipe.caveats,
        details=details,
        film=film,
    )


def _rows(table: tuple[MethodRow, ...]) -> dict[str, Any]:
    return {
        row.method: {
            "normalized_return": row.mean,
            "ci95": [row.ci_low, row.ci_high],
            "iqm": row.iqm,
            "success": row.success_rate,
            "n_seeds": row.n_seeds,
            "n_episodes": row.n_episodes,
            "paper": row.paper_value,
            "kind": row.kind,
        }
        for row in table
    }


def summary(result: Mapping[str, Any]) -> str:
    """The table as text."""
    of_others = {"study": study, "goals_against_tasks": inspect, "follow": follow, "select": select}
    for key, module in of_others.items():
        if key in result:
            return str(module.summary(result))
    lines = [
        f"{'':<28}{'% of expert':>12}  {'95 % interval':<18}{'success':>8}{'seeds':>7}{'episodes':>10}{'paper':>8}"
    ]
    for name, row in result["rows"].items():
        low, high = row["ci95"]
        paper = "–" if row["paper"] is None else f"{row['paper']:.2f}"
        lines.append(
            f"{name:<28}{row['normalized_return']:>12.2f}  {f'[{low:.2f}, {high:.2f}]':<18}{row['success']:>8.0%}"
            f"{row['n_seeds']:>7}{row['n_episodes']:>10}{paper:>8}"
        )
    if len(result["tasks"]) > 1:
        for task, of_task in result["tasks"].items():
            figures = (f"{name} {row['normalized_return']:.1f}" for name, row in of_task["rows"].items())
            lines.append(f"{task}: {', '.join(figures)}")
    for task, of_task in result["tasks"].items():
        for name, rho in of_task["spearman_of_zest_and_true_returns"].items():
            value = "undefined" if rho is None else f"{rho['value']:.3f}"
            lines.append(f"{task}, goal {name}: Spearman ρ of ZeST and true returns {value}")
    return "\n".join(
        [*lines, f"report: {result['report']}", f"{result['n_cells_run']} cells run, {result['seconds']} s"]
    )


def markdown(result: Mapping[str, Any]) -> str:
    """The table for a README: all tasks together, then one column per task."""
    tasks = list(result["tasks"]) if len(result["tasks"]) > 1 else []
    lines = [
        "| | % of the expert | 95 % interval | " + "".join(f"{task} | " for task in tasks) + "paper |",
        "|---|---|---|" + "---|" * (len(tasks) + 1),
    ]
    for name, row in result["rows"].items():
        low, high = row["ci95"]
        of_tasks = (f"{result['tasks'][task]['rows'][name]['normalized_return']:.1f} | " for task in tasks)
        paper = "–" if row["paper"] is None else f"{row['paper']:.2f}"
        lines.append(
            f"| {name} | {row['normalized_return']:.2f} | {low:.1f} to {high:.1f} | {''.join(of_tasks)}{paper} |"
        )
    return "\n".join(lines) + "\n"


def _work(cell: Cell) -> dict[str, Any]:
    import numpy as np

    from zest_rl.agents.foreign import FOREIGN
    from zest_rl.cli import adopt, evaluate, train
    from zest_rl.training.checkpoints import snapshots

    make_run = adopt.run if cell.agent == FOREIGN else train.run
    make_run(load_config(config_of(cell.agent), cell.train, cell.method), SilentUi())
    trained = time.monotonic()
    for run in (cell.run, *snapshots(cell.run)):
        evaluate.run(load_config(evaluate.Config, {**cell.evaluate, "run": str(run)}, cell.method), SilentUi())
    return {"evaluate_seconds": np.array(time.monotonic() - trained)}


def run_cells(cells: list[Cell], output: Path, ui: Ui, *, n_workers: int | None = None) -> int:
    """Train and evaluate all cells that are not done; return how many were not."""
    from zest_rl.runtime.parallel import cached_jobs

    done_folder = output / "done"
    open_cells = {cell.name: cell for cell in cells if not _is_done(cell, done_folder)}
    total = sum({cell.run: cell.train.get("n_updates", 0) for cell in open_cells.values()}.values())
    with (
        ui.progress("updates of all cells (evaluation follows)", total) as advance,
        _TrainingWatch({cell.run for cell in open_cells.values()}, advance),
    ):
        for name in cached_jobs(_work, open_cells, done_folder, n_workers=n_workers):
            ui.say(f"done: {name}")
    return len(open_cells)


def _is_done(cell: Cell, folder: Path) -> bool:
    """Whether a cell's results are there; a marker without them is removed, so that the cell is run again."""
    from zest_rl.evaluation.evaluate import evaluation_folder
    from zest_rl.training.checkpoints import snapshots

    marker = folder / f"{cell.name}.npz"
    policies = (cell.run, *snapshots(cell.run))
    results = [evaluation_folder(policy, cell.evaluation) / "result.json" for policy in policies]
    if not all(path.exists() for path in (cell.run / "meta.json", *results)):
        marker.unlink(missing_ok=True)
    return marker.exists()


class _TrainingWatch:
    """Follow the training logs of cells that other processes work on."""

    def __init__(self, runs: set[Path], advance: Any) -> None:
        self._runs, self._advance, self._shown = runs, advance, 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._follow, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *exception: object) -> None:
        self._stop.set()
        self._thread.join()
        self._show()

    def _follow(self) -> None:
        while not self._stop.wait(POLL_SECONDS):
            self._show()

    def _show(self) -> None:
        updates = sum(_updates_done(run / "metrics.csv") for run in self._runs)
        if updates > self._shown:
            self._advance(updates - self._shown)
            self._shown = updates


def _updates_done(log: Path) -> int:
    try:
        rows = log.read_text().splitlines()
        return int(rows[-1].split(",")[rows[0].split(",").index("update")])
    except (OSError, IndexError, ValueError):
        return 0


def _seconds(cell: Cell, output: Path) -> dict[str, float]:
    from zest_rl.runtime import artifacts
    from zest_rl.runtime.arrays import read_arrays

    meta = artifacts.read_json(cell.run / "meta.json")
    times = {"train_seconds": meta["train_seconds"]} if "train_seconds" in meta else {}
    times |= read_arrays(output / "done" / f"{cell.name}.npz") or {}
    return {name: round(float(value), 1) for name, value in times.items()}
