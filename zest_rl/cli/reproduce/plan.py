"""Recipes of ``zest reproduce``, read, checked as a whole, and laid out as cells: task × method × training seed.

A recipe has these tables (keys are the flags of the verb)::

    title = "…"
    seeds = [0, 1, 2]               training seeds, one cell per task, method and seed
    caveats = ["…"]                 sentences at the end of the report
    [collect]                       `zest collect`, for all tasks
    [tasks.NAME]                    `zest collect`, for this task; left out: the one task of [collect]. With a key
                                    task = "…" the name is free, and one task may have several datasets
    [relabel]                       `zest relabel`, for all goals
    [goals.NAME]                    `zest relabel`, for this goal
    [train]                         `zest train`, for all methods
    [train.AGENT]                   `zest train AGENT`, for all methods with this agent
    [evaluate]                      `zest evaluate`, for all methods
    [methods."NAME"]                agent = "dt", goal = "NAME" (left out: ground-truth rewards), kind, note, paper,
                                    evaluate = {…} of this method alone, and the agent's own flags
    [methods."NAME"]                policy = "torchscript:FILE" in place of the agent: `zest adopt`; {task} and {seed}
                                    stand for those of the cell, and goal says on whose rewards it was trained

Methods that differ in their evaluation alone share their trained policies. A recipe without methods ends with what the
rewards of its goals are worth: the page of `zest inspect`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from zest_rl.errors import BadInput, nearest
from zest_rl.kitchen.tasks import get_task

if TYPE_CHECKING:
    from zest_rl.evaluation.evaluate import EvaluationConfig


@dataclass(frozen=True)
class Recipe:
    """The keys and tables of a recipe; what stands in a table is checked by the config of its verb."""

    title: str
    collect: dict[str, Any]
    methods: dict[str, dict[str, Any]] = field(default_factory=dict)
    seeds: tuple[int, ...] = (0,)
    caveats: tuple[str, ...] = ()
    paper_demo: float | None = None
    tasks: dict[str, dict[str, Any]] = field(default_factory=dict)
    relabel: dict[str, Any] = field(default_factory=dict)
    goals: dict[str, dict[str, Any]] = field(default_factory=dict)
    train: dict[str, Any] = field(default_factory=dict)
    evaluate: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.methods and not self.goals:
            raise BadInput("a recipe needs at least 1 method, or 1 goal to inspect")
        if not self.seeds or min(self.seeds) < 0 or len(set(self.seeds)) < len(self.seeds):
            raise BadInput(f"seeds must be at least 1 number, all different and none negative, got {list(self.seeds)}")


@dataclass(frozen=True)
class Entry:
    """What the table of a method says besides the agent's own flags."""

    agent: str | None = None
    policy: str | None = None
    """Trained elsewhere, in the place of an agent."""
    goal: str | None = None
    kind: Literal["method", "control"] = "method"
    note: str = ""
    paper: float | None = None
    evaluate: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if (self.agent is None) == (self.policy is None):
            raise BadInput(f"a method has either an agent or a policy, got {self.agent!r} and {self.policy!r}")

    @property
    def maker(self) -> str:
        """The agent, or ``foreign``."""
        from zest_rl.agents.foreign import FOREIGN

        return self.agent or FOREIGN


@dataclass(frozen=True)
class PlannedMethod:
    """One row of the table to be."""

    entry: Entry
    training: Mapping[str, Any]
    """Arguments of `zest train AGENT` or `zest adopt`; dataset and seed are added per cell."""
    evaluate: Mapping[str, Any]
    """Arguments of `zest evaluate`; the run is added per cell."""
    evaluation: EvaluationConfig
    """What these arguments mean."""


@dataclass(frozen=True)
class Plan:
    """A recipe, read and checked as a whole before anything runs."""

    recipe: Recipe
    collect: Mapping[str, Any]
    """Task → config of `zest collect`."""
    goals: Mapping[str, Any]
    """Name → config of `zest relabel`."""
    methods: Mapping[str, PlannedMethod]


@dataclass(frozen=True)
class TaskData:
    """The datasets of one task."""

    source: str
    """The collected one."""
    by_goal: Mapping[str, str]
    """Goal → the one relabeled by it."""


