"""Report → one HTML file that needs no network and forbids it: style, script, images and videos are inside."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import io
import json
import math
from collections.abc import Iterable, Mapping
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np
from PIL import Image

from zest_rl.errors import BadInput
from zest_rl.report import charts
from zest_rl.report.charts import MISSING, Line, number
from zest_rl.report.content import (
    Curve,
    EpisodePanel,
    GoalPanel,
    Matrix,
    MethodRow,
    QualityTable,
    Report,
    Scatter,
    Strip,
)
from zest_rl.runtime import artifacts
from zest_rl.types import Frame

THUMBNAIL = 160
"""Longest side of an embedded goal image, in pixels."""
N_LINE_STYLES = 6
"""Line styles in `style.css`; a chart with more curves repeats them."""


def _data_uri(mime: str, data: bytes) -> str:
    return f"data:{mime};base64,{base64.b64encode(data).decode()}"


def _png(frame: Frame) -> str:
    image = Image.fromarray(frame)
    image.thumbnail((THUMBNAIL, THUMBNAIL), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    image.save(buffer, "PNG", optimize=True)
    return _data_uri("image/png", buffer.getvalue())


def _mp4(path: Path) -> str:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BadInput(f"cannot read the video {path}: {error.strerror}; evaluate again with videos") from error
    if data[4:8] != b"ftyp" or b"avc1" not in data:
        raise BadInput(f"{path} must be an MP4 file with H.264 video, which browsers play; encode it with libx264")
    return _data_uri("video/mp4", data)


def _percent(value: float | None) -> str:
    text = number(value, 1)
    return text if text == MISSING else f"{text}\u00a0%"


def _between(low: float, high: float, digits: int) -> str:
    return f"{number(low, digits)} to {number(high, digits)}" if math.isfinite(low + high) else MISSING


def _note(text: str) -> str:
    return f'<span class="note">{text}</span>'


def _table(rows: tuple[MethodRow, ...]) -> str:
    figures = [v for row in rows for v in (row.mean, row.ci_low, row.ci_high, row.paper_value) if v is not None]
    axis = charts.axis_over([0, 100, *figures], 5, 0.02)
    with_paper = any(row.paper_value is not None for row in rows)
    body = []
    for row in rows:
        tag = "" if row.kind == "method" else f' <span class="tag">{row.kind}</span>'
        note = _note(escape(row.note)) if row.note else ""
        paper = f'<td class="num" data-label="Paper">{_percent(row.paper_value)}</td>' if with_paper else ""
        body.append(
            f'<tr class="{row.kind}"><th scope="row">{escape(row.method)}{tag}{note}</th>'
            f'<td class="bar-cell">{charts.interval_bar(row, axis)}</td>'
            f'<td class="num mean-cell" data-label="Mean"><b>{_percent(row.mean)}</b>'
            f"{_note(_between(row.ci_low, row.ci_high, 1))}</td>{paper}"
            f'<td class="num" data-label="IQM">{_percent(row.iqm)}</td>'
            f'<td class="num" data-label="Success">{_percent(100 * row.success_rate)}</td>'
            f'<td class="num" data-label="Episodes">{row.n_episodes}'
            f"{_note(_count(row.n_seeds, 'seed'))}</td></tr>"
        )
    paper_head = '<th scope="col" class="num">Paper <i class="diamond"></i></th>' if with_paper else ""
    return (
        '<table><thead><tr><th scope="col">Method</th>'
        f'<th scope="col" class="bar-cell">Normalized return, %{charts.axis_labels(axis)}</th>'
        f'<th scope="col" class="num">Mean <span class="note">95 % interval</span></th>{paper_head}'
        '<th scope="col" class="num"><abbr title="interquartile mean">IQM</abbr></th>'
        '<th scope="col" class="num">Success</th><th scope="col" class="num">Episodes</th></tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table>"
    )


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def _goal_side(items: tuple[Frame | str, ...], which: str, name: str) -> str:
    parts = []
    for index, item in enumerate(items, 1):
        if isinstance(item, str):
            parts.append(f"<q>{escape(item)}</q>")
        else:
            parts.append(f'<img src="{_png(item)}" alt="{which} image {index} of {escape(name)}">')
    return f'<div class="side"><h4>{which.capitalize()}</h4><div class="examples">{"".join(parts)}</div></div>'


def _goal(panel: GoalPanel) -> str:
    ranking = ""
    if panel.spearman is not None and math.isfinite(panel.spearman):
        ranking = (
            f'<p class="ranking">{charts.correlation_gauge(panel.spearman)}<span><b>ρ = {number(panel.spearman)}</b> '
            f"with ground truth over {_count(panel.n_episodes, 'episode')}</span></p>"
        )
    return (
        f'<article class="card goal"><h3>{escape(panel.name)}</h3><div class="sides">'
        f"{_goal_side(panel.start, 'start', panel.name)}{_goal_side(panel.goal, 'goal', panel.name)}</div>"
        f"{ranking}</article>"
    )


def _scatter(scatter: Scatter) -> str:
    n_shown = int(np.sum(np.isfinite(scatter.zest_returns) & np.isfinite(scatter.gt_returns)))
    n_hidden = len(scatter.zest_returns) - n_shown
    ci = f" ({_between(*scatter.ci, 2)})" if scatter.ci else ""
    hidden = f", {n_hidden} without a finite return not shown" if n_hidden else ""
    upward, across = (escape(text[:1].upper() + text[1:]) for text in (scatter.upward, scatter.across))
    return (
        f'<figure class="card"><figcaption><h3>{escape(scatter.name)}</h3>'
        f'<p class="note"><b>ρ = {number(scatter.spearman)}</b>{ci}, '
        f"{escape(_count(n_shown, scatter.point))}{hidden}</p>"
        f'</figcaption><p class="axis-name upward">{upward} ↑</p>{charts.scatter_chart(scatter)}'
        f'<p class="axis-name across">{across} →</p></figure>'
    )


def _level(score: float) -> str:
    return f"{100 * min(max(score, 0), 1):.0f}%" if math.isfinite(score) else "0"


def _strip(strip: Strip) -> str:
    cells = "".join(
        f'<li><img src="{_png(frame)}" alt="step {step} of {escape(strip.title)}">'
        f'<svg class="level"><rect width="{_level(float(score))}" height="100%" rx="3"/></svg>'
        f"<b>{number(float(score))}</b>{_note(f'step {step}')}</li>"
        for frame, step, score in zip(strip.frames, strip.steps, strip.scores, strict=True)
    )
    title = f"<figcaption><h3>{escape(strip.title)}</h3></figcaption>"
    return f'<figure class="card">{title}<ol class="strip">{cells}</ol></figure>'


def _track(style: str, name: str, remark: str, chart: str) -> str:
    return (
        f'<div class="track" data-name="{name}"><p class="track-name">{charts.line_key(style)}'
        f'<span>{name} <span class="note">({remark})</span></span><span class="value"></span></p>{chart}</div>'
    )


def _episode(panel: EpisodePanel, score_range: tuple[float, float]) -> str:
    title, last = escape(panel.title), len(panel.gt_progress) - 1
    steps = np.arange(last + 1, dtype=np.float32)
    plots = []
    if panel.scores is not None:
        label = f"ZeST score over {last} steps of {panel.title}"
        chart = charts.line_chart(
            [Line(steps, panel.scores, "score")], label, y_holds=score_range, scrub=True, show_x=False
        )
        plots.append(_track("score", "ZeST score", "the reward", chart))
    label = f"Ground-truth progress over {last} steps of {panel.title}"
    lines, remark = [Line(steps, panel.gt_progress, "gt")], "evaluation only"
    if panel.beside is not None:
        name, progress = panel.beside
        lines.append(Line(steps, progress, "c1"))
        remark = f"evaluation only; {charts.line_key('c1')} {escape(name)}"
    chart = charts.line_chart(lines, label, tall=False, y_holds=(0, 1), scrub=True)
    plots.append(_track("gt", "Ground-truth progress", remark, chart))
    outcome = '<span class="tag yes">✓ success</span>' if panel.success else '<span class="tag no">✕ no success</span>'
    return (
        f'<article class="card episode"><header><h3>{title}</h3><p>{escape(panel.method)} · seed {panel.seed} · '
        f"normalized return <b>{_percent(panel.normalized_return)}</b> {outcome}</p></header>"
        f'<div class="viewer"><video controls muted playsinline preload="auto" aria-label="Video of {title}" '
        f'src="{_mp4(panel.video)}"></video>'
        '<div class="transport" hidden><button type="button">▶ Play</button><span class="step"></span></div>'
        '<p class="broken" hidden>This browser cannot play the video (H.264 in MP4).</p></div>'
        f'<div class="scrubber" role="slider" tabindex="0" aria-label="Step of {title}" aria-valuemin="0" '
        f'aria-valuemax="{last}" aria-valuenow="0" data-fps="{panel.fps}">{"".join(plots)}'
        '<p class="axis-name across">Step →</p></div></article>'
    )


def _episodes(panels: tuple[EpisodePanel, ...]) -> str:
    scores = [panel.scores[np.isfinite(panel.scores)] for panel in panels if panel.scores is not None]
    every = np.concatenate([*scores, np.zeros(1)])
    score_range = (float(every.min()), float(every.max()))
    return "".join(_episode(panel, score_range) for panel in panels)


def _curves(curves: Iterable[Curve], x_name: str, *, first_alone: bool = False) -> str:
    """Draw the curves of each quantity in one chart; with `first_alone` all but the first are faint and alike."""
    by_quantity: dict[str, list[Curve]] = {}
    for curve in curves:
        by_quantity.setdefault(curve.quantity, []).append(curve)
    figures = []
    for quantity, group in by_quantity.items():
        lines, legend = [], []
        for index, curve in enumerate(group):
            style = "faint" if first_alone and index else f"c{index % N_LINE_STYLES}"
            band = None if curve.low is None or curve.high is None else (curve.low, curve.high)
            lines.append(Line(curve.steps, curve.values, style, band))
            legend.append(f"<li>{charts.line_key(style)}{escape(curve.method)}</li>")
        chart = charts.line_chart(lines, f"{quantity} of {', '.join(c.method for c in group)}")
        figures.append(
            f'<figure class="card"><figcaption><h3>{escape(quantity)}</h3><ul class="legend">{"".join(legend)}</ul>'
            f'</figcaption>{chart}<p class="axis-name across">{x_name} →</p></figure>'
        )
    return f'<div class="grid-of">{"".join(figures)}</div>'


def _quality(table: QualityTable) -> str:
    head = "".join(f'<th scope="col" class="num">{escape(name)}</th>' for name in table.datasets)
    body = []
    for row in table.rows:
        cells = [
            f'<td class="num" data-label="{escape(name)}">'
            + (MISSING if value is None else f"<b>{number(value[0])}</b>{_note(_between(value[1], value[2], 2))}")
            + "</td>"
            for name, value in zip(table.datasets, row.values, strict=True)
        ]
        body.append(f'<tr><th scope="row">{escape(row.name)}{_note(escape(row.meaning))}</th>{"".join(cells)}</tr>')
    return _wide_table("Figure", head, body)


def _matrix(matrix: Matrix) -> str:
    head = "".join(f'<th scope="col" class="num">{escape(name)}</th>' for name in matrix.goals)
    highest = matrix.values.argmax(axis=0)
    rows = []
    for i, (name, values) in enumerate(zip(matrix.episodes, matrix.values, strict=True)):
        cells = "".join(
            f'<td class="num" data-label="{escape(goal)}">'
            + (f"<b>{number(float(value))}</b>" if highest[j] == i else number(float(value)))
            + _note(_between(float(matrix.low[i, j]), float(matrix.high[i, j]), 2))
            + "</td>"
            for j, (goal, value) in enumerate(zip(matrix.goals, values, strict=True))
        )
        rows.append(f'<tr><th scope="row">{escape(name)}</th>{cells}</tr>')
    return _wide_table("Episodes of ↓ by the goal of →", head, rows)


def _wide_table(corner: str, head: str, rows: Iterable[str]) -> str:
    return (
        f'<div class="wide"><table><thead><tr><th scope="col">{corner}</th>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _list(items: Iterable[str]) -> str:
    return f'<ul class="caveats">{"".join(f"<li>{escape(item)}</li>" for item in items)}</ul>'


def _plain(value: object) -> object:
    """Return `value` as JSON can hold it, with "–" for figures that are not finite."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _plain({f.name: getattr(value, f.name) for f in dataclasses.fields(value)})
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return MISSING
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def _details(details: Mapping[str, object]) -> str:
    blocks = []
    for name, value in details.items():
        text = json.dumps(_plain(value), indent=2, ensure_ascii=False, allow_nan=False)
        blocks.append(f"<details><summary>{escape(name)}</summary><pre>{escape(text)}</pre></details>")
    return "".join(blocks)


