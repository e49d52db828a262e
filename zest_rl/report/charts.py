"""Charts as SVG strings: pure functions, no styling (that is `style.css`), no units but percent of the plot.

Positions are percentages, so a chart fills whatever width it gets while text, dots and strokes keep their size; the
tick labels stand in the padding that `style.css` gives to ``svg.chart``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from zest_rl.report.content import MethodRow, Scatter
from zest_rl.types import FloatArray

MISSING = "–"
"""What stands where a figure is not finite."""


def number(value: float | None, digits: int = 2) -> str:
    """Return `value` with `digits` decimals, a true minus sign and spaced thousands; "–" for None, NaN, infinity."""
    if value is None or not math.isfinite(value):
        return MISSING
    text = f"{value:z,.{digits}f}"
    return text.replace("-", "−").replace(",", "\u202f")


@dataclass(frozen=True)
class Axis:
    """A linear axis from `low` to `high` with at least two ticks on round numbers."""

    low: float
    high: float
    ticks: tuple[float, ...]

    def percent(self, value: float) -> float:
        """Return where `value` lies, in % of the axis, clipped to it."""
        return min(max(100 * (value - self.low) / (self.high - self.low), 0.0), 100.0)

    def label(self, tick: float) -> str:
        """Return a tick as text, with as many decimals as the step between ticks needs."""
        step = self.ticks[1] - self.ticks[0]
        return number(tick, max(0, -math.floor(math.log10(step) + 1e-9)))


def axis_over(values: Iterable[float], n_ticks: int, margin: float) -> Axis:
    """Return an axis over the finite `values`, longer by `margin` (a share of their range) at both ends."""
    finite = [float(v) for v in values if math.isfinite(v)] or [0.0, 1.0]
    low, high = min(finite), max(finite)
    if high - low < 1e-9 * max(1.0, abs(high)):
        low, high = low - 0.5, high + 0.5
    rough = (high - low) / n_ticks
    power = 10.0 ** math.floor(math.log10(rough))
    room = margin * (high - low)
    low, high = low - room, high + room
    round_steps = [m * power for m in (0.5, 1, 2, 5, 10)]
    fewest = next(i for i, step in enumerate(round_steps) if step >= rough * 0.999)
    ticks: tuple[float, ...] = ()
    while len(ticks) < 2:  # a step a little shorter than the axis may fall on it once only
        step = round_steps[fewest]
        first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
        ticks = tuple(k * step for k in range(first, last + 1))
        fewest -= 1
    return Axis(low, high, ticks)


def _x_ticks(x: Axis) -> str:
    return "".join(
        f'<text class="x tick" x="{x.percent(t):.2f}%" y="100%" dy="1.5em">{x.label(t)}</text>' for t in x.ticks
    )


def _y_ticks(y: Axis) -> str:
    parts = []
    for tick in y.ticks:
        at = f"{100 - y.percent(tick):.2f}%"
        parts.append(f'<line class="grid" x1="0" x2="100%" y1="{at}" y2="{at}"/>')
        parts.append(f'<text class="y tick" x="-8" y="{at}" dy=".32em">{y.label(tick)}</text>')
    return "".join(parts)


def interval_bar(row: MethodRow, axis: Axis) -> str:
    """Return the mean as a dot on its 95 % interval, with the paper's figure as a diamond below it."""
    parts = [f'<line class="grid" x1="{axis.percent(t):.2f}%" x2="{axis.percent(t):.2f}%" y1="0" y2="100%"/>'
             for t in axis.ticks]  # fmt: skip
    if math.isfinite(row.ci_low) and math.isfinite(row.ci_high):
        low, high = axis.percent(row.ci_low), axis.percent(row.ci_high)
        parts.append(f'<line class="ci" x1="{low:.2f}%" x2="{high:.2f}%" y1="50%" y2="50%"/>')
    if math.isfinite(row.mean):
        parts.append(f'<circle class="mean" cx="{axis.percent(row.mean):.2f}%" cy="50%" r="5"/>')
    label = f"mean {number(row.mean, 1)} %, 95 % interval {number(row.ci_low, 1)} to {number(row.ci_high, 1)} %"
    if row.paper_value is not None and math.isfinite(row.paper_value):
        at = f"{axis.percent(row.paper_value):.2f}%"
        parts.append(f'<svg x="{at}" y="50%" overflow="visible"><path class="paper" d="M0 7l5 5l-5 5l-5-5Z"/></svg>')
        label += f"; the paper {number(row.paper_value, 1)} %"
    return f'<svg class="bar {row.kind}" role="img" aria-label="{escape(label)}">{"".join(parts)}</svg>'


def axis_labels(axis: Axis) -> str:
    """Return the tick labels that stand above a column of `interval_bar`."""
    ticks = "".join(
        f'<text x="{axis.percent(t):.2f}%" y="1em" class="x tick">{axis.label(t)}</text>' for t in axis.ticks
    )
    return f'<svg class="bar-axis" aria-hidden="true">{ticks}</svg>'