@dataclass(frozen=True)
class Cell:
    """One method on one task with one training seed."""

    task: str
    method: str
    run: Path
    agent: str
    """Or ``foreign``."""
    train: Mapping[str, Any]
    """Arguments of `zest train AGENT`, or of `zest adopt`."""
    evaluate: Mapping[str, Any]
    """Arguments of `zest evaluate`."""
    evaluation: EvaluationConfig

    @property
    def name(self) -> str:
        """Name of the marker that says that it is done."""
        from zest_rl.runtime.artifacts import hash_json

        return f"{self.run.name}-{hash_json({**self.evaluate, 'run': '', 'n_workers': 1})[:8]}"


def read_plan(path: Path) -> Plan:
    """Read a recipe and check all of it.

    Raises:
        BadInput: an unknown key, a missing table, a wrong type, a method that names no agent or an unknown goal.
    """
    from zest_rl.cli import relabel
    from zest_rl.cli.config import load_config, read_recipe
    from zest_rl.rewards.goals import goal_folder

    table = read_recipe(path)
    if "verb" in table:
        raise BadInput(f"recipe {path} is for `zest {table['verb']} --recipe {path}`, not for `zest reproduce`")
    recipe = load_config(Recipe, table, f"recipe {path}")
    goals = {}
    for name, goal in recipe.goals.items():
        where = f"recipe {path} [goals.{name!r}]"
        table = {**table_of(recipe.relabel, where, "dataset"), **table_of(goal, where, "dataset"), "dataset": ""}
        goals[name] = load_config(relabel.Config, table, where)
    methods = {
        name: _plan_method(recipe, method, goals, f"recipe {path} [methods.{name!r}]")
        for name, method in recipe.methods.items()
    }
    unused = {key for key, table in recipe.train.items() if isinstance(table, dict)} - {
        method.entry.maker for method in methods.values()
    }
    if unused:
        raise BadInput(
            f"recipe {path} [train]: no method has the agent {', '.join(sorted(unused))}; leave its table out"
        )
    collected = plan_tasks(recipe.collect, recipe.tasks, f"recipe {path}")
    for name, config in goals.items():
        for collect_config in collected.values():
            with located(f"recipe {path} [goals.{name!r}]"):
                goal_folder(config.goal, get_task(collect_config.task))
    return Plan(recipe, collected, goals, methods)


def plan_tasks(collect: Mapping[str, Any], tasks: Mapping[str, Mapping[str, Any]], where: str) -> dict[str, Any]:
    """Read the tables [collect] and [tasks.NAME] of a recipe: task → config of `zest collect`.

    Raises:
        BadInput: a table is wrong, or tasks do not have as many episodes and a dataset of their own.
    """
    from zest_rl.cli.collect import Config
    from zest_rl.cli.config import load_config

    if not tasks:
        config = load_config(Config, collect, f"{where} [collect]")
        collected = {config.task: config}
    else:
        shared = table_of(collect, f"{where} [collect]", "task")
        collected = {}
        for name, table in tasks.items():
            here = f"{where} [tasks.{name}]"
            collected[name] = load_config(Config, {**shared, "task": name, **table_of(table, here)}, here)
    sizes, ids = {config.n_episodes for config in collected.values()}, {c.dataset_id for c in collected.values()}
    if len(sizes) > 1 or len(ids) < len(collected):
        raise BadInput(
            f"{where} [tasks]: every task needs as many episodes and a dataset of its own, got n_episodes "
            f"{sorted(sizes)} and datasets {sorted(ids)}; let the dataset's id in [collect] hold {{task}}, or give "
            "each [tasks.NAME] its own"
        )
    for name in collected:
        if not re.fullmatch(r"[A-Za-z0-9_-]+", name) or name == "report":
            raise BadInput(
                f"{where} [tasks.{name!r}]: the name becomes a file's beside report.html; use letters, digits, - and _"
            )
    return collected


def config_of(agent: str) -> type[Any]:
    """Return the config of the verb that makes the run: `zest train AGENT`, or `zest adopt` for ``foreign``."""
    from zest_rl.agents.foreign import FOREIGN
    from zest_rl.cli import adopt, train

    config: type[Any] = adopt.Config if agent == FOREIGN else train.CONFIGS[agent]
    return config


