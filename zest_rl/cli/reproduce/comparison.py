"""Recipes of ``zest reproduce`` that compare methods, read and checked as a whole before anything runs.

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
                                    evaluate = {…} of this method alone, seeds = […] if not all of them, and the
                                    agent's own flags
    [methods."NAME"]                policy = "torchscript:FILE" in place of the agent: `zest adopt`; {task} and {seed}
                                    stand for those of the cell, and goal says on whose rewards it was trained

Methods that differ in their evaluation alone share their trained policies. A recipe without methods ends with what the
rewards of its goals are worth: the page of `zest inspect`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from zest_rl.cli.config import load_config, read_recipe
from zest_rl.errors import BadInput, nearest
from zest_rl.kitchen.tasks import get_task

if TYPE_CHECKING:
    from zest_rl.evaluation.evaluate import EvaluationConfig


@dataclass(frozen=True)
class ComparisonTables:
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
class MethodTable:
    """The keys of a method's table that are no flags of its agent."""

    agent: str | None = None
    policy: str | None = None
    """Trained elsewhere, in the place of an agent."""
    goal: str | None = None
    kind: Literal["method", "control"] = "method"
    note: str = ""
    paper: float | None = None
    evaluate: dict[str, Any] = field(default_factory=dict)
    seeds: tuple[int, ...] | None = None
    """Those of the recipe's that it is trained with; None: all."""

    def __post_init__(self) -> None:
        if (self.agent is None) == (self.policy is None):
            raise BadInput(f"a method has either an agent or a policy, got {self.agent!r} and {self.policy!r}")

    @property
    def agent_or_foreign(self) -> str:
        """The agent, or ``foreign`` for a policy that was trained elsewhere."""
        from zest_rl.agents.foreign import FOREIGN

        return self.agent or FOREIGN


@dataclass(frozen=True)
class MethodArguments:
    """What one row of the results is made with."""

    table: MethodTable
    seeds: tuple[int, ...]
    train: Mapping[str, Any]
    """Arguments of `zest train AGENT` or `zest adopt`; dataset and seed are added per cell."""
    evaluate: Mapping[str, Any]
    """Arguments of `zest evaluate`; the run is added per cell."""
    evaluation: EvaluationConfig
    """What these arguments mean."""


@dataclass(frozen=True)
class Comparison:
    """A recipe that was read and checked."""

    tables: ComparisonTables
    collect: Mapping[str, Any]
    """Task → config of `zest collect`."""
    relabel: Mapping[str, Any]
    """Goal → config of `zest relabel`."""
    methods: Mapping[str, MethodArguments]


def read_comparison(path: Path) -> Comparison:
    """Read a recipe and check all of it.

    Raises:
        BadInput: an unknown key, a missing table, a wrong type, a method that names no agent or an unknown goal.
    """
    from zest_rl.cli import relabel
    from zest_rl.rewards.goals import goal_folder

    recipe = f"recipe {path}"
    table = read_recipe(path)
    if "verb" in table:
        raise BadInput(f"{recipe} is for `zest {table['verb']} --recipe {path}`, not for `zest reproduce`")
    tables = load_config(ComparisonTables, table, recipe)
    goals = {}
    for name, goal in tables.goals.items():
        where = f"{recipe} [goals.{name!r}]"
        flags = {**checked_table(tables.relabel, where, "dataset"), **checked_table(goal, where, "dataset")}
        goals[name] = load_config(relabel.Config, {**flags, "dataset": ""}, where)
    methods = {
        name: _read_method(tables, method, goals, f"{recipe} [methods.{name!r}]")
        for name, method in tables.methods.items()
    }
    unused = {key for key, flags in tables.train.items() if isinstance(flags, dict)} - {
        method.table.agent_or_foreign for method in methods.values()
    }
    if unused:
        raise BadInput(f"{recipe} [train]: no method has the agent {', '.join(sorted(unused))}; leave its table out")
    collect = read_tasks(tables.collect, tables.tasks, recipe)
    for name, relabel_config in goals.items():
        for collect_config in collect.values():
            with located(f"{recipe} [goals.{name!r}]"):
                goal_folder(relabel_config.goal, get_task(collect_config.task))
    return Comparison(tables, collect, goals, methods)


