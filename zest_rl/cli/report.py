"""``zest report``: evaluated runs → one HTML file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from zest_rl.cli.ui import Ui


@dataclass(frozen=True)
class Config:
    """Compare evaluated runs of one task in one self-contained HTML file."""

    runs: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN [RUN …]")] = ()
    """Folders of evaluated runs; runs that differ in their seed alone become one row."""
    output: Path = Path("report.html")
    """The HTML file."""
    title: str = "ZeST rewards for offline robot learning"
    """Headline."""


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Group the runs by method, build the report, write it."""
    from zest_rl.data import reader
    from zest_rl.errors import BadInput
    from zest_rl.report import write_report
    from zest_rl.report.comparison import compare, goal_name, methods_of_runs, read_meta

    if not config.runs:
        raise BadInput("`zest report` needs at least 1 run folder; `zest train` and `zest evaluate` make them")
    methods = methods_of_runs(tuple(dict.fromkeys(config.runs)))
    goals: dict[str, str] = {}
    sources: set[str] = set()
    for folder in config.runs:
        meta = read_meta(folder)
        dataset, goal = meta["dataset"]["id"], goal_name(meta)
        sources.add(dataset if goal is None else meta["dataset"]["zest"]["relabel"]["source"])
        if goal is not None and reader.exists(dataset) and goals.setdefault(goal, dataset) != dataset:
            goals[f"{goal} ({dataset})"] = dataset
    source = sources.pop() if len(sources) == 1 else None
    report = compare(
        config.title, methods, source_id=source if source is not None and reader.exists(source) else None, goals=goals
    )
    path = write_report(report, config.output)
    return {
        "report": str(path),
        "rows": {row.method: round(row.mean, 2) for row in report.table},
        "next": f"open {path} in a browser",
    }
