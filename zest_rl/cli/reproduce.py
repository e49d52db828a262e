"""``zest reproduce``: a recipe → collected and relabeled datasets, trained and evaluated methods, table and report.

A recipe has these tables (keys are the flags of the verb)::

    title = "…"
    seeds = [0, 1, 2]               training seeds, one cell per method and seed
    caveats = ["…"]                 sentences at the end of the report
    [collect]                       `zest collect`
    [relabel]                       `zest relabel`, for all goals
    [goals.NAME]                    `zest relabel`, for this goal
    [train]                         `zest train`, for all methods
    [methods."NAME"]                agent = "dt", goal = "NAME" (left out: ground-truth rewards), kind, note, paper,
                                    and the agent's own flags
    [evaluate]                      `zest evaluate`

Cells run side by side, one core each; a finished cell is never run again.
"""

from __future__ import annotations

import math
import re
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from zest_rl.cli.ui import SilentUi, Ui
from zest_rl.errors import BadInput, nearest

if TYPE_CHECKING:
    from zest_rl.evaluation import EvaluationConfig

POLL_SECONDS = 2.0


@dataclass(frozen=True)
class Config:
    """Reproduce a whole comparison from a recipe; rerun the same command to go on or to find everything done."""

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RECIPE.toml")]
    """Recipe, e.g. eval/demo.toml."""
    output: Path | None = None
    """Folder of runs, result.json and report.html; default runs/RECIPE."""
    n_workers: int | None = None
    """Cells side by side; default one per core."""


@dataclass(frozen=True)
class Recipe:
    """The keys and tables of a recipe; what stands in a table is checked by the config of its verb."""

    title: str
    collect: dict[str, Any]
    methods: dict[str, dict[str, Any]]
    seeds: tuple[int, ...] = (0,)
    caveats: tuple[str, ...] = ()
    paper_demo: float | None = None
    relabel: dict[str, Any] = field(default_factory=dict)
    goals: dict[str, dict[str, Any]] = field(default_factory=dict)
    train: dict[str, Any] = field(default_factory=dict)
    evaluate: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.methods:
            raise BadInput("methods needs at least 1 method")
        if not self.seeds or min(self.seeds) < 0 or len(set(self.seeds)) < len(self.seeds):
            raise BadInput(f"seeds must be at least 1 number, all different and none negative, got {list(self.seeds)}")


@dataclass(frozen=True)
class Entry:
    """What the table of a method says besides the agent's own flags."""

    agent: str
    goal: str | None = None
    kind: Literal["method", "control"] = "method"
    note: str = ""
    paper: float | None = None


@dataclass(frozen=True)
class Plan:
    """A recipe, read and checked as a whole before anything runs."""

    recipe: Recipe
    collect: Any
    """Config of `zest collect`."""
    goals: Mapping[str, Any]
    """Name → config of `zest relabel`."""
    methods: Mapping[str, Entry]
    training: Mapping[str, Mapping[str, Any]]
    """Method → arguments of `zest train AGENT`; dataset and seed are added per cell."""
    evaluation: EvaluationConfig