def correlation_gauge(value: float) -> str:
    """Return a correlation as a dot between −1 and 1."""
    axis = Axis(-1, 1, (-1, 0, 1))
    at, zero = axis.percent(value), axis.percent(0)
    return (
        '<svg class="gauge" aria-hidden="true"><line class="rail" x1="0" x2="100%" y1="50%" y2="50%"/>'
        f'<line class="ci" x1="{zero:.2f}%" x2="{at:.2f}%" y1="50%" y2="50%"/>'
        f'<line class="zero" x1="{zero:.2f}%" x2="{zero:.2f}%" y1="15%" y2="85%"/>'
        f'<circle class="mean" cx="{at:.2f}%" cy="50%" r="5"/></svg>'
    )


def scatter_chart(scatter: Scatter) -> str:
    """Return one dot per episode with a hover title, ground truth across, ZeST upward; only finite pairs."""
    finite = np.flatnonzero(np.isfinite(scatter.gt_returns) & np.isfinite(scatter.zest_returns))
    x, y = axis_over(scatter.gt_returns[finite], 4, 0.05), axis_over(scatter.zest_returns[finite], 6, 0.05)
    point, upward, across = (escape(text) for text in (scatter.point, scatter.upward, scatter.across))
    dots = []
    for i in finite:
        gt, zest = float(scatter.gt_returns[i]), float(scatter.zest_returns[i])
        dots.append(
            f'<circle class="point" cx="{x.percent(gt):.2f}%" cy="{100 - y.percent(zest):.2f}%" r="4">'
            f"<title>{point} {i}: {upward} {number(zest)}, {across} {number(gt)}</title></circle>"
        )
    label = f"{scatter.name}: {len(finite)} {scatter.point}s, Spearman {number(scatter.spearman)}"
    marks = _x_ticks(x) + _y_ticks(y) + "".join(dots)
    return f'<svg class="chart square" role="img" aria-label="{escape(label)}">{marks}</svg>'


@dataclass(frozen=True)
class Line:
    """One line of a chart."""

    x: FloatArray
    """(n,) positions."""
    y: FloatArray
    """(n,) values; the line is interrupted where one is not finite."""
    style: str
    """CSS class."""
    band: tuple[FloatArray, FloatArray] | None = None
    """Lower and upper edge, each (n,)."""


def _path(line: Line, x: Axis, y: Axis) -> str:
    commands, pen_down = [], False
    for px, py in zip(line.x, line.y, strict=True):
        if not (math.isfinite(px) and math.isfinite(py)):
            pen_down = False
            continue
        point = f"{x.percent(float(px)):.2f} {100 - y.percent(float(py)):.2f}"
        commands.append(f"L{point}" if pen_down else f"M{point}l0 0")
        pen_down = True
    return "".join(commands)


def _band(line: Line, x: Axis, y: Axis) -> str:
    if line.band is None:
        return ""
    low, high = line.band
    finite = np.flatnonzero(np.isfinite(line.x) & np.isfinite(low) & np.isfinite(high))
    edge = [(line.x[i], high[i]) for i in finite] + [(line.x[i], low[i]) for i in finite[::-1]]
    points = " ".join(f"{x.percent(float(px)):.2f},{100 - y.percent(float(py)):.2f}" for px, py in edge)
    return f'<polygon class="band {line.style}" points="{points}"/>'


def line_key(style: str) -> str:
    """Return a short sample of a line for a legend."""
    return f'<svg class="key" aria-hidden="true"><line class="line {style}" x1="1" x2="27" y1="50%" y2="50%"/></svg>'


def line_chart(
    lines: Sequence[Line],
    label: str,
    tall: bool = True,
    y_holds: Sequence[float] = (),
    scrub: bool = False,
    show_x: bool = True,
) -> str:
    """Return lines over a common axis.

    Args:
        lines: at least one.
        label: what a screen reader says.
        tall: full height, with more ticks; else about half of it.
        y_holds: what the y axis holds besides the lines and their bands.
        scrub: add what `script.js` moves with the video: a cursor, a dot, and the first line's values.
        show_x: label the x axis (charts stacked on one axis label it once).
    """
    edges = [edge for line in lines if line.band for edge in line.band]
    x = axis_over(np.concatenate([line.x for line in lines]), 5, 0)
    y = axis_over(np.concatenate([*(line.y for line in lines), *edges, y_holds]), 5 if tall else 3, 0.05)
    bands = "".join(_band(line, x, y) for line in lines)
    paths = "".join(f'<path class="line {line.style}" d="{_path(line, x, y)}"/>' for line in lines)
    plot = f'<svg viewBox="0 0 100 100" preserveAspectRatio="none" overflow="visible">{bands}{paths}</svg>'
    data = ""
    if scrub:
        values = [round(float(v), 4) if math.isfinite(v) else None for v in lines[0].y]
        data = f' data-low="{y.low}" data-high="{y.high}" data-values="{json.dumps(values, allow_nan=False)}"'
        plot += (
            '<line class="cursor" x1="0" x2="0" y1="0" y2="100%"/>'
            f'<circle class="dot {lines[0].style}" cx="0" cy="100%" r="5" visibility="hidden"/>'
            '<rect class="hit" width="100%" height="100%"/>'
        )
    height = "tall" if tall else "low"
    grid = _y_ticks(y) + (_x_ticks(x) if show_x else "")
    return f'<svg class="chart {height}" role="img" aria-label="{escape(label)}"{data}>{grid}{plot}</svg>'
