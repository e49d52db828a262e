"""Recipes of ``zest reproduce`` that learn rewards: tasks by rankings by inputs.

A recipe has these tables (keys are the flags of the verb)::

    study = "trex"
    title = "…"
    caveats = ["…"]
    [collect], [tasks.NAME]     as in the recipes of `zest_rl.cli.reproduce.comparison`
    [relabel]                   `zest relabel`, for all rankings
    [rankings."NAME"]           `zest relabel` for one of them
    [train]                     `zest train trex`, for all
    [inputs.NAME]               `zest train trex` for obs or embeddings
    [paper."NAME"]              a row of the paper to show beside ours: task → percent

A run that is finished is not trained again, so a study that was cut short goes on there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from zest_rl.cli.config import load_config, read_recipe
from zest_rl.cli.reproduce.tasks import checked_table, read_tasks
from zest_rl.cli.ui import SilentUi, Ui

if TYPE_CHECKING:
    from zest_rl.analysis.learned_rewards import Judgement
    from zest_rl.report.sections import Report

Table = dict[str, Any]


@dataclass(frozen=True)
class RewardTables:
    """The keys and tables of a recipe; what stands in a table is checked by the config of its verb."""

    study: Literal["trex"]
    title: str
    collect: Table
    rankings: dict[str, Table]
    inputs: dict[Literal["obs", "embeddings"], Table]
    caveats: tuple[str, ...] = ()
    tasks: dict[str, Table] = field(default_factory=dict)
    relabel: Table = field(default_factory=dict)
    train: Table = field(default_factory=dict)
    paper: dict[str, dict[str, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class RewardStudy:
    """A recipe that was read and checked as a whole, before anything runs."""

    tables: RewardTables
    collect: Mapping[str, Any]
    """Task → config of `zest collect`."""
    relabel: Mapping[str, Any]
    """Ranking → config of `zest relabel`, without a dataset."""
    train: Mapping[str, Table]
    """Inputs → flags of `zest train trex`."""


def read_reward_study(path: Path) -> RewardStudy:
    """Read a recipe and check all of it.

    Raises:
        BadInput: an unknown key, a missing table, or a wrong type.
    """
    from zest_rl.cli import relabel, train

    where = f"recipe {path}"
    tables = load_config(RewardTables, read_recipe(path), where)
    relabels, trainings = {}, dict[str, Table]()
    for name, table in tables.rankings.items():
        flags = {**tables.relabel, **checked_table(table, f"{where} [rankings.{name!r}]", "dataset")}
        relabels[name] = load_config(relabel.Config, {**flags, "dataset": "of the task"}, where)
    for inputs, table in tables.inputs.items():
        flags = {**tables.train, **checked_table(table, f"{where} [inputs.{inputs}]", "dataset", "run_dir")}
        trainings[inputs] = {**flags, "inputs": inputs}
        load_config(train.CONFIGS["trex"], {**trainings[inputs], "dataset": "of the task"}, where)
    return RewardStudy(tables, read_tasks(tables.collect, tables.tasks, where), relabels, trainings)


def run_reward_study(study: RewardStudy, output: Path, ui: Ui, *, n_workers: int | None = None) -> dict[str, Any]:
    """Collect and relabel what is not there, train and judge; write result.json, table.md and report.html."""
    from zest_rl.analysis.learned_rewards import judge_learned_reward
    from zest_rl.cli import collect, relabel, train
    from zest_rl.report.html import write_report
    from zest_rl.runtime import artifacts

    judged: dict[tuple[str, str], dict[str, Judgement]] = {}
    with ui.progress("rewards", len(study.collect) * len(study.relabel) * len(study.train)) as advance:
        for task, collected in study.collect.items():
            dataset = collect.run(replace(collected, n_workers=n_workers), SilentUi())["dataset"]
            for ranking, how in study.relabel.items():
                scored = relabel.run(replace(how, dataset=dataset, n_workers=n_workers), SilentUi())["dataset"]
                for inputs, flags in study.train.items():
                    run_dir = output / "runs" / f"{task}-{artifacts.hash_json([scored, flags])[:8]}"
                    given = {**flags, "dataset": scored, "run_dir": str(run_dir)}
                    train.run(load_config(train.CONFIGS["trex"], given, "the recipe"), SilentUi())
                    judged.setdefault((ranking, inputs), {})[task] = judge_learned_reward(run_dir)
                    advance()
    result = {
        "study": "trex",
        "title": study.tables.title,
        "rows": [
            {
                "ranking": ranking,
                "inputs": inputs,
                "tasks": {task: figures(judgement) for task, judgement in cells.items()},
            }
            for (ranking, inputs), cells in judged.items()
        ],
        "returns": _returns(judged),
        "paper": study.tables.paper,
        "train": study.train,
        "relabel": {name: {**study.tables.relabel, **table} for name, table in study.tables.rankings.items()},
        "provenance": artifacts.provenance(),
    }
    artifacts.write_json(output / "result.json", result)
    artifacts.write_bytes(output / "table.md", as_markdown(result).encode())
    html = write_report(reward_page(result, judged, study.tables.caveats), output / "report.html")
    return {**result, "report": str(html), "result": str(output / "result.json"), "next": f"open {html} in a browser"}


def figures(judgement: Judgement) -> dict[str, float | None]:
    """Return the numbers of a judgement for JSON."""
    names = ("accuracy", "plain", "rho_seen", "rho_unseen")
    values = {name: getattr(judgement, name) for name in names}
    return {name: None if math.isnan(value) else round(value, 4) for name, value in values.items()}


def _returns(judged: Mapping[tuple[str, str], Mapping[str, Judgement]]) -> dict[str, Any]:
    """Return what a figure shows of the reward that is best over tasks: each trajectory's learned and true return."""
    import numpy as np

    (ranking, inputs), cells = max(
        judged.items(), key=lambda row: np.nansum([judgement.accuracy for judgement in row[1].values()])
    )
    return {
        "ranking": ranking,
        "inputs": inputs,
        "tasks": {
            task: {
                "true": judgement.true_returns.round(2).tolist(),
                "learned": judgement.learned_returns.round(2).tolist(),
                "held_out": judgement.held_out.nonzero()[0].tolist(),
            }
            for task, judgement in cells.items()
        },
    }


