"""Charts as SVG: pure functions, no styling (that is `style.css`), no units but percent of the plot.

Positions are percentages, so a chart fills whatever width it gets while text, dots and strokes keep their size; the
tick labels stand in the padding that `style.css` gives to ``svg.chart``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from zest_rl.report.content import EpisodePanel, Film, MethodRow, Scatter, Series
from zest_rl.types import FloatArray

MISSING = "–"
"""Text of a figure that is not finite."""
N_LINE_STYLES = 6
"""Line styles in `style.css`; a chart with more curves repeats them."""


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
    while len(ticks) < 2:  # a step slightly shorter than the axis may give one tick only
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


def _image(style: str, label: str, parts: Iterable[str], **data: object) -> Markup:
    """Return an SVG with a label for screen readers; `parts` are markup."""
    extra = Markup("").join(Markup(' data-{}="{}"').format(name, value) for name, value in data.items())
    head = Markup('<svg class="{}" role="img" aria-label="{}"{}>').format(style, label, extra)
    return head + Markup("".join(parts)) + Markup("</svg>")


def results_axis(rows: Sequence[MethodRow]) -> Axis:
    """Return the axis that the bars of a table share; it holds 0 % and 100 % where returns are normalized."""
    values = [v for row in rows for v in (row.mean, row.ci_low, row.ci_high, row.paper_value) if v is not None]
    return axis_over([*((0, 100) if all(row.is_normalized for row in rows) else ()), *values], 5, 0.02)


def interval_bar(row: MethodRow, axis: Axis) -> Markup:
    """Return the mean as a dot on its 95 % interval with end caps, with the paper's figure as a diamond below it."""
    parts = [f'<line class="grid" x1="{axis.percent(t):.2f}%" x2="{axis.percent(t):.2f}%" y1="0" y2="100%"/>'
             for t in axis.ticks]  # fmt: skip
    if math.isfinite(row.ci_low) and math.isfinite(row.ci_high):
        low, high = axis.percent(row.ci_low), axis.percent(row.ci_high)
        parts.append(f'<line class="ci" x1="{low:.2f}%" x2="{high:.2f}%" y1="50%" y2="50%"/>')
        parts += [f'<line class="ci" x1="{at:.2f}%" x2="{at:.2f}%" y1="30%" y2="70%"/>' for at in (low, high)]
    if math.isfinite(row.mean):
        parts.append(f'<circle class="mean" cx="{axis.percent(row.mean):.2f}%" cy="50%" r="3"/>')
    unit, digits = (" %", 1) if row.is_normalized else ("", 2)
    mean, lowest, highest = (number(value, digits) for value in (row.mean, row.ci_low, row.ci_high))
    label = f"mean {mean}{unit}, 95 % interval {lowest} to {highest}{unit}"
    if row.paper_value is not None and math.isfinite(row.paper_value):
        at = f"{axis.percent(row.paper_value):.2f}%"
        parts.append(f'<svg x="{at}" y="50%" overflow="visible"><path class="paper" d="M0 7l5 5l-5 5l-5-5Z"/></svg>')
        label += f"; the paper {number(row.paper_value, 1)} %"
    return _image(f"bar {row.kind}", label, parts)


def axis_labels(axis: Axis) -> Markup:
    """Return the tick labels above a column of `interval_bar`."""
    ticks = "".join(
        f'<text x="{axis.percent(t):.2f}%" y="1em" class="x tick">{axis.label(t)}</text>' for t in axis.ticks
    )
    return Markup(f'<svg class="bar-axis" aria-hidden="true">{ticks}</svg>')


def level_bar(score: float) -> Markup:
    """Return a bar that is filled up to `score`, from 0 to 1."""
    width = f"{100 * min(max(float(score), 0), 1):.0f}%" if math.isfinite(score) else "0"
    return Markup(f'<svg class="level"><rect width="{width}" height="100%" rx="3"/></svg>')


def correlation_gauge(value: float) -> Markup:
    """Return a correlation as a dot on a scale from −1 to 1."""
    axis = Axis(-1, 1, (-1, 0, 1))
    at, zero = axis.percent(value), axis.percent(0)
    ticks = "".join(
        f'<text class="x tick" x="{axis.percent(t):.2f}%" y="100%" dy="1em">{axis.label(t)}</text>' for t in axis.ticks
    )
    return Markup(
        '<svg class="gauge" aria-hidden="true"><line class="rail" x1="0" x2="100%" y1="50%" y2="50%"/>'
        f'<line class="ci" x1="{zero:.2f}%" x2="{at:.2f}%" y1="50%" y2="50%"/>'
        f'<line class="zero" x1="{zero:.2f}%" x2="{zero:.2f}%" y1="15%" y2="85%"/>'
        f'<circle class="mean" cx="{at:.2f}%" cy="50%" r="5"/>{ticks}</svg>'
    )