def read_tasks(collect: Mapping[str, Any], tasks: Mapping[str, Mapping[str, Any]], where: str) -> dict[str, Any]:
    """Read the tables [collect] and [tasks.NAME]: task → config of `zest collect`.

    Raises:
        BadInput: a table is wrong, or tasks do not have as many episodes and a dataset of their own.
    """
    from zest_rl.cli.collect import Config

    if not tasks:
        config = load_config(Config, collect, f"{where} [collect]")
        collected = {config.task: config}
    else:
        shared = checked_table(collect, f"{where} [collect]", "task")
        collected = {}
        for name, table in tasks.items():
            here = f"{where} [tasks.{name}]"
            collected[name] = load_config(Config, {**shared, "task": name, **checked_table(table, here)}, here)
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


def run_config(agent: str) -> type[Any]:
    """Return the config of the verb that makes the run: `zest train AGENT`, or `zest adopt` for ``foreign``."""
    from zest_rl.agents.foreign import FOREIGN
    from zest_rl.cli import adopt, train

    config: type[Any] = adopt.Config if agent == FOREIGN else train.CONFIGS[agent]
    return config


def _read_method(
    tables: ComparisonTables, method: Mapping[str, Any], goals: Mapping[str, Any], where: str
) -> MethodArguments:
    from zest_rl.agents import AGENTS, get_agent
    from zest_rl.cli import evaluate

    keys = {key: value for key, value in method.items() if key in (f.name for f in fields(MethodTable))}
    flags = {key: value for key, value in method.items() if key not in keys}
    table = load_config(MethodTable, keys, where)
    if table.agent is not None:
        with located(where):
            get_agent(table.agent)
    if table.goal is not None and table.goal not in goals:
        raise BadInput(f"{where}: unknown goal {table.goal!r}; {nearest(table.goal, goals)}")
    seeds = tables.seeds if table.seeds is None else table.seeds
    if not seeds or not set(seeds) <= set(tables.seeds):
        raise BadInput(f"{where}: seeds must be some of the recipe's seeds {list(tables.seeds)}, got {list(seeds)}")
    train: dict[str, Any]
    if table.policy is not None:
        _check_policy(tables, seeds, table.policy, flags.get("python"), where)
        train = {"policy": table.policy, **checked_table(flags, where, "dataset", "seed", "run_dir", "name")}
    else:
        by_agent = {key: value for key, value in tables.train.items() if key in AGENTS and isinstance(value, dict)}
        shared = {key: value for key, value in tables.train.items() if key not in by_agent}
        train = {"n_updates": 5000, "threads": 1, "device": "cpu"}
        for given in (shared, by_agent.get(table.agent_or_foreign, {}), flags):
            train |= checked_table(given, where, "dataset", "seed", "run_dir")
    load_config(run_config(table.agent_or_foreign), {**train, "dataset": ""}, where)
    arguments = {**checked_table(tables.evaluate, where, "run"), **checked_table(table.evaluate, where, "run")}
    config = load_config(evaluate.Config, {**arguments, "run": ""}, f"{where} [evaluate]")
    with located(f"{where} [evaluate]"):
        evaluation = evaluate.settings(config)
    return MethodArguments(table, seeds, train, {"n_workers": 1, **arguments}, evaluation)


def _check_policy(
    tables: ComparisonTables, seeds: tuple[int, ...], policy: str, python: str | None, where: str
) -> None:
    """Check how a policy from elsewhere is named; its files may be trained on the data that are made first."""
    from zest_rl.agents.foreign import parse

    if len(seeds) > 1 and "{seed}" not in policy:
        raise BadInput(f"{where}: with several seeds the policy must hold {{seed}}, got {policy!r}")
    if len(tables.tasks) > 1 and "{task}" not in policy:
        raise BadInput(f"{where}: with several tasks the policy must hold {{task}}, got {policy!r}")
    with located(where):
        parse(policy, python)


@contextmanager
def located(where: str) -> Iterator[None]:
    """Say in a refusal which part of the recipe it is about."""
    try:
        yield
    except BadInput as error:
        raise BadInput(f"{where}: {error}") from error


def checked_table(values: Mapping[str, Any], where: str, *given: str) -> dict[str, Any]:
    """Return a table with ``_`` for ``-`` in its keys; refuse those that `zest reproduce` itself gives."""
    table = {key.replace("-", "_"): value for key, value in values.items()}
    clash = sorted(table.keys() & set(given))
    if clash:
        raise BadInput(f"{where}: {', '.join(map(repr, clash))} is not for a recipe to set, it follows from the rest")
    return table
