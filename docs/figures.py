"""Draws the pictures of the documentation that show committed results; run by `make tables`.

docs/images/rl.svg      how policies learned in their environments, from eval/results/rl.json and table1.json
docs/images/trex.svg    learned against true returns of trajectories, from eval/results/trex.json
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zest_rl.runtime import artifacts

ROOT = Path(__file__).resolve().parents[1]
SEEN, UNSEEN = "#b6c2cf", "#0969da"
STYLE = {
    "svg.hashsalt": "zest_rl",  # the same names in the file at each drawing
    "svg.fonttype": "none",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
}


def learning_curves(result: Mapping[str, Any]) -> Figure:
    """Draw the return in training of what learns in the environment, a panel for each task, over cloning's level.

    A dot is the return of the final policies as they are evaluated, without exploring.
    """
    table1 = committed("table1")["tasks"]

    def draw(axes: Axes, task: Mapping[str, Any], name: str) -> None:
        cloned = table1[name]["rows"]["BC"]["normalized_return"]
        axes.axhline(cloned, color="gray", linestyle="--", linewidth=1, label="BC")
        for label, curve in task["learning_curves"].items():
            (line,) = axes.plot(curve["steps"], curve["mean"], label=label)
            color = line.get_color()
            axes.plot(curve["steps"][-1], task["rows"][label]["normalized_return"], "o", color=color)
            axes.fill_between(curve["steps"], curve["low"], curve["high"], color=color, alpha=0.15, linewidth=0)

    return _panels(result["tasks"], draw, "step in the environment", "% of the expert")


def learned_returns(result: Mapping[str, Any]) -> Figure:
    """Draw the learned over the true return of trajectories, seen and unseen ones, a panel for each task."""

    def draw(axes: Axes, returns: Mapping[str, Any], _: str) -> None:
        true, learned = np.array(returns["true"]), np.array(returns["learned"])
        unseen = np.isin(np.arange(len(true)), returns["held_out"])
        for which, color, name in ((~unseen, SEEN, "learned from"), (unseen, UNSEEN, "held out")):
            axes.plot(true[which], learned[which], "o", markersize=3, color=color, label=name)

    return _panels(result["returns"]["tasks"], draw, "true return", "learned return")


def committed(name: str) -> Any:
    """Return the results of a recipe."""
    return json.loads((ROOT / f"eval/results/{name}.json").read_text(encoding="utf-8"))


FIGURES: Mapping[str, Callable[[Mapping[str, Any]], Figure]] = {"rl": learning_curves, "trex": learned_returns}
"""Committed results → how they are drawn."""


def _panels(tasks: Mapping[str, Any], draw: Callable[[Axes, Any, str], None], x: str, y: str) -> Figure:
    columns = min(3, len(tasks))
    rows = math.ceil(len(tasks) / columns)
    figure = Figure(figsize=(3 * columns, 2.2 * rows + 0.5), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes, (name, task) in zip(panels.flat, tasks.items(), strict=False):
        axes.set_title(name, fontsize=9)
        draw(axes, task, name)
    for axes in panels.flat[len(tasks) :]:
        axes.set_axis_off()
    figure.supxlabel(x, fontsize=9)
    figure.supylabel(y, fontsize=9)
    handles, labels = panels.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=min(3, len(labels)), frameon=False)
    return figure


def drawn(name: str) -> str:
    """Return the picture of committed results, an SVG."""
    with mpl.rc_context(STYLE):
        file = io.StringIO()
        figure = FIGURES[name](committed(name))
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return "".join(f"{line.rstrip()}\n" for line in file.getvalue().splitlines())


if __name__ == "__main__":
    for name in FIGURES:
        if (ROOT / f"eval/results/{name}.json").exists():
            artifacts.write_bytes(ROOT / f"docs/images/{name}.svg", drawn(name).encode())
