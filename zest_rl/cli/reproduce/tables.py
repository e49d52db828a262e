"""The results of a comparison as text: for the terminal, and for a README."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any


def as_text(result: Mapping[str, Any]) -> str:
    """Write the table, the figures of each task, how well scores rank its episodes, and what is to be seen."""
    lines = [
        f"{'':<28}{'% of expert':>12}  {'95 % interval':<18}{'success':>8}{'seeds':>7}{'episodes':>10}{'paper':>8}"
    ]
    for name, row in result["rows"].items():
        low, high = row["ci95"]
        paper = "–" if row["paper"] is None else f"{row['paper']:.2f}"
        lines.append(
            f"{name:<28}{row['normalized_return']:>12.2f}  {f'[{low:.2f}, {high:.2f}]':<18}{_share(row):>8}"
            f"{row['n_seeds']:>7}{row['n_episodes']:>10}{paper:>8}"
        )
    if len(result["tasks"]) > 1:
        for task, task_result in result["tasks"].items():
            figures = (f"{name} {row['normalized_return']:.1f}" for name, row in task_result["rows"].items())
            lines.append(f"{task}: {', '.join(figures)}")
    for task, task_result in result["tasks"].items():
        for name, rho in task_result["spearman_of_zest_and_true_returns"].items():
            value = "undefined" if rho is None else f"{rho['value']:.3f}"
            lines.append(f"{task}, goal {name}: Spearman ρ of ZeST and true returns {value}")
    return "\n".join(
        [
            *lines,
            result["summary"],
            f"report: {result['report']}",
            f"{result['n_cells_run']} cells run, {result['seconds']} s",
        ]
    )


def as_markdown(result: Mapping[str, Any], rows: Sequence[str] = ()) -> str:
    """Write the table for a README: all rows, with one column per task, or the named rows over all tasks alone.

    There is a column of seeds where methods differ in them.
    """
    tasks = list(result["tasks"]) if len(result["tasks"]) > 1 and not rows else []
    shown = {name: result["rows"][name] for name in rows or result["rows"]}
    with_seeds = len({row["n_seeds"] for row in shown.values() if row["kind"] != "dataset"}) > 1
    columns = ["% of the expert", "95 % interval", "success", *tasks, *(["seeds"] if with_seeds else []), "paper"]
    lines = [f"| | {' | '.join(columns)} |", "|---|" + "---|" * len(columns)]
    for name, row in shown.items():
        low, high = row["ci95"]
        cells = [f"{row['normalized_return']:.2f}", f"{low:.1f} to {high:.1f}", _share(row)]
        cells += [f"{result['tasks'][task]['rows'][name]['normalized_return']:.1f}" for task in tasks]
        if with_seeds:
            cells.append("–" if row["kind"] == "dataset" else str(row["n_seeds"]))
        cells.append("–" if row["paper"] is None else f"{row['paper']:.2f}")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _share(row: Mapping[str, Any]) -> str:
    """Write the share of successes; a dash where nothing tells them."""
    return "–" if row["success"] is None else f"{100 * row['success']:.0f} %"
