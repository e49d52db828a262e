"""Recipes of ``zest reproduce`` that compare methods, read and checked as a whole before anything runs.

A recipe has these tables (keys are the flags of the verb)::

    title = "…"
    seeds = [0, 1, 2]               training seeds, one cell per task, method and seed
    caveats = ["…"]                 sentences at the end of the report
    [collect]                       `zest collect`, for all tasks
    [tasks.NAME]                    `zest collect`, for this task; left out: the one task of [collect]. With a key
                                    task = "…" the name is free, and one task may have several datasets
    [tasks.NAME]                    without [collect]: dataset = "ID", which is there already, of any environment, with
                                    both reference scores (what `zest report` shows without, a recipe refuses);
                                    made_by = "…", the command that makes it; env = "package.module:make", horizon and
                                    success_key of `zest evaluate`; relabel = {…}, `zest relabel` for this task
    [relabel]                       `zest relabel`, for all goals
    [goals.NAME]                    `zest relabel`, for this goal
    [train]                         `zest train`, for all methods
    [train.AGENT]                   `zest train AGENT`, for all methods with this agent
    [evaluate]                      `zest evaluate`, for all methods
    [methods."NAME"]                agent = "dt", goal = "NAME" (left out: ground-truth rewards), kind, note, paper,
                                    evaluate = {…} of this method alone, seeds = […] if not all of them, keep = 0.8
                                    (`zest curate` by that goal, before training), and the agent's own flags
    [methods."NAME"]                policy = "torchscript:FILE" in place of the agent: `zest adopt`; {task} and {seed}
                                    stand for those of the cell, and goal says on whose rewards it was trained

Methods that differ in their evaluation alone share their trained policies. A recipe without methods ends with what the
rewards of its goals are worth: the page of `zest inspect`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from zest_rl.cli.arguments import arguments_of
from zest_rl.cli.config import load_config, read_recipe
from zest_rl.cli.reproduce.tasks import GivenDataset, checked_table, located, read_given, read_tasks
from zest_rl.errors import BadInput, nearest
from zest_rl.kitchen.tasks import get_task


@dataclass(frozen=True)
class ComparisonTables:
    """The keys and tables of a recipe; what stands in a table is checked by the config of its verb."""

    title: str
    collect: dict[str, Any] | None = None
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
    keep: float | None = None
    """Share of the episodes that `zest curate` keeps by the goal's scores; None: all."""

    def __post_init__(self) -> None:
        if self.keep is not None and (self.goal is None or not 0 < self.keep < 1):
            raise BadInput(f"keep must be above 0 and below 1, and needs a goal, got {self.keep} and {self.goal!r}")
        if (self.agent is None) == (self.policy is None):
            raise BadInput(f"a method has either an agent or a policy, got {self.agent!r} and {self.policy!r}")

    @property
    def agent_or_foreign(self) -> str:
        """The agent, or ``foreign`` for a policy that was trained elsewhere."""
        from zest_rl.agents.configs import FOREIGN

        return self.agent or FOREIGN


@dataclass(frozen=True)
class MethodArguments:
    """What one row of the results is made with."""

    table: MethodTable
    seeds: tuple[int, ...]
    train: Mapping[str, Any]
    """Arguments of `zest train AGENT` or `zest adopt`; dataset and seed are added per cell."""
    evaluate: Mapping[str, Any]
    """Arguments of `zest evaluate`; the run, and what is of the task, are added per cell."""


@dataclass(frozen=True)
class Comparison:
    """A recipe that was read and checked."""

    tables: ComparisonTables
    tasks: Mapping[str, Any]
    """Task → config of `zest collect`, or a `GivenDataset`."""
    relabel: Mapping[str, Mapping[str, Any]]
    """Task → goal → config of `zest relabel`; the dataset is added per task."""
    methods: Mapping[str, MethodArguments]


