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

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of evaluated runs; runs that differ in their seed alone become one row."""
    output: Path = Path("report.html")
    """The HTML file."""
    title: str = "ZeST rewards for offline robot learning"
    """Headline."""


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Group the runs by method, build the report, write it."""
    from zest_rl import artifacts, data
    from zest_rl.comparison import Method, compare
    from zest_rl.errors import BadInput
    from zest_rl.report import write_report

    if not config.runs:
        raise BadInput("`zest report` needs at least 1 run folder; `zest train` and `zest evaluate` make them")
    groups: dict[str, list[Path]] = {}
    goals: dict[str, str] = {}
    sources: set[str] = set()
    for folder in config.runs:
        meta = artifacts.read_json(folder / "meta.json")
        relabel = meta["dataset"]["zest"].get("relabel")
        goal = "ground truth" if relabel is None else Path(relabel["scorer"]["config"]["goal"]).name
        agent = meta["agent"].upper()
        name = agent if agent == "BC" else f"{agent} on {goal}"
        groups.setdefault(name, []).append(folder)
        sources.add(meta["dataset"]["id"] if relabel is None else relabel["source"])
        if relabel is not None and data.exists(meta["dataset"]["id"]):
            goals.setdefault(goal, meta["dataset"]["id"])
    source = sources.pop() if len(sources) == 1 else None
    report = compare(
        config.title,
        [Method(name, tuple(folders)) for name, folders in groups.items()],
        source_id=source if source is not None and data.exists(source) else None,
        goals=goals,
    )
    path = write_report(report, config.output)
    return {
        "report": str(path),
        "rows": {row.method: round(row.mean, 2) for row in report.table},
        "next": f"open {path} in a browser",
    }