def scatter_chart(scatter: Scatter) -> Markup:
    """Return one dot per finite point, with a hover title."""
    x, y = axis_over(scatter.x[scatter.finite], 4, 0.05), axis_over(scatter.y[scatter.finite], 6, 0.05)
    dot = Markup('<circle class="point" cx="{:.2f}%" cy="{:.2f}%" r="4"><title>{} {}: {} {}, {} {}</title></circle>')
    dots = []
    for i in scatter.finite:
        across, up = float(scatter.x[i]), float(scatter.y[i])
        title = (scatter.point, i, scatter.y_name, number(up), scatter.x_name, number(across))
        dots.append(dot.format(x.percent(across), 100 - y.percent(up), *title))
    label = f"{scatter.name}: {len(dots)} {scatter.point}s, Spearman {number(scatter.spearman)}"
    return _image("chart square", label, [_x_ticks(x), _y_ticks(y), *dots])


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


def _line_path(line: Line, x: Axis, y: Axis) -> str:
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


def line_styles(n: int, first_alone: bool) -> list[str]:
    """Return the CSS classes of `n` curves; with `first_alone` all but the first are faint and alike."""
    return ["faint" if first_alone and i else f"c{i % N_LINE_STYLES}" for i in range(n)]


def line_key(style: str) -> Markup:
    """Return a short sample of a line for a legend."""
    line = f'<line class="line {style}" x1="1" x2="27" y1="50%" y2="50%"/>'
    return Markup(f'<svg class="key" aria-hidden="true">{line}</svg>')


def line_chart(
    lines: Sequence[Line],
    label: str,
    tall: bool = True,
    y_holds: Sequence[float] = (),
    scrub: bool = False,
    show_x: bool = True,
) -> Markup:
    """Return lines over a common axis.

    Args:
        lines: at least one.
        label: for screen readers.
        tall: full height, with more ticks; else about half of it.
        y_holds: values that the y axis covers besides the lines and their bands.
        scrub: add the parts that `script.js` moves with the video: a cursor, a dot, and the first line's values.
        show_x: label the x axis (charts stacked on one axis label it once).
    """
    edges = [edge for line in lines if line.band for edge in line.band]
    x = axis_over(np.concatenate([line.x for line in lines]), 5, 0)
    y = axis_over(np.concatenate([*(line.y for line in lines), *edges, y_holds]), 5 if tall else 3, 0.05)
    bands = "".join(_band(line, x, y) for line in lines)
    paths = "".join(f'<path class="line {line.style}" d="{_line_path(line, x, y)}"/>' for line in lines)
    plot = f'<svg viewBox="0 0 100 100" preserveAspectRatio="none" overflow="visible">{bands}{paths}</svg>'
    data: dict[str, object] = {}
    if scrub:
        values = [round(float(v), 4) if math.isfinite(v) else None for v in lines[0].y]
        data = {"low": y.low, "high": y.high, "values": json.dumps(values, allow_nan=False)}
        plot += (
            '<line class="cursor" x1="0" x2="0" y1="0" y2="100%"/>'
            f'<circle class="dot {lines[0].style}" cx="0" cy="100%" r="5" visibility="hidden"/>'
            '<rect class="hit" width="100%" height="100%"/>'
        )
    ticks = _y_ticks(y) + (_x_ticks(x) if show_x else "")
    return _image(f"chart {'tall' if tall else 'low'}", label, [ticks, plot], **data)


def by_quantity(curves: Iterable[Series]) -> dict[str, list[Series]]:
    """Return the curves of each chart, in the order of their first appearance."""
    quantities: dict[str, list[Series]] = {}
    for curve in curves:
        quantities.setdefault(curve.quantity, []).append(curve)
    return quantities


def curve_chart(quantity: str, curves: Sequence[Series], styles: Sequence[str]) -> Markup:
    """Return curves of one quantity, each with its band where it has one."""
    lines = [Line(c.steps, c.values, style, c.band) for c, style in zip(curves, styles, strict=True)]
    return line_chart(lines, f"{quantity} of {', '.join(curve.name for curve in curves)}")


def score_range(episodes: Iterable[EpisodePanel | Film]) -> tuple[float, float]:
    """Return the lowest and the highest finite score of all episodes; the range includes 0."""
    scores = [e.scores[np.isfinite(e.scores)] for e in episodes if e.scores is not None]
    values = np.concatenate([*scores, np.zeros(1)])
    return float(values.min()), float(values.max())


def score_chart(panel: EpisodePanel | Film, y_holds: tuple[float, float], *, show_x: bool = False) -> Markup:
    """Return the scores of an episode, on a y axis that covers `y_holds`; `show_x`: with ticks below, too."""
    assert panel.scores is not None
    label = f"ZeST score over {len(panel.scores) - 1} steps of {panel.title}"
    line = Line(np.arange(len(panel.scores), dtype=np.float32), panel.scores, "score")
    return line_chart([line], label, y_holds=y_holds, scrub=True, show_x=show_x)


def progress_chart(panel: EpisodePanel) -> Markup:
    """Return the ground-truth progress of an episode, and that of the episode beside it."""
    steps = np.arange(len(panel.gt_progress), dtype=np.float32)
    lines = [Line(steps, panel.gt_progress, "gt")]
    if panel.beside is not None:
        lines.append(Line(steps, panel.beside[1], "c1"))
    label = f"{panel.gt_name} over {len(steps) - 1} steps of {panel.title}"
    return line_chart(lines, label, tall=False, y_holds=(0, 1) if panel.is_progress else (), scrub=True)
