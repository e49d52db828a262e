"""Writes the tables of README.md, docs/results.md and eval/README.md from the committed results; run by `make tables`.

What stands between two comments is written again::

    <!-- make tables: table1, rows BC | ZeST+DT -->     these rows of eval/results/table1.json, over all tasks alone
    <!-- make tables: table1 -->                        all rows, each task, how scores rank the episodes, the time,
                                                        and the learning curves of what learned in an environment
    <!-- make tables: recipes -->                       every recipe of eval/: its results, or what it needs
    <!-- end -->
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from zest_rl.cli.reproduce.tables import as_markdown

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "eval" / "results"
PAGES = ("README.md", "docs/results.md", "eval/README.md")
BLOCK = re.compile(r"(<!-- make tables: (\w+)(?:, rows (.+?))? -->\n).*?(?=<!-- end -->)", re.DOTALL)
NOT_RUN = "# Not run: "
"""Begins the line in a recipe's header that names what it needs and cannot be had with packages alone."""


def rendered(page: str) -> str:
    """Return the text of a page with every table as the committed results have it."""
    return BLOCK.sub(lambda block: f"{block[1]}\n{_table(block[2], block[3])}\n", page)


def _table(name: str, rows: str | None) -> str:
    if name == "recipes":
        return _recipes()
    result = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    if rows:
        shown = rows.split(" | ")
        return f"{as_markdown(result, shown)}\n{_source(result, shown)}.\n"
    return (
        f"{as_markdown(result)}\n{_ranks(result)}\n{_curves(name, result)}"
        f"{_source(result, result['rows'])}; wall time: {wall_time(result)}.\n"
    )


def _ranks(result: Mapping[str, Any]) -> str:
    """Write Spearman's ρ of ZeST and true returns over the training episodes: goals × tasks."""
    tasks = {name: task["spearman_of_zest_and_true_returns"] for name, task in result["tasks"].items()}
    lines = [f"| ρ of ZeST and true returns, by goal | {' | '.join(tasks)} |", "|---|" + "---|" * len(tasks)]
    for goal in next(iter(tasks.values())):
        found = (ranks[goal] for ranks in tasks.values())
        cells = ("–" if rank is None else f"{rank['value']:.2f}" for rank in found)
        lines.append(f"| {goal} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _curves(name: str, result: Mapping[str, Any]) -> str:
    """Show the picture of the learning curves, if there are any, and say how long these trainings took."""
    tasks = result["tasks"].values()
    names = {method for task in tasks for method in task.get("learning_curves", ())}
    if not names:
        return ""
    times = {method: [s for task in tasks for s in task["train_seconds"][method]] for method in sorted(names)}
    mean = ", ".join(f"{method} {sum(of_all) / len(of_all) / 60:.1f} min" for method, of_all in times.items())
    return (
        f"![Returns over the steps of the trainings, one panel for each task](images/{name}.svg)\n\n"
        "Lines are returns of the newest 20 episodes in training, which explore: means over seeds, and their range. "
        f"Dots are the final policies as evaluated, without exploring. One training took, on average: {mean}.\n\n"
    )


def _source(result: Mapping[str, Any], shown: Iterable[str]) -> str:
    trained = [row for row in map(result["rows"].get, shown) if row["kind"] != "dataset"]
    n_seeds = sorted({row["n_seeds"] for row in trained})
    per_task = trained[0]["n_episodes"] // trained[0]["n_seeds"] // len(result["tasks"])
    provenance = result["provenance"]
    return (
        f"`{provenance['command']}`, revision {provenance['git_revision']}, {' to '.join(map(str, n_seeds))} training "
        f"seed{'s' * (n_seeds[-1] > 1)} × {per_task} episodes per task"
    )


def wall_time(result: Mapping[str, Any]) -> str:
    """Return how long each stage took, where that was measured, and what was noted by hand."""
    stages = [f"{stage} {seconds / 60:.1f} min" for stage, seconds in result.get("seconds_by_stage", {}).items()]
    return ", ".join([*stages, *([result["wall_time"]] if "wall_time" in result else [])])


def _recipes() -> str:
    lines = ["| recipe | what | results |", "|---|---|---|"]
    for path in sorted((ROOT / "eval").glob("*.toml")):
        header = path.read_text(encoding="utf-8").splitlines()
        lines.append(f"| `{path.name}` | {header[0].removeprefix('# ').rstrip('.')} | {_state(path.stem, header)} |")
    return "\n".join(lines) + "\n"


def _state(name: str, header: list[str]) -> str:
    path = RESULTS / f"{name}.json"
    if path.exists():
        result = json.loads(path.read_text(encoding="utf-8"))
        return f"[{result['provenance']['git_revision']}](results/{name}.json), {wall_time(result)}"
    needs = (line.removeprefix(NOT_RUN).rstrip(".") for line in header if line.startswith(NOT_RUN))
    return f"not run: {next(needs, 'to be done')}"


if __name__ == "__main__":
    for page in PAGES:
        path = ROOT / page
        path.write_text(rendered(path.read_text(encoding="utf-8")), encoding="utf-8")
