"""Report → one HTML file that neither needs nor allows a network: style, script, images and videos are embedded.

The templates escape all values but our own `Markup`.
"""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import io
import json
import math
import re
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from PIL import Image

from zest_rl.errors import BadInput
from zest_rl.report import charts
from zest_rl.report.charts import MISSING, number
from zest_rl.report.sections import Report
from zest_rl.runtime import artifacts
from zest_rl.runtime.privacy import masked
from zest_rl.types import Frame

_CODE = re.compile(r"`([^`]+)`")
_MARKS = (
    (re.compile(r"\[([^\]]+)\]\((https?://[^)\s]+)\)"), r'<a href="\2">\1</a>'),
    (re.compile(r"\[([^\]]+)\]\([^)\s]+\)"), r"\1"),
    (re.compile(r"\*\*(?=\S)(.+?)(?<=\S)\*\*"), r"<strong>\1</strong>"),
    (re.compile(r"\*(?=\S)(.+?)(?<=\S)\*"), r"<em>\1</em>"),
)
"""Of Markdown, what may stand in a sentence."""
THUMBNAIL = 160
"""Longest side of an embedded goal image, in pixels."""


def render_html(report: Report) -> str:
    """Return the report as one HTML page; only the videos of the episodes are read from disk.

    Raises:
        BadInput: a video cannot be read or is not H.264 in MP4.
    """
    environment = Environment(
        loader=PackageLoader("zest_rl.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals |= {"charts": charts, "interval": _interval, "missing": MISSING}
    environment.filters |= {
        "number": number,
        "percent": _percent,
        "returned": lambda value, is_normalized: _percent(value) if is_normalized else number(value),
        "counted": _counted,
        "markdown": _markdown,
        "png": _png,
        "mp4": _mp4,
        "json": _json,
        "sha256": _sha256,
    }
    environment.tests["finite"] = lambda value: value is not None and math.isfinite(value)
    style, script = (
        Markup((files("zest_rl.report") / name).read_text(encoding="utf-8")) for name in ("style.css", "script.js")
    )
    return environment.get_template("page.html").render(
        title=report.title,
        summary=report.summary.replace(" %", "\u00a0%"),
        sections=[section for section in report.sections if section.items],
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


def _percent(value: float | None) -> str:
    text = number(value, 1)
    return text if text == MISSING else f"{text}\u00a0%"


def _interval(low: float, high: float, digits: int) -> str:
    return f"{number(low, digits)} to {number(high, digits)}" if math.isfinite(low + high) else MISSING


def _counted(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def _markdown(text: str) -> Markup:
    """Return a sentence with its code, links to the web and emphasis as HTML; other links are their text alone."""
    parts = _CODE.split(text)
    for i, part in enumerate(parts):
        safe = str(escape(part))
        if i % 2:
            parts[i] = f"<code>{safe}</code>"
            continue
        for pattern, replacement in _MARKS:
            safe = pattern.sub(replacement, safe)
        parts[i] = safe
    return Markup("".join(parts))


def _data_uri(mime: str, data: bytes) -> str:
    return f"data:{mime};base64,{base64.b64encode(data).decode()}"


def _png(frame: Frame) -> str:
    image = Image.fromarray(frame)
    image.thumbnail((THUMBNAIL, THUMBNAIL), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    image.save(buffer, "PNG", optimize=True)
    return _data_uri("image/png", buffer.getvalue())


def _mp4(video: Path | bytes) -> str:
    return _data_uri("video/mp4", video if isinstance(video, bytes) else _read_mp4(video))


def _read_mp4(path: Path) -> bytes:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BadInput(f"cannot read the video {path}: {error.strerror}; evaluate again with videos") from error
    if data[4:8] != b"ftyp" or b"avc1" not in data:
        raise BadInput(f"{path} must be an MP4 file with H.264 video, which browsers play; encode it with libx264")
    return data


def _sha256(text: str) -> str:
    """Return the hash that names a style or a script in a Content-Security-Policy."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _json(value: object) -> str:
    return json.dumps(masked(_plain(value)), indent=2, ensure_ascii=False, allow_nan=False)


def _plain(value: object) -> object:
    """Convert `value` to JSON types, with "–" for numbers that are not finite."""
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
