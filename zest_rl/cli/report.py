"""``zest report``: evaluated runs → one HTML file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from zest_rl.cli.ui import Ui

PERCENT = "% of the expert"


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
    """Group the runs by method, build the report, write it; or find it written."""
    from zest_rl.report.finished import PageRecord, runs_contents

    record = PageRecord(config.output, "report", config.title, runs_contents(config.runs))
    if not config.trust and (made := record.result()) is not None:
        ui.say(f"{config.output} is there already, nothing to do")
        return made
    with ui.progress("drawing the report", 1) as advance:
        from zest_rl.report.comparison_page import compare_runs
        from zest_rl.report.html import write_report
        from zest_rl.report.sections import EPISODES, RESULTS

        report = compare_runs(config.runs, title=config.title, trust=config.trust)
        path, rows = write_report(report, config.output), report.items(RESULTS)
        advance()
    result = {
        "report": str(path),
        "rows": {row.method: round(row.mean, 2) for row in rows},
        "intervals": {row.method: [round(row.ci_low, 2), round(row.ci_high, 2)] for row in rows},
        "success": {row.method: None if math.isnan(row.success_rate) else round(row.success_rate, 4) for row in rows},
        "unit": PERCENT if all(row.is_normalized for row in rows) else "return",
        "sentence": report.summary,
        "next": f"open {path} in a browser",
    }
    drawn = {panel.method for panel in report.items(EPISODES)}
    is_whole = drawn >= {row.method for row in rows if row.kind == "method"}
    return record.keep(result) if is_whole else result  # the others may be drawn the next time


def summary(result: Mapping[str, Any]) -> str:
    """One line per row, and what they say, as text."""
    digits = 1 if result["unit"] == PERCENT else 2
    lines = [f"  {'':<28}{result['unit']:>16}  {'95 % interval':<18}  success"]
    for method, mean in result["rows"].items():
        low, high = (f"{end:.{digits}f}" for end in result["intervals"][method])
        interval, success = f"[{low}, {high}]", result["success"][method]
        lines.append(
            f"  {method:<28}{mean:>16.{digits}f}  {interval:<18}{'–' if success is None else f'{success:.0%}':>9}"
        )
    return "\n".join([*lines, result["sentence"], f"report: {result['report']}"])
