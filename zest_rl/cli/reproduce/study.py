"""Recipes of ``zest reproduce`` that train nothing: a grid of `zest select`, tasks by settings.

A recipe has these tables (keys are the flags of the verb)::

    study = "goals"                 or "actions", "footage": what `zest select` is asked
    title = "…"
    caveats = ["…"]
    [collect], [tasks.NAME]         as in the recipes of `zest_rl.cli.reproduce.plan`
    [select]                        `zest select`, for all cells
    [grid]                          flags of `zest select` → lists of values; one row of the table per combination.
                                    pool = ["single", "all"]: candidates of the task's own dataset, or of all tasks
    [paper."NAME"]                  a row of the paper to show beside ours: task → percent

One cell is one setting on one task. What is rendered and embedded is kept, so a study that was cut short goes on there.
With "footage" the tasks are the objects of its clips: nothing is collected, and pool is a flag of its own.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args

from zest_rl.cli.reproduce.plan import located, plan_tasks, table_of
from zest_rl.cli.ui import SilentUi, Ui
from zest_rl.errors import BadInput, nearest
from zest_rl.kitchen.tasks import get_task

Pool = Literal["single", "all"]
MEASURES = {"top_n_success": "Top-N success", "relative_variation": "total variation, of its largest value"}


@dataclass(frozen=True)
class Study:
    """The keys and tables of a study; what stands in a table is checked by the config of its verb."""

    study: Literal["goals", "actions", "footage"]
    title: str
    grid: dict[str, list[Any]]
    collect: dict[str, Any] = field(default_factory=dict)
    caveats: tuple[str, ...] = ()
    tasks: dict[str, dict[str, Any]] = field(default_factory=dict)
    select: dict[str, Any] = field(default_factory=dict)
    paper: dict[str, dict[str, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.grid or not all(self.grid.values()):
            raise BadInput("grid needs at least 1 flag, and each flag at least 1 value")
        if not all(self.paper.values()):
            raise BadInput("paper: every row needs the figure of at least 1 task")
        if bool(self.collect) == (self.study == "footage"):
            raise BadInput("a study of goals or actions needs the table collect, one of footage takes none")


@dataclass(frozen=True)
class Setting:
    """One row of the table."""

    values: Mapping[str, Any]
    """Of the grid's flags."""
    pool: str
    """Candidates, and what is asked of them: what the chance of success depends on."""
    select: Any
    """Arguments of `zest select`; datasets and task are added per cell."""

    @property
    def name(self) -> str:
        """What tells it from the others, for people."""
        return ", ".join(f"{key} {value}" for key, value in self.values.items())


@dataclass(frozen=True)
class StudyPlan:
    """A study, read and checked as a whole before anything runs."""

    study: Study
    collect: Mapping[str, Any]
    """Task → config of `zest collect`; none for real video."""
    settings: tuple[Setting, ...]


def read_study(path: Path) -> StudyPlan:
    """Read a study's recipe and check all of it.

    Raises:
        BadInput: an unknown key, a missing table, a wrong type, or the paper's figures of no task here.
    """
    from zest_rl.cli.config import load_config, read_recipe
    from zest_rl.cli.select import CONFIGS
    from zest_rl.rewards.goals import goal_folder

    where = f"recipe {path}"
    study = load_config(Study, read_recipe(path), where)
    real = study.study == "footage"
    collected = {} if real else plan_tasks(study.collect, study.tasks, where)
    shared = table_of(study.select, f"{where} [select]", "datasets", "task")
    axes = table_of(study.grid, f"{where} [grid]", "datasets", "task")
    settings = []
    for values in product(*axes.values()):
        setting = dict(zip(axes, values, strict=True))
        arguments = {**shared, **setting}
        pool = arguments.get("pool", "single")
        if pool not in get_args(Pool):
            raise BadInput(f"{where} [grid]: unknown pool {pool!r}; {nearest(str(pool), get_args(Pool))}")
        if real:
            pool = ", ".join([pool, *(str(setting[key]) for key in ("ask", "folder", "goals") if key in setting)])
        else:
            arguments = {**arguments, "datasets": []}
            arguments.pop("pool", None)
        settings.append(Setting(setting, pool, load_config(CONFIGS[study.study], arguments, f"{where} [grid]")))
        for config in collected.values():
            with located(f"{where} [grid]"):
                goal_folder(settings[-1].select.goal, get_task(config.task))
    for name, row in study.paper.items():
        for task in () if real else row.keys() - collected.keys():
            raise BadInput(f"{where} [paper.{name!r}]: there is no task {task!r} here; {nearest(task, collected)}")
    return StudyPlan(study, collected, tuple(settings))