@dataclass(frozen=True)
class Cell:
    """One method with one training seed."""

    method: str
    run: Path
    agent: str
    train: Mapping[str, Any]
    """Arguments of `zest train AGENT`."""
    evaluate: Mapping[str, Any]
    """Arguments of `zest evaluate`."""


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Run all stages that are not done yet."""
    from zest_rl import artifacts
    from zest_rl.cli import collect, relabel
    from zest_rl.comparison import Method, compare
    from zest_rl.report import write_report

    started = time.monotonic()
    plan = read_plan(config.file)
    output = config.output or Path("runs") / config.file.stem
    ui.say(f"[1/4] collect → {plan.collect.task}")
    collected = collect.run(replace(plan.collect, n_workers=config.n_workers), ui)
    source = collected["dataset"]
    datasets: dict[str, str] = {}
    for name, goal in plan.goals.items():
        ui.say(f"[2/4] relabel by goal {name!r}")
        relabeled = relabel.run(replace(goal, dataset=source, n_workers=config.n_workers), ui)
        datasets[name] = relabeled["dataset"]
    cells = plan_cells(plan, source, datasets, output)
    ui.say(f"[3/4] train and evaluate {len(cells)} cells in {output / 'cells'}")
    n_run = run_cells(cells, plan.evaluation, output, ui, n_workers=config.n_workers)
    ui.say("[4/4] report")
    methods = [
        Method(name, tuple(cell.run for cell in cells if cell.method == name), entry.kind, entry.note, entry.paper)
        for name, entry in plan.methods.items()
    ]
    report = compare(
        plan.recipe.title,
        methods,
        source_id=source,
        goals=datasets,
        config=plan.evaluation,
        paper_demo=plan.recipe.paper_demo,
        caveats=plan.recipe.caveats,
        details={"recipe": {"file": config.file.name, **asdict(plan.recipe)}, "collected": collected},
    )
    html = write_report(report, output / "report.html")
    result = {
        "rows": {
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
            for row in report.table
        },
        "spearman_of_zest_and_true_returns": {
            scatter.name: None if math.isnan(scatter.spearman) else {"value": scatter.spearman, "ci95": scatter.ci}
            for scatter in report.scatters
        },
        "dataset": {
            key: collected[key] for key in ("dataset", "n_episodes", "n_failed", "noise_max", "expert_success")
        },
        "seeds": list(plan.recipe.seeds),
        "seconds_by_cell": {cell.run.name: _seconds(cell) for cell in cells},
        "provenance": artifacts.provenance(),
    }
    artifacts.write_json(output / "result.json", result)
    if n_run == 0:
        ui.say("all cells were done already")
    return {
        **result,
        "report": str(html),
        "result": str(output / "result.json"),
        "n_cells_run": n_run,
        "seconds": round(time.monotonic() - started, 1),
        "next": f"open {html} in a browser",
    }


def summary(result: Mapping[str, Any]) -> str:
    """The table as text."""
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
    for name, rho in result["spearman_of_zest_and_true_returns"].items():
        value = "undefined" if rho is None else f"{rho['value']:.3f}"
        lines.append(f"goal {name}: Spearman ρ of ZeST and true returns {value}")
    return "\n".join(
        [*lines, f"report: {result['report']}", f"{result['n_cells_run']} cells run, {result['seconds']} s"]
    )


def read_plan(path: Path) -> Plan:
    """Read a recipe and check all of it.

    Raises:
        BadInput: an unknown key, a missing table, a wrong type, a method that names no agent or an unknown goal.
    """
    from zest_rl.agents import get_agent
    from zest_rl.cli import collect, evaluate, relabel, train
    from zest_rl.cli.recipes import load_config, read_recipe

    recipe = load_config(Recipe, read_recipe(path), f"recipe {path}")
    goals = {}
    for name, goal in recipe.goals.items():
        where = f"recipe {path} [goals.{name!r}]"
        table = {**_table(recipe.relabel, where, "dataset"), **_table(goal, where, "dataset"), "dataset": ""}
        goals[name] = load_config(relabel.Config, table, where)
    methods, training = {}, {}
    for name, method in recipe.methods.items():
        where = f"recipe {path} [methods.{name!r}]"
        own = {key: value for key, value in method.items() if key in (f.name for f in fields(Entry))}
        flags = {key: value for key, value in method.items() if key not in own}
        methods[name] = entry = load_config(Entry, own, where)
        with _at(where):
            get_agent(entry.agent)
        if entry.goal is not None and entry.goal not in goals:
            raise BadInput(f"{where}: unknown goal {entry.goal!r}; {nearest(entry.goal, goals)}")
        training[name] = {
            "n_updates": 5000,
            "threads": 1,
            "device": "cpu",
            **_table(recipe.train, where, "dataset", "seed", "run_dir"),
            **_table(flags, where, "dataset", "seed", "run_dir"),
        }
        load_config(train.CONFIGS[entry.agent], {**training[name], "dataset": ""}, where)
    where = f"recipe {path} [evaluate]"
    evaluate_config = load_config(evaluate.Config, {**_table(recipe.evaluate, where, "run"), "run": ""}, where)
    with _at(where):
        evaluation = evaluate.settings(evaluate_config)
    return Plan(
        recipe=recipe,
        collect=load_config(collect.Config, recipe.collect, f"recipe {path} [collect]"),
        goals=goals,
        methods=methods,
        training=training,
        evaluation=evaluation,
    )


@contextmanager
def _at(where: str) -> Iterator[None]:
    """Say in a refusal which part of the recipe it is about."""
    try:
        yield
    except BadInput as error:
        raise BadInput(f"{where}: {error}") from error


def _table(values: Mapping[str, Any], where: str, *given: str) -> dict[str, Any]:
    """Return a table with ``_`` for ``-`` in its keys; refuse those that `zest reproduce` itself gives."""
    table = {key.replace("-", "_"): value for key, value in values.items()}
    clash = sorted(table.keys() & set(given))
    if clash:
        raise BadInput(f"{where}: {', '.join(map(repr, clash))} is not for a recipe to set, it follows from the rest")
    return table


def plan_cells(plan: Plan, source: str, datasets: Mapping[str, str], output: Path) -> list[Cell]:
    """Return one cell per method and seed; a cell's folder is named by a hash of all that it depends on."""
    from zest_rl import artifacts, data

    described = {dataset: data.describe(dataset) for dataset in {source, *datasets.values()}}
    cells = []
    for name, entry in plan.methods.items():
        dataset = source if entry.goal is None else datasets[entry.goal]
        for seed in plan.recipe.seeds:
            table = {**plan.training[name], "dataset": dataset, "seed": seed}
            identity = [table, entry.agent, plan.recipe.evaluate, described[dataset]]
            slug = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
            folder = output / "cells" / f"{slug}-seed{seed}-{artifacts.hash_json(identity)[:8]}"
            cells.append(
                Cell(
                    name,
                    folder,
                    entry.agent,
                    {**table, "run_dir": str(folder)},
                    {"n_workers": 1, **plan.recipe.evaluate, "run": str(folder)},
                )
            )
    return cells


