"""What a recipe's tasks are: collected by the kitchen's expert, or datasets that are there already.

The tables [collect] and [tasks.NAME] hold arguments of `zest collect`. In a recipe without [collect] each [tasks.NAME]
holds the fields of `GivenDataset`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, ClassVar

from zest_rl.cli.config import load_config
from zest_rl.errors import BadInput


@dataclass(frozen=True)
class GivenDataset:
    """A dataset that is there already, of any environment."""

    OF_EVALUATE: ClassVar = ("env", "horizon", "success_key")
    """Fields that are arguments of `zest evaluate`, which no other table of a recipe may set."""
    dataset: str
    """Its id."""
    made_by: str = ""
    """The command that makes it, for whoever lacks it."""
    env: str | None = None
    """package.module:make, where the dataset cannot name its environment; of `zest relabel` and `zest evaluate`."""
    horizon: int | None = None
    """Of `zest evaluate`."""
    success_key: str | None = None
    """Of `zest evaluate`."""
    relabel: dict[str, Any] = field(default_factory=dict)
    """Arguments of `zest relabel` for this task alone, such as its goal."""

    def arguments(self, *names: str) -> dict[str, Any]:
        """Return the named arguments that are given."""
        return {name: value for name in names if (value := getattr(self, name)) is not None}


def read_given(tasks: Mapping[str, Mapping[str, Any]], where: str) -> dict[str, GivenDataset]:
    """Read the tables [tasks.NAME] of a recipe without [collect].

    Raises:
        BadInput: there is none, a table is wrong, or two name the same dataset.
    """
    if not tasks:
        raise BadInput(
            f"{where} names no data: give it a table [collect] (the kitchen's expert), or [tasks.NAME] with "
            'dataset = "…" for each dataset that is there already'
        )
    given = {name: load_config(GivenDataset, table, f"{where} [tasks.{name}]") for name, table in tasks.items()}
    if len({task.dataset for task in given.values()}) < len(given):
        raise BadInput(f"{where} [tasks]: two tasks have the same dataset; every task needs one of its own")
    _check_names(given, where)
    return given


def check_given(given: Mapping[str, GivenDataset], where: str) -> None:
    """Check that the datasets are there, with equally many episodes, and both ends of the normalized return, over as
    many steps as are asked for.

    Raises:
        BadInput: they are not; all that are missing are named, with the commands that make them.
    """
    from zest_rl.data.folders import exists
    from zest_rl.data.reader import open_dataset

    missing = [task for task in given.values() if not exists(task.dataset)]
    if missing:
        lines = (": ".join(filter(None, (task.dataset, task.made_by))) for task in missing)
        raise BadInput("\n  ".join([f"{where}: datasets are missing; make them, then go on:", *lines]))
    sizes = {}
    for name, task in given.items():
        with open_dataset(task.dataset) as ds:
            sizes[name], longest, record = len(ds.n_steps()), max(ds.n_steps()), ds.record
        if record.ref_min_score is None or record.ref_max_score is None:
            raise BadInput(
                f"{where} [tasks.{name}]: {task.dataset} lacks ref_min_score or ref_max_score, the returns that are 0 "
                "and 100 % of the expert; give both when it is made (Recorder.write), or compare with `zest report`"
            )
        if task.horizon not in (None, longest):
            raise BadInput(
                f"{where} [tasks.{name}]: horizon must be that of {task.dataset}, {longest} steps, over which its "
                f"reference scores are, got {task.horizon}"
            )
    if len(set(sizes.values())) > 1:
        raise BadInput(f"{where} [tasks]: every task needs as many episodes, got {sizes}")


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
    _check_names(collected, where)
    return collected


def _check_names(tasks: Mapping[str, Any], where: str) -> None:
    for name in tasks:
        if not re.fullmatch(r"[A-Za-z0-9_-]+", name) or name == "report":
            raise BadInput(
                f"{where} [tasks.{name!r}]: the name becomes a file's beside report.html; use letters, digits, - and _"
            )


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