def run(path: Path, output: Path, ui: Ui, *, n_workers: int | None = None) -> dict[str, Any]:
    """Collect what is not there, select in every cell, and write result.json, table.md and report.html."""
    from zest_rl.cli import collect
    from zest_rl.report.html import write_report
    from zest_rl.runtime import artifacts

    plan = read_study(path)
    datasets = {}
    for task, config in plan.collect.items():
        ui.say(f"[1/2] collect {task}")
        datasets[task] = collect.run(replace(config, n_workers=n_workers), ui)["dataset"]
    ui.say(f"[2/2] select {plan.study.study}: {len(plan.settings)} settings × {len(datasets) or 'all'} tasks")
    rows = []
    with ui.progress("cells", len(plan.settings) * max(1, len(datasets))) as advance:
        for setting in plan.settings:
            cells = _select(plan, setting, datasets, n_workers, ui, advance)
            about = {"name": setting.name, "setting": dict(setting.values), "pool": setting.pool}
            rows.append({**about, "tasks": cells, "mean": mean_over_tasks(cells)})
    result = {
        "study": plan.study.study,
        "title": plan.study.title,
        "rows": rows,
        "paper": plan.study.paper,
        "select": {
            flag: str(value) if isinstance(value, Path) else value
            for flag, value in asdict(plan.settings[0].select).items()
            if value is not None and flag not in (*plan.settings[0].values, "datasets", "n_workers", "n_repeats")
        },
        "provenance": artifacts.provenance(),
    }  # fmt: skip
    artifacts.write_json(output / "result.json", result)
    artifacts.write_bytes(output / "table.md", markdown(result).encode())
    html = write_report(study_report(result, plan.study.caveats), output / "report.html")
    return {
        **result,
        "report": str(html),
        "result": str(output / "result.json"),
        "next": f"open {html} in a browser",
    }


def _select(
    plan: StudyPlan,
    setting: Setting,
    datasets: Mapping[str, str],
    n_workers: int | None,
    ui: Ui,
    advance: Callable[[], object],
) -> dict[str, Any]:
    """Return what `zest select` finds, per task or per object of real video."""
    from zest_rl.cli import select

    cells: dict[str, Any] = {}
    if not datasets:
        cells = select.run(setting.select, ui)["objects"]
        advance()
    for name, dataset in datasets.items():
        pool = (dataset,) if setting.pool == "single" else tuple(datasets.values())
        arguments = replace(setting.select, datasets=pool, task=plan.collect[name].task, n_workers=n_workers)
        cells[name] = select.run(arguments, SilentUi())
        advance()
    return cells


def mean_over_tasks(cells: Mapping[str, Mapping[str, Any]]) -> dict[str, float | None]:
    """Mean over tasks of every figure; the standard error of the Top-N success over tasks, as the paper has it, and of
    its mean over tasks over the repeats, where goals or contexts were drawn anew.
    """
    top = [cell["top_n_success"]["value"] for cell in cells.values()]
    mean = sum(top) / len(top)
    repeats = list(zip(*(cell.get("top_n_by_repeat", []) for cell in cells.values()), strict=False))
    ratio = sum(cell["goal_frame_ratio"] for cell in cells.values()) / len(cells)
    return {
        "top_n_success": mean,
        "top_n_standard_error": _standard_error(top),
        "top_n_standard_error_of_repeats": _standard_error([sum(repeat) / len(repeat) for repeat in repeats]),
        "relative_variation": sum(cell["relative_variation"]["value"] for cell in cells.values()) / len(cells),
        "goal_frame_ratio": ratio,
        "times_random": mean / ratio,
    }