def _work(cell: Cell) -> dict[str, Any]:
    import numpy as np

    from zest_rl.cli import evaluate, train
    from zest_rl.cli.recipes import load_config

    started = time.monotonic()
    train.run(load_config(train.CONFIGS[cell.agent], cell.train, cell.method), SilentUi())
    trained = time.monotonic()
    evaluate.run(load_config(evaluate.Config, cell.evaluate, cell.method), SilentUi())
    return {"train_seconds": np.array(trained - started), "evaluate_seconds": np.array(time.monotonic() - trained)}


def run_cells(
    cells: list[Cell], evaluation: EvaluationConfig, output: Path, ui: Ui, *, n_workers: int | None = None
) -> int:
    """Train and evaluate all cells that are not done; return how many were not."""
    from zest_rl.parallel import map_jobs

    done_folder = output / "done"
    open_cells = {cell.run.name: cell for cell in cells if not _is_done(cell, evaluation, done_folder)}
    total = sum(cell.train["n_updates"] for cell in open_cells.values())
    with (
        ui.progress("updates of all cells (evaluation follows)", total) as advance,
        _TrainingWatch(list(open_cells.values()), advance),
    ):
        map_jobs(_work, open_cells, done_folder, n_workers=n_workers, on_done=lambda name: ui.say(f"done: {name}"))
    return len(open_cells)


def _is_done(cell: Cell, evaluation: EvaluationConfig, folder: Path) -> bool:
    """Whether a cell's results are there; a marker without them is removed, so that the cell is run again."""
    from zest_rl.evaluation import evaluation_folder

    marker = folder / f"{cell.run.name}.npz"
    results = (cell.run / "meta.json", evaluation_folder(cell.run, evaluation) / "result.json")
    if not all(path.exists() for path in results):
        marker.unlink(missing_ok=True)
    return marker.exists()


class _TrainingWatch:
    """Follow the training logs of cells that other processes work on."""

    def __init__(self, cells: list[Cell], advance: Any) -> None:
        self._cells, self._advance, self._shown = cells, advance, 0
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
        updates = sum(_updates_done(cell.run / "metrics.csv") for cell in self._cells)
        if updates > self._shown:
            self._advance(updates - self._shown)
            self._shown = updates


def _updates_done(log: Path) -> int:
    try:
        rows = log.read_text().splitlines()
        return int(rows[-1].split(",")[rows[0].split(",").index("update")])
    except (OSError, IndexError, ValueError):
        return 0


def _seconds(cell: Cell) -> dict[str, float]:
    from zest_rl.parallel import read_arrays

    times = read_arrays(cell.run.parent.parent / "done" / f"{cell.run.name}.npz") or {}
    return {name: round(float(value), 1) for name, value in times.items()}
