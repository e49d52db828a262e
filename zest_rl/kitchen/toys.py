"""Toy scenes of the kitchen's tasks: simple shapes before and after, rendered as goal pictures from another domain.

No robot, no kitchen, no picture file: microwaves, cupboards and stoves of boxes and cylinders, each in several colours
and proportions and seen from several sides. They are what anybody can build or draw of a task without its scene.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import mujoco
import numpy as np

from zest_rl.kitchen.tasks import Task
from zest_rl.simulation.rendering import Camera, Canvas
from zest_rl.simulation.scene import compile_for_drawing
from zest_rl.types import Frame

_SIZE = 224
_AZIMUTHS = (70.0, 90.0, 110.0)  # degrees; 90 looks straight at the front
_ELEVATIONS = (-12.0, -28.0)
_DISTANCE = 1.3  # metres
_DEPTH = 0.2  # half the depth of a box, in metres
_THIN = 0.012  # half the thickness of a board, in metres
_GLOW = "1 .25 .05"


@dataclass(frozen=True)
class _Style:
    """Colours (red, green, blue in 0 … 1) and proportions (in metres) of one toy."""

    body: str
    door: str
    inside: str
    wall: str
    handle: str
    width: float
    """Half the width; likewise the height."""
    height: float


_STYLES = (
    _Style(".85 .85 .82", ".9 .9 .88", ".25 .22 .2", ".6 .65 .7", ".3 .3 .3", 0.30, 0.22),
    _Style(".35 .35 .38", ".2 .2 .22", ".75 .7 .55", ".85 .83 .78", ".7 .7 .7", 0.34, 0.20),
    _Style(".55 .36 .2", ".62 .42 .25", ".2 .15 .1", ".8 .8 .75", ".2 .2 .2", 0.28, 0.26),
    _Style(".7 .72 .75", ".75 .78 .8", ".15 .15 .18", ".45 .5 .45", ".15 .15 .15", 0.32, 0.24),
)


def toy_pictures(task: Task) -> tuple[tuple[Frame, ...], tuple[Frame, ...]]:
    """Render the toys of a task before and after it: two tuples of (224, 224, 3) uint8 RGB, equally long."""
    starts, goals = (tuple(f for style in _STYLES for f in _render(task.name, style, done)) for done in (False, True))
    return starts, goals


@functools.cache
def _render(task: str, style: _Style, done: bool) -> tuple[Frame, ...]:
    wall = _box((0, 0.5, 0), (3, 0.02, 3), style.wall)
    light = '<light directional="true" dir="-.2 1 -.8" diffuse=".7 .7 .7" ambient=".35 .35 .35"/>'
    body = f"<worldbody>{light}{wall}{_BUILDERS[task](style, done)}</worldbody>"
    spec = mujoco.MjSpec.from_string(f"<mujoco><visual><headlight diffuse='.3 .3 .3'/></visual>{body}</mujoco>")
    model = compile_for_drawing(spec, _SIZE)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    cameras = [Camera((0, 0, 0), _DISTANCE, azimuth, elevation) for azimuth in _AZIMUTHS for elevation in _ELEVATIONS]
    canvas = Canvas(model, tuple(camera.to_mujoco() for camera in cameras), _SIZE)
    try:
        return tuple(np.ascontiguousarray(frame) for frame in canvas.draw(data))
    finally:
        canvas.close()


# ------------------------------------------------------------------------------------------------------- MJCF of toys


def _numbers(values: Sequence[float]) -> str:
    return " ".join(f"{value:.4f}" for value in values)


def _box(at: Sequence[float], half: Sequence[float], colour: str) -> str:
    return f'<geom type="box" pos="{_numbers(at)}" size="{_numbers(half)}" rgba="{colour} 1"/>'


def _disc(at: Sequence[float], radius: float, half: float, colour: str, turn: str = "") -> str:
    return f'<geom type="cylinder" pos="{_numbers(at)}" size="{radius:.4f} {half:.4f}" rgba="{colour} 1" {turn}/>'


def _shell(style: _Style) -> str:
    """A back and four sides around the origin, open towards −y, with a shelf."""
    w, h = style.width, style.height
    return "".join((
        _box((0, _DEPTH, 0), (w, _THIN, h), style.inside),
        _box((0, 0, h), (w, _DEPTH, _THIN), style.body),
        _box((0, 0, -h), (w, _DEPTH, _THIN), style.body),
        _box((-w, 0, 0), (_THIN, _DEPTH, h), style.body),
        _box((w, 0, 0), (_THIN, _DEPTH, h), style.body),
    ))  # fmt: skip


def _hinged_door(style: _Style, side: int, done: bool, extra: str = "") -> str:
    """A door with its hinge at the left (−1) or the right (1), shut or opened by 95 degrees."""
    w, h = style.width, style.height
    angle = 95 * side if done else 0
    return (
        f'<body pos="{side * w} {-_DEPTH - _THIN} 0" euler="0 0 {angle}">'
        + _box((-side * w, 0, 0), (w, _THIN, h), style.door)
        + _box((-side * w * 1.85, -0.03, 0), (0.012, 0.02, h * 0.5), style.handle)
        + f"{extra}</body>"
    )


def _microwave(style: _Style, done: bool) -> str:
    w, h = style.width, style.height
    window = _box((w, -_THIN, 0), (w * 0.65, 0.004, h * 0.65), ".1 .1 .12")
    panel = _box((w * 1.2, 0, 0), (w * 0.2, _DEPTH, h), style.body)
    buttons = [_box((w * 1.2, -_DEPTH, h * y), (0.025, 0.008, 0.014), style.handle) for y in (0.5, 0.1, -0.3)]
    plate = _disc((0, 0, -h * 0.8), w * 0.6, 0.008, ".8 .85 .85")
    return _shell(style) + plate + panel + "".join(buttons) + _hinged_door(style, -1, done, window)


def _cupboard(side: int) -> Callable[[_Style, bool], str]:
    def build(style: _Style, done: bool) -> str:
        shelf = _box((0, 0, 0), (style.width, _DEPTH, _THIN / 2), style.body)
        cups = [
            _disc((x * style.width, 0, 0.05), 0.04, 0.05, colour)
            for x, colour in ((-0.4, ".8 .3 .2"), (0.3, ".2 .4 .7"))
        ]
        return _shell(style) + shelf + "".join(cups) + _hinged_door(style, side, done)

    return build


def _sliding_cupboard(style: _Style, done: bool) -> str:
    w, h = style.width, style.height
    x = w / 2 if done else -w / 2
    shelf = _box((0, 0, 0), (w, _DEPTH, _THIN / 2), style.body)
    cup = _disc((-0.5 * w, 0, 0.05), 0.04, 0.05, ".8 .3 .2")
    return (
        _shell(style) + shelf + cup
        + _box((w / 2, -_DEPTH, 0), (w / 2, _THIN, h), style.door)
        + _box((x, -_DEPTH - 2.5 * _THIN, 0), (w / 2, _THIN, h), style.door)
        + _box((x - w * 0.35, -_DEPTH - 0.06, 0), (0.012, 0.015, h * 0.4), style.handle)
    )  # fmt: skip


def _stove(style: _Style, done: bool) -> str:
    """A plate on top glows, and its knob is turned."""
    w = style.width
    top = _box((0, 0, -0.1), (w, 0.28, 0.02), ".12 .12 .13") + _box((0, 0, -0.3), (w, 0.27, 0.18), style.body)
    burners, knobs = [], []
    for i, (x, y) in enumerate(((-0.5, -0.13), (0.5, -0.13), (-0.5, 0.13), (0.5, 0.13))):
        is_on = done and i == 0
        burners.append(_disc((x * w, y, -0.078), 0.09, 0.006, _GLOW if is_on else ".3 .3 .32"))
        knob_x = w * (-0.6 + 0.4 * i)
        mark = _box((0, 0, 0), (0.006, 0.006, 0.03), "1 1 1")
        knobs.append(_disc((knob_x, -0.28, -0.18), 0.03, 0.02, style.handle, 'euler="90 0 0"'))
        knobs.append(f'<body pos="{_numbers((knob_x, -0.305, -0.18))}" euler="0 {50 * is_on} 0">{mark}</body>')
    return top + "".join(burners + knobs)


_BUILDERS: dict[str, Callable[[_Style, bool], str]] = {
    "knob2": _stove, "knob3": _stove, "ldoor": _cupboard(-1), "rdoor": _cupboard(1), "sdoor": _sliding_cupboard,
    "micro": _microwave,
}  # fmt: skip
"""By task: the toy's MJCF before or after."""