def _sections(report: Report) -> list[tuple[str, str, str]]:
    """Return (heading, what a reader must know to read it, body) of every section that is not empty."""
    sections = []
    if report.table:
        intro = "100 % is the expert, 0 % is the robot that does nothing. Lines are 95 % bootstrap intervals."
        sections.append(("Results", intro, _table(report.table)))
    if report.sections:
        intro = "Each task on its own; its page has the goals, the episodes' videos and all settings."
        body = "".join(
            f'<h3><a href="{escape(section.page)}">{escape(section.title)}</a></h3>{_table(section.table)}'
            for section in report.sections
        )
        sections.append(("Tasks", intro, body))
    if report.caveats:
        sections.append(("Caveats", "", _list(report.caveats)))
    if report.warnings:
        sections.append(("Warnings", "What speaks against training on these rewards.", _list(report.warnings)))
    if report.quality:
        intro = "Small figures are 95 % bootstrap intervals over episodes. Ground truth judges a reward, it makes none."
        sections.append(("Reward quality", intro, _quality(report.quality)))
    if report.matrix:
        intro = "Mean score of where episodes end; a goal should score those of its own task highest (bold: highest)."
        sections.append(("Tasks against goals", intro, _matrix(report.matrix)))
    if report.goals:
        intro = "What the reward was told: the state at the start and the state wanted. ρ is the Spearman correlation."
        sections.append(("Goals", intro, f'<div class="grid-of">{"".join(map(_goal, report.goals))}</div>'))
    if report.scatters:
        intro = "One dot is one episode. A reward worth training on ranks episodes as ground truth does."
        body = f'<div class="small grid-of">{"".join(map(_scatter, report.scatters))}</div>'
        sections.append(("Ranking", intro, body))
    if report.strips:
        intro = "Frames of one episode; below, their score between the lowest (0) and the highest (1)."
        sections.append(("Frames", intro, "".join(map(_strip, report.strips))))
    if report.views:
        intro = "The same episode by all views together, which is the reward, and by each view alone."
        sections.append(("Views", intro, _curves(report.views, "Step", first_alone=True)))
    if report.pixels:
        intro = "One dot is one step of that episode: a score worth training on is not the amount of change."
        body = f'<div class="small grid-of">{"".join(map(_scatter, report.pixels))}</div>'
        sections.append(("Pixels", intro, body))
    if report.scores_over_time:
        intro = "Mean score at each step: a reward worth training on parts successes from failures."
        sections.append(("Scores over time", intro, _curves(report.scores_over_time, "Step")))
    if report.sub_goals:
        intro = "Each frame against each sub-goal: the lines should rise one after another."
        sections.append(("Sub-goals", intro, _curves(report.sub_goals, "Step")))
    if report.episodes:
        intro = "Drag in a chart, or focus it and press the arrow keys, to move through the video; space plays."
        sections.append(("Episodes", intro, _episodes(report.episodes)))
    if report.curves:
        intro = "Lines are means over seeds; a band, where there is one, is their spread."
        sections.append(("Learning curves", intro, _curves(report.curves, "Gradient step")))
    if report.details:
        intro = "Everything needed to make these figures again."
        sections.append(("Details", intro, _details(report.details)))
    return sections