def read_comparison(path: Path) -> Comparison:
    """Read a recipe and check all of it.

    Raises:
        BadInput: an unknown key, a missing table, a wrong type, a method that names no agent or an unknown goal.
    """
    recipe = f"recipe {path}"
    table = read_recipe(path)
    if "verb" in table:
        raise BadInput(f"{recipe} is for `zest {table['verb']} --recipe {path}`, not for `zest reproduce`")
    tables = load_config(ComparisonTables, table, recipe)
    methods = {
        name: _read_method(tables, method, f"{recipe} [methods.{name!r}]") for name, method in tables.methods.items()
    }
    unused = {key for key, flags in tables.train.items() if isinstance(flags, dict)} - {
        method.table.agent_or_foreign for method in methods.values()
    }
    if unused:
        raise BadInput(f"{recipe} [train]: no method has the agent {', '.join(sorted(unused))}; leave its table out")
    tasks: Mapping[str, Any]
    if tables.collect is None:
        tasks = read_given(tables.tasks, recipe)
    else:
        tasks = read_tasks(tables.collect, tables.tasks, recipe)
    return Comparison(tables, tasks, {name: _read_goals(tables, task, recipe) for name, task in tasks.items()}, methods)


def _read_goals(tables: ComparisonTables, task: Any, recipe: str) -> dict[str, Any]:
    """Return goal → config of `zest relabel` on one task."""
    from zest_rl.cli import relabel
    from zest_rl.rewards.episode_goals import EPISODE
    from zest_rl.rewards.goals import free_goal_folder, goal_folder

    of_task = {**task.arguments("env"), **task.relabel} if isinstance(task, GivenDataset) else {}
    goals = {}
    for name, goal in tables.goals.items():
        where, flags = f"{recipe} [goals.{name!r}]", dict[str, Any]()
        for given in (tables.relabel, of_task, goal):
            flags |= checked_table(given, where, "dataset", "preview")
        config = goals[name] = load_config(relabel.Config, {**flags, "dataset": ""}, where)
        with located(where):
            if config.goal.startswith(EPISODE):
                continue
            if isinstance(task, GivenDataset):
                free_goal_folder(config.goal)
            else:
                goal_folder(config.goal, get_task(task.task))
    return goals


def run_config(agent: str) -> type[Any]:
    """Return the config of the verb that makes the run: `zest train AGENT`, or `zest adopt` for ``foreign``."""
    from zest_rl.agents.configs import FOREIGN
    from zest_rl.cli import adopt, train

    config: type[Any] = adopt.Config if agent == FOREIGN else train.CONFIGS[agent]
    return config


def _read_method(tables: ComparisonTables, method: Mapping[str, Any], where: str) -> MethodArguments:
    from zest_rl.agents.configs import CONFIGS, config_of
    from zest_rl.cli import evaluate

    keys = {key: value for key, value in method.items() if key in (f.name for f in fields(MethodTable))}
    flags = {key: value for key, value in method.items() if key not in keys}
    table = load_config(MethodTable, keys, where)
    if table.agent is not None:
        with located(where):
            config_of(table.agent)
    if table.goal is not None and table.goal not in tables.goals:
        raise BadInput(f"{where}: unknown goal {table.goal!r}; {nearest(table.goal, tables.goals)}")
    seeds = tables.seeds if table.seeds is None else table.seeds
    if not seeds or not set(seeds) <= set(tables.seeds):
        raise BadInput(f"{where}: seeds must be some of the recipe's seeds {list(tables.seeds)}, got {list(seeds)}")
    train: dict[str, Any]
    if table.policy is not None:
        _check_policy(tables, seeds, table.policy, flags.get("python"), where)
        train = {"policy": table.policy, **checked_table(flags, where, "dataset", "seed", "run_dir", "name")}
    else:
        by_agent = {key: value for key, value in tables.train.items() if key in CONFIGS and isinstance(value, dict)}
        shared = {key: value for key, value in tables.train.items() if key not in by_agent}
        train = {"threads": 1, "device": "cpu"}
        if "n_updates" in arguments_of(run_config(table.agent_or_foreign)):
            train["n_updates"] = 5000
        for given in (shared, by_agent.get(table.agent_or_foreign, {}), flags):
            train |= checked_table(given, where, "dataset", "seed", "run_dir")
    load_config(run_config(table.agent_or_foreign), {**train, "dataset": ""}, where)
    arguments = dict[str, Any]()
    for given in (tables.evaluate, table.evaluate):
        arguments |= checked_table(given, where, "run", *GivenDataset.OF_EVALUATE)
    config = load_config(evaluate.Config, {**arguments, "run": ""}, f"{where} [evaluate]")
    with located(f"{where} [evaluate]"):
        evaluate.settings(config)
    return MethodArguments(table, seeds, train, {"n_workers": 1, **arguments})


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
