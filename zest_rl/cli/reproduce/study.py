"""Recipes of ``zest reproduce`` that train nothing: a grid of `zest select`, tasks by settings.

A recipe has these tables (keys are the flags of the verb)::

    study = "goals"                 or "actions", "footage": what `zest select` is asked
    title = "…"
    caveats = ["…"]
    [collect], [tasks.NAME]         as in the recipes of `zest_rl.cli.reproduce.comparison`
    [select]                        `zest select`, for all cells
    [grid]                          flags of `zest select` → lists of values; one row of the table per combination.
                                    pool = ["single", "all"]: candidates of the task's own dataset, or of all tasks
    [paper."NAME"]                  a row of the paper to show beside ours: task → percent

One cell is one setting on one task. What is rendered and embedded is kept, so a study that was cut short goes on there.
With "footage" the tasks are the objects of its clips: nothing is collected, and pool is a flag of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args

from zest_rl.cli import select
from zest_rl.cli.config import load_config, read_recipe
from zest_rl.cli.reproduce.study_tables import as_markdown, mean_over_tasks, study_page
from zest_rl.cli.reproduce.tasks import checked_table, located, read_tasks
from zest_rl.cli.ui import SilentUi, Ui
from zest_rl.errors import BadInput, nearest
from zest_rl.kitchen.tasks import get_task

Pool = Literal["single", "all"]


@dataclass(frozen=True)
class StudyTables:
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
class Study:
    """A recipe that was read and checked as a whole, before anything runs."""

    tables: StudyTables
    collect: Mapping[str, Any]
    """Task → config of `zest collect`; none for real video."""
    settings: tuple[Setting, ...]


def read_study(path: Path) -> Study:
    """Read a study's recipe and check all of it.

    Raises:
        BadInput: an unknown key, a missing table, a wrong type, or the paper's figures of no task here.
    """
    from zest_rl.rewards.goals import goal_folder

    where = f"recipe {path}"
    tables = load_config(StudyTables, read_recipe(path), where)
    is_of_video = tables.study == "footage"
    collect = {} if is_of_video else read_tasks(tables.collect, tables.tasks, where)
    shared = checked_table(tables.select, f"{where} [select]", "datasets", "task")
    grid = checked_table(tables.grid, f"{where} [grid]", "datasets", "task")
    settings = []
    for values in product(*grid.values()):
        setting = dict(zip(grid, values, strict=True))
        arguments = {**shared, **setting}
        pool = arguments.get("pool", "single")
        if pool not in get_args(Pool):
            raise BadInput(f"{where} [grid]: unknown pool {pool!r}; {nearest(str(pool), get_args(Pool))}")
        if is_of_video:
            pool = ", ".join([pool, *(str(setting[key]) for key in ("ask", "folder", "goals") if key in setting)])
        else:
            arguments = {**arguments, "datasets": []}
            arguments.pop("pool", None)
        config = load_config(select.CONFIGS[tables.study], arguments, f"{where} [grid]")
        settings.append(Setting(setting, pool, config))
        for collect_config in collect.values():
            with located(f"{where} [grid]"):
                goal_folder(config.goal, get_task(collect_config.task))
    for name, row in tables.paper.items():
        for task in () if is_of_video else row.keys() - collect.keys():
            raise BadInput(f"{where} [paper.{name!r}]: there is no task {task!r} here; {nearest(task, collect)}")
    return Study(tables, collect, tuple(settings))


def run_study(study: Study, output: Path, ui: Ui, *, n_workers: int | None = None) -> dict[str, Any]:
    """Collect what is not there, select in every cell, and write result.json, table.md and report.html."""
    from zest_rl.cli import collect
    from zest_rl.report.html import write_report
    from zest_rl.runtime import artifacts

    datasets = {}
    for task, config in study.collect.items():
        ui.say(f"[1/2] collect {task}")
        datasets[task] = collect.run(replace(config, n_workers=n_workers), ui)["dataset"]
    ui.say(f"[2/2] select {study.tables.study}: {len(study.settings)} settings × {len(datasets) or 'all'} tasks")
    rows = []
    with ui.progress("cells", len(study.settings) * max(1, len(datasets))) as advance:
        for setting in study.settings:
            cells = _select(study, setting, datasets, n_workers, ui, advance)
            about = {"name": setting.name, "setting": dict(setting.values), "pool": setting.pool}
            rows.append({**about, "tasks": cells, "mean": mean_over_tasks(cells)})
    first = study.settings[0]
    result = {
        "study": study.tables.study,
        "title": study.tables.title,
        "rows": rows,
        "paper": study.tables.paper,
        "select": {
            flag: str(value) if isinstance(value, Path) else value
            for flag, value in asdict(first.select).items()
            if value is not None and flag not in (*first.values, "datasets", "n_workers", "n_repeats")
        },
        "provenance": artifacts.provenance(),
    }
    artifacts.write_json(output / "result.json", result)
    artifacts.write_bytes(output / "table.md", as_markdown(result).encode())
    html = write_report(study_page(result, study.tables.caveats), output / "report.html")
    return {
        **result,
        "report": str(html),
        "result": str(output / "result.json"),
        "next": f"open {html} in a browser",
    }


def _select(
    study: Study,
    setting: Setting,
    datasets: Mapping[str, str],
    n_workers: int | None,
    ui: Ui,
    advance: Callable[[], object],
) -> dict[str, Any]:
    """Return the results of `zest select`, per task or per object of real video."""
    if not datasets:
        objects: dict[str, Any] = select.run(setting.select, ui)["objects"]
        advance()
        return objects
    cells = {}
    for task, dataset in datasets.items():
        pool = (dataset,) if setting.pool == "single" else tuple(datasets.values())
        config = replace(setting.select, datasets=pool, task=study.collect[task].task, n_workers=n_workers)
        cells[task] = select.run(config, SilentUi())
        advance()
    return cells