def _plan_method(recipe: Recipe, method: Mapping[str, Any], goals: Mapping[str, Any], where: str) -> PlannedMethod:
    from zest_rl.agents import AGENTS, get_agent
    from zest_rl.agents.foreign import parse
    from zest_rl.cli import evaluate
    from zest_rl.cli.config import load_config

    own = {key: value for key, value in method.items() if key in (f.name for f in fields(Entry))}
    flags = {key: value for key, value in method.items() if key not in own}
    entry = load_config(Entry, own, where)
    if entry.agent is not None:
        with located(where):
            get_agent(entry.agent)
    if entry.goal is not None and entry.goal not in goals:
        raise BadInput(f"{where}: unknown goal {entry.goal!r}; {nearest(entry.goal, goals)}")
    of_agents = {key: table for key, table in recipe.train.items() if key in AGENTS and isinstance(table, dict)}
    shared = {key: value for key, value in recipe.train.items() if key not in of_agents}
    training: dict[str, Any]
    if entry.policy is not None:
        if len(recipe.seeds) > 1 and "{seed}" not in entry.policy:
            raise BadInput(f"{where}: with several seeds the policy must hold {{seed}}, got {entry.policy!r}")
        if len(recipe.tasks) > 1 and "{task}" not in entry.policy:
            raise BadInput(f"{where}: with several tasks the policy must hold {{task}}, got {entry.policy!r}")
        training = {"policy": entry.policy, **table_of(flags, where, "dataset", "seed", "run_dir", "name")}
        with located(where):
            parse(entry.policy, training.get("python"))  # its files may be trained on the data that are made first
    else:
        training = {"n_updates": 5000, "threads": 1, "device": "cpu"}
        for table in (shared, of_agents.get(entry.maker, {}), flags):
            training |= table_of(table, where, "dataset", "seed", "run_dir")
    load_config(config_of(entry.maker), {**training, "dataset": ""}, where)
    arguments = {**table_of(recipe.evaluate, where, "run"), **table_of(entry.evaluate, where, "run")}
    config = load_config(evaluate.Config, {**arguments, "run": ""}, f"{where} [evaluate]")
    with located(f"{where} [evaluate]"):
        evaluation = evaluate.settings(config)
    return PlannedMethod(entry, training, {"n_workers": 1, **arguments}, evaluation)


@contextmanager
def located(where: str) -> Iterator[None]:
    """Say in a refusal which part of the recipe it is about."""
    try:
        yield
    except BadInput as error:
        raise BadInput(f"{where}: {error}") from error


def table_of(values: Mapping[str, Any], where: str, *given: str) -> dict[str, Any]:
    """Return a table with ``_`` for ``-`` in its keys; refuse those that `zest reproduce` itself gives."""
    table = {key.replace("-", "_"): value for key, value in values.items()}
    clash = sorted(table.keys() & set(given))
    if clash:
        raise BadInput(f"{where}: {', '.join(map(repr, clash))} is not for a recipe to set, it follows from the rest")
    return table


def plan_cells(plan: Plan, datasets: Mapping[str, TaskData], output: Path) -> list[Cell]:
    """Return one cell per task, method and seed; the run's folder is named by a hash of its data and all arguments.

    All cells of the first seed come first: of what was cut short, a recipe with fewer seeds finds its cells done.

    Raises:
        BadInput: policies that were trained elsewhere are not there; all of them are named.
    """
    from zest_rl.agents.foreign import identify
    from zest_rl.cli.config import load_config
    from zest_rl.data.reader import open_dataset
    from zest_rl.runtime import artifacts

    described = {}
    for name in (name for task in datasets.values() for name in (task.source, *task.by_goal.values())):
        with open_dataset(name) as ds:
            described[name] = ds.describe()
    cells, problems = [], []
    for seed, (name, method), (task, of_task) in product(plan.recipe.seeds, plan.methods.items(), datasets.items()):
        goal, agent = method.entry.goal, method.entry.maker
        dataset = of_task.source if goal is None else of_task.by_goal[goal]
        table = {**method.training, "dataset": dataset, "seed": seed}
        if method.entry.policy is not None:
            policy = method.entry.policy.replace("{task}", task).replace("{seed}", str(seed))
            table |= {"policy": policy, "name": name}
        arguments = asdict(load_config(config_of(agent), table, name))  # defaults are arguments, too
        if method.entry.policy is not None:
            try:
                arguments |= {"policy": identify(arguments["policy"], arguments["python"]).to_json()}
            except BadInput as error:
                problems.append(f"{name!r}, trained on {dataset} with seed {seed}: {error}")
        digest = artifacts.hash_json([arguments, agent, described[dataset]])
        run = output / "cells" / f"{task}-{agent}-{goal or 'ground-truth'}-seed{seed}-{digest[:8]}"
        cells.append(
            Cell(
                task,
                name,
                run,
                agent,
                {**table, "run_dir": str(run)},
                {**method.evaluate, "run": str(run)},
                method.evaluation,
            )
        )
    if problems:
        raise BadInput("\n  ".join(["policies from elsewhere are missing; train them, then go on:", *problems]))
    return cells
