"""``zest report``: evaluated runs → one HTML file."""

from __future__ import annotations

from collections.abc import Mapping
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
    trust: bool = False
    """Load the embedder that a dataset of somebody else names; remembered for this embedder."""


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Group the runs by method, build the report, write it."""
    from zest_rl.report.comparison_page import compare_runs
    from zest_rl.report.html import write_report
    from zest_rl.report.sections import RESULTS

    report = compare_runs(config.runs, title=config.title, trust=config.trust)
    path = write_report(report, config.output)
    return {
        "report": str(path),
        "rows": {row.method: round(row.mean, 2) for row in report.items(RESULTS)},
        "next": f"open {path} in a browser",
    }


def summary(result: Mapping[str, Any]) -> str:
    """One line per row, as text."""
    rows = [f"  {method:<28}{mean:>7.1f} % of the expert" for method, mean in result["rows"].items()]
    return "\n".join([*rows, f"report: {result['report']}"])