def _standard_error(values: Sequence[float]) -> float | None:
    return statistics.stdev(values) / math.sqrt(len(values)) if len(values) > 1 else None


def _lines(result: Mapping[str, Any], measure: str) -> list[tuple[str, list[float | None], float]]:
    """Return (name, value per task, mean) of our rows, of chance, and of the paper."""
    rows, tasks = result["rows"], _tasks(result)

    def values(row: Mapping[str, Any], figure: Callable[[Any], float]) -> list[float | None]:
        return [figure(row["tasks"][task]) if task in row["tasks"] else None for task in tasks]

    lines = [(row["name"], values(row, lambda cell: cell[measure]["value"]), row["mean"][measure]) for row in rows]
    if measure != "top_n_success":
        return lines
    by_pool = {row["pool"]: row for row in rows}
    for pool, row in by_pool.items():
        chance = values(row, lambda cell: cell["goal_frame_ratio"])
        lines.append((f"at random, pool {pool}", chance, row["mean"]["goal_frame_ratio"]))
    for name, row in result["paper"].items():
        shares = [row[task] / 100 if task in row else None for task in tasks]
        known = [share for share in shares if share is not None]
        if known:
            lines.append((f"paper: {name}", shares, sum(known) / len(known)))
    return lines


def _tasks(result: Mapping[str, Any]) -> list[str]:
    """Return the columns: all tasks, or all objects that any setting has."""
    return list(dict.fromkeys(task for row in result["rows"] for task in row["tasks"]))


def markdown(result: Mapping[str, Any]) -> str:
    """One table per measure, in percent: our rows, chance, and the paper's; ± is the standard error over repeats."""
    tasks = _tasks(result)
    errors = {row["name"]: row["mean"]["top_n_standard_error_of_repeats"] for row in result["rows"]}
    parts = []
    for measure, title in MEASURES.items():
        parts += [f"{title}, %\n", f"| | {' | '.join(tasks)} | mean |", f"|---|{'---|' * (len(tasks) + 1)}"]
        for name, values, mean in _lines(result, measure):
            cells = " | ".join("–" if value is None else f"{100 * value:.1f}" for value in values)
            error = errors.get(name) if measure == "top_n_success" else None
            spread = "" if error is None else f" ± {100 * error:.1f}"
            parts.append(f"| {name} | {cells} | {100 * mean:.1f}{spread} |")
        parts.append("")
    return "\n".join(parts)


def study_report(result: Mapping[str, Any], caveats: tuple[str, ...]) -> Any:
    """Build the page: the same tables, with intervals."""
    from zest_rl.report.content import QualityRow, QualityTable
    from zest_rl.report.sections import Caveats, Details, Report, RewardQuality

    tasks = _tasks(result)
    intervals = {
        (row["name"], task, measure): tuple(cell[measure]["ci95"])
        for row, measure in product(result["rows"], MEASURES)
        for task, cell in row["tasks"].items()
    }
    unknown = (math.nan, math.nan)
    rows = [
        QualityRow(
            name,
            title,
            tuple(
                None if value is None else (value, *intervals.get((name, task, measure), unknown))
                for task, value in zip((*tasks, "mean"), (*values, mean), strict=True)
            ),
        )
        for measure, title in MEASURES.items()
        for name, values, mean in _lines(result, measure)
    ]
    best = max(result["rows"], key=lambda row: row["mean"]["top_n_success"])
    details = {"settings": result["select"], "provenance": result["provenance"]}
    return Report(
        result["title"],
        f"Best over tasks: {best['name']}. {best['mean']['top_n_success']:.0%} of the highest-scoring frames are "
        f"right, {best['mean']['times_random']:.1f} times as many as at random.",
        (
            Caveats(caveats),
            RewardQuality((QualityTable((*tasks, "mean"), tuple(rows)),)),
            Details(tuple(details.items())),
        ),
    )


def summary(result: Mapping[str, Any]) -> str:
    """The tables as text."""
    return f"{markdown(result)}\nreport: {result['report']}"
