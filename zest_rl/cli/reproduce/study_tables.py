"""The results of a study: means over tasks, tables in percent, and the page."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from zest_rl.report.sections import Report

MEASURES = {"top_n_success": "Top-N success", "relative_variation": "total variation, of its largest value"}


def mean_over_tasks(cells: Mapping[str, Mapping[str, Any]]) -> dict[str, float | None]:
    """Mean over tasks of every figure; the standard error of the Top-N success over tasks, as the paper has it, and of
    its mean over tasks over the repeats, where goals or contexts were drawn anew.
    """
    top = [cell["top_n_success"]["value"] for cell in cells.values()]
    mean = sum(top) / len(top)
    repeats = list(zip(*(cell.get("top_n_by_repeat", []) for cell in cells.values()), strict=False))
    ratio = sum(cell["goal_frame_ratio"] for cell in cells.values()) / len(cells)
    return {
        "top_n_success": mean,
        "top_n_standard_error": _standard_error(top),
        "top_n_standard_error_of_repeats": _standard_error([sum(repeat) / len(repeat) for repeat in repeats]),
        "relative_variation": sum(cell["relative_variation"]["value"] for cell in cells.values()) / len(cells),
        "goal_frame_ratio": ratio,
        "times_random": mean / ratio,
    }


def _standard_error(values: Sequence[float]) -> float | None:
    return statistics.stdev(values) / math.sqrt(len(values)) if len(values) > 1 else None


def _lines(result: Mapping[str, Any], measure: str) -> list[tuple[str, list[float | None], float]]:
    """Return (name, value per task, mean) of our rows, of chance, and of the paper."""
    rows, tasks = result["rows"], _tasks(result)

    def values(row: Mapping[str, Any], figure: Callable[[Any], float]) -> list[float | None]:
        return [figure(row["tasks"][task]) if task in row["tasks"] else None for task in tasks]

    lines = [(row["name"], values(row, lambda cell: cell[measure]["value"]), row["mean"][measure]) for row in rows]
    if measure != "top_n_success":
        return lines
    by_pool = {row["pool"]: row for row in rows}
    for pool, row in by_pool.items():
        chance = values(row, lambda cell: cell["goal_frame_ratio"])
        lines.append((f"at random, pool {pool}", chance, row["mean"]["goal_frame_ratio"]))
    for name, row in result["paper"].items():
        shares = [row[task] / 100 if task in row else None for task in tasks]
        known = [share for share in shares if share is not None]
        if known:
            lines.append((f"paper: {name}", shares, sum(known) / len(known)))
    return lines


def _tasks(result: Mapping[str, Any]) -> list[str]:
    """Return the columns: all tasks, or all objects that any setting has."""
    return list(dict.fromkeys(task for row in result["rows"] for task in row["tasks"]))


def as_markdown(result: Mapping[str, Any]) -> str:
    """One table per measure, in percent: our rows, chance, and the paper's; ± is the standard error over repeats."""
    tasks = _tasks(result)
    errors = {row["name"]: row["mean"]["top_n_standard_error_of_repeats"] for row in result["rows"]}
    parts = []
    for measure, title in MEASURES.items():
        parts += [f"{title}, %\n", f"| | {' | '.join(tasks)} | mean |", f"|---|{'---|' * (len(tasks) + 1)}"]
        for name, values, mean in _lines(result, measure):
            cells = " | ".join("–" if value is None else f"{100 * value:.1f}" for value in values)
            error = errors.get(name) if measure == "top_n_success" else None
            spread = "" if error is None else f" ± {100 * error:.1f}"
            parts.append(f"| {name} | {cells} | {100 * mean:.1f}{spread} |")
        parts.append("")
    return "\n".join(parts)


def study_page(result: Mapping[str, Any], caveats: tuple[str, ...]) -> Report:
    """Build the page: the same tables, with intervals."""
    from zest_rl.report.content import QualityRow, QualityTable
    from zest_rl.report.sections import CAVEATS, DETAILS, REWARD_QUALITY, Report

    tasks = _tasks(result)
    intervals = {
        (row["name"], task, measure): tuple(cell[measure]["ci95"])
        for row, measure in product(result["rows"], MEASURES)
        for task, cell in row["tasks"].items()
    }
    unknown = (math.nan, math.nan)
    rows = [
        QualityRow(
            name,
            title,
            tuple(
                None if value is None else (value, *intervals.get((name, task, measure), unknown))
                for task, value in zip((*tasks, "mean"), (*values, mean), strict=True)
            ),
        )
        for measure, title in MEASURES.items()
        for name, values, mean in _lines(result, measure)
    ]
    best = max(result["rows"], key=lambda row: row["mean"]["top_n_success"])
    details = {"settings": result["select"], "provenance": result["provenance"]}
    return Report(
        result["title"],
        f"Best over tasks: {best['name']}. {best['mean']['top_n_success']:.0%} of the highest-scoring frames are "
        f"right, {best['mean']['times_random']:.1f} times as many as at random.",
        (
            CAVEATS(caveats),
            REWARD_QUALITY((QualityTable((*tasks, "mean"), tuple(rows)),)),
            DETAILS(tuple(details.items())),
        ),
    )


def as_text(result: Mapping[str, Any]) -> str:
    """Write the tables for the terminal."""
    return f"{as_markdown(result)}\nreport: {result['report']}"