def _policy(style: str, script: str) -> str:
    """Return the Content-Security-Policy: nothing is loaded, and only our own style and script run."""

    def sha256(text: str) -> str:
        return "'sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() + "'"

    return (
        f"default-src 'none'; img-src data:; media-src data:; style-src {sha256(style)}; script-src {sha256(script)}; "
        "base-uri 'none'; form-action 'none'"
    )


def render_html(report: Report) -> str:
    """Return the report as one HTML page; it reads nothing but the videos that the episodes name.

    Raises:
        BadInput: a video cannot be read or is not H.264 in MP4.
    """
    assets = files("zest_rl.report")
    style, script, template = (
        (assets / name).read_text("utf-8") for name in ("style.css", "script.js", "template.html")
    )
    links, bodies = [], []
    for heading, intro, body in _sections(report):
        anchor = heading.lower().replace(" ", "-")
        lead = f'<p class="intro">{intro}</p>' if intro else ""
        links.append(f'<a href="#{anchor}">{heading}</a>')
        bodies.append(f'<section id="{anchor}"><h2>{heading}</h2>{lead}{body}</section>')
    return Template(template).substitute(
        policy=_policy(style, script),
        title=escape(report.title),
        summary=escape(report.summary_sentence),
        nav=f'<nav aria-label="Sections">{"".join(links)}</nav>' if links else "",
        sections="\n".join(bodies),
        style=style,
        script=script,
    )


def write_report(report: Report, path: Path) -> Path:
    """Write the report atomically and return its path.

    Raises:
        BadInput: a video cannot be read or is not H.264 in MP4.
        ZestError: the folder cannot be written to.
    """
    artifacts.write_bytes(path, render_html(report).encode())
    return path