def lines(result: Mapping[str, Any]) -> list[tuple[str, list[float | None]]]:
    """Return (name, accuracy per task): learned rewards, the plain sums that they learned from, and the paper."""
    tasks = list(result["rows"][0]["tasks"])
    found = [
        (f"T-REX of {row['inputs']}, ranked by {row['ranking']}", [row["tasks"][task]["accuracy"] for task in tasks])
        for row in result["rows"]
    ]
    plain = {row["ranking"]: [row["tasks"][task]["plain"] for task in tasks] for row in result["rows"]}
    found += [(f"plain sum of {ranking}", values) for ranking, values in plain.items()]
    paper = result["paper"].items()
    return found + [
        (f"paper: {name}", [row[task] / 100 if task in row else None for task in tasks]) for name, row in paper
    ]


def as_markdown(result: Mapping[str, Any]) -> str:
    """The accuracies in percent, and the rank correlation of returns on unseen trajectories."""
    tasks = list(result["rows"][0]["tasks"])
    head = f"| | {' | '.join(tasks)} | mean |\n|---|{'---|' * (len(tasks) + 1)}\n"
    table = "Parts of unseen trajectories ranked as by the ground truth, %\n\n" + head
    for name, values in lines(result):
        table += f"| {name} | {_cells([None if value is None else 100 * value for value in values], 1)} |\n"
    table += "\nRank correlation of learned and true returns of unseen trajectories\n\n" + head
    for row in result["rows"]:
        rho = [row["tasks"][task]["rho_unseen"] for task in tasks]
        table += f"| T-REX of {row['inputs']}, ranked by {row['ranking']} | {_cells(rho, 2)} |\n"
    return table


def _cells(values: list[float | None], digits: int) -> str:
    """Write values, and their mean; a dash for what is not known."""
    known = [value for value in values if value is not None]
    mean = sum(known) / len(known) if known else None
    return " | ".join("–" if value is None else f"{value:.{digits}f}" for value in (*values, mean))


def reward_page(
    result: Mapping[str, Any], judged: Mapping[tuple[str, str], Mapping[str, Judgement]], caveats: tuple[str, ...]
) -> Report:
    """Build the page: the table, and learned against true returns of seen and unseen trajectories."""
    import numpy as np

    from zest_rl.report.content import QualityRow, QualityTable, Scatter
    from zest_rl.report.sections import CAVEATS, DETAILS, RANKING, REWARD_QUALITY, Report

    tasks = list(result["rows"][0]["tasks"])
    unknown = (math.nan, math.nan)
    rows = [
        QualityRow(name, "accuracy", tuple(None if value is None else (value, *unknown) for value in values))
        for name, values in lines(result)
    ]
    scatters = [
        Scatter(
            f"{task}: {inputs}, {ranking}, {which}",
            judgement.true_returns[part].astype(np.float32),
            judgement.learned_returns[part].astype(np.float32),
            rho,
            y_name="learned return",
        )
        for (ranking, inputs), cells in judged.items()
        for task, judgement in cells.items()
        for which, part, rho in (
            ("seen", ~judgement.held_out, judgement.rho_seen),
            ("unseen", judgement.held_out, judgement.rho_unseen),
        )
    ]
    best = max(lines(result)[: len(result["rows"])], key=lambda line: sum(filter(None, line[1])))
    mean = sum(filter(None, best[1])) / len(best[1])
    details = {"train": result["train"], "relabel": result["relabel"], "provenance": result["provenance"]}
    return Report(
        result["title"],
        f"Best over tasks: {best[0]}, which ranks {mean:.1%} of the pairs of parts as the ground truth does.",
        (
            CAVEATS(caveats),
            REWARD_QUALITY((QualityTable(tuple(tasks), tuple(rows)),)),
            RANKING(tuple(scatters)),
            DETAILS(tuple(details.items())),
        ),
    )


def as_text(result: Mapping[str, Any]) -> str:
    """Write the tables for the terminal."""
    return f"{as_markdown(result)}\nreport: {result['report']}"
