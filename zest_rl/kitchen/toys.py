"""Toy scenes of the kitchen's tasks: simple shapes before and after, rendered as goal pictures from another domain.

No robot, no kitchen, no picture file: a microwave, cupboards and a stove of boxes and cylinders. What makes them work,
chosen on development data (docs/findings.md): they are seen from the front, near and far, from the heights that the
task is seen from; hinged doors open as far as it demands; cupboards stand empty in a row; a stove shows its knobs, too.
"""

from __future__ import annotations

import functools
import math
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
_FRONT = 90.0  # azimuth in degrees
_DISTANCES = (1.1, 1.3, 1.5, 1.7)  # metres
_NEAR = (0.8, 0.9, 1.0, 1.1)  # to a stove, whose knobs are small
_WIDTH, _DEPTH, _HEIGHT = 0.3, 0.2, 0.22  # half the size of a toy, in metres
_THIN = 0.012  # half the thickness of a board, in metres
_GLOW, _RED = "1 .25 .05", ".7 .05 .05"
_LIGHT = (
    '<visual><headlight diffuse=".25 .25 .25" ambient=".1 .1 .1"/></visual>',
    '<light directional="true" dir="-.2 1 -.8" diffuse=".3 .3 .3" ambient=".1 .1 .1"/>',
)


@dataclass(frozen=True)
class _Style:
    """Colours (red, green, blue in 0 … 1) of one toy and of the wall behind it."""

    body: str
    door: str
    wall: str
    handle: str = ".3 .3 .3"


_STYLES = (
    _Style(".85 .85 .82", ".9 .9 .88", ".9 .9 .9"),
    _Style(".35 .35 .38", ".3 .3 .33", ".5 .5 .5", ".7 .7 .7"),
    _Style(".55 .36 .2", ".62 .42 .25", ".85 .8 .7"),
    _Style(".6 .62 .65", ".62 .65 .68", ".45 .5 .45"),
    _Style(".4 .45 .6", ".4 .45 .6", ".15 .15 .15"),
    _Style(".6 .2 .18", ".65 .22 .2", ".9 .9 .9"),
)


def toy_pictures(task: Task) -> tuple[tuple[Frame, ...], tuple[Frame, ...]]:
    """Render the toys of a task before and after it: two tuples of (224, 224, 3) uint8 RGB, equally long."""
    starts, goals = (tuple(f for style in _STYLES for f in _render(task, style, done)) for done in (False, True))
    return starts, goals


@functools.cache
def _render(task: Task, style: _Style, done: bool) -> tuple[Frame, ...]:
    wall = _box((0, 0.5, 0), (3, 0.02, 3), style.wall)
    toy = _BUILDERS[task.name](style, task.goal if done else 0.0)
    spec = mujoco.MjSpec.from_string(f"<mujoco>{_LIGHT[0]}<worldbody>{_LIGHT[1]}{wall}{toy}</worldbody></mujoco>")
    model = compile_for_drawing(spec, _SIZE)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    distances = _NEAR if _BUILDERS[task.name] is _stove else _DISTANCES
    cameras = [Camera((0, 0, 0), distance, _FRONT, up) for distance in distances for up in task.elevations]
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


def _handle(x: float, y: float, style: _Style) -> str:
    return _box((x, y, 0), (0.012, 0.02, _HEIGHT / 2), style.handle)


def _shell(style: _Style) -> str:
    """A back and four sides around the origin, open towards the viewer (−y)."""
    return _box((0, _DEPTH, 0), (_WIDTH, _THIN, _HEIGHT), style.body) + "".join(
        _box((0, 0, sign * _HEIGHT), (_WIDTH, _DEPTH, _THIN), style.body)
        + _box((sign * _WIDTH, 0, 0), (_THIN, _DEPTH, _HEIGHT), style.body)
        for sign in (-1, 1)
    )


def _neighbours(style: _Style) -> str:
    """A closed cupboard at either side."""
    return "".join(
        _box((sign * 2.03 * _WIDTH, 0, 0), (_WIDTH, _DEPTH + _THIN, _HEIGHT), style.door)
        + _handle(sign * 1.23 * _WIDTH, -_DEPTH - 0.04, style)
        for sign in (-1, 1)
    )


def _hinged_door(style: _Style, side: int, angle: float, extra: str = "") -> str:
    """A door with its hinge at the left (−1) or the right (1), turned by `angle` (rad)."""
    return (
        f'<body pos="{side * _WIDTH} {-_DEPTH - _THIN} 0" euler="0 0 {math.degrees(angle)}">'
        + _box((-side * _WIDTH, 0, 0), (_WIDTH, _THIN, _HEIGHT), style.door)
        + _handle(-side * _WIDTH * 1.85, -0.03, style)
        + f"{extra}</body>"
    )


def _microwave(style: _Style, angle: float) -> str:
    window = _box((_WIDTH, -_THIN, 0), (_WIDTH * 0.65, 0.004, _HEIGHT * 0.65), ".05 .05 .06")
    panel = _box((_WIDTH * 1.2, 0, 0), (_WIDTH * 0.2, _DEPTH, _HEIGHT), style.body)
    for up in (0.5, 0.1, -0.3):
        panel += _box((_WIDTH * 1.2, -_DEPTH, _HEIGHT * up), (0.025, 0.008, 0.014), style.handle)
    plate = _disc((0, 0, -_HEIGHT * 0.8), _WIDTH * 0.6, 0.008, ".8 .85 .85")
    return _shell(style) + plate + panel + _hinged_door(style, -1, angle, window)


def _cupboard(side: int) -> Callable[[_Style, float], str]:
    return lambda style, angle: _neighbours(style) + _shell(style) + _hinged_door(style, side, angle)


def _sliding_cupboard(style: _Style, shift: float) -> str:
    """The left half of the front slides before the right one."""
    x, front = _WIDTH / 2, -_DEPTH - 2.5 * _THIN
    moved = x if shift else -x
    fixed = _box((x, -_DEPTH, 0), (x, _THIN, _HEIGHT), style.door)
    door = _box((moved, front, 0), (x, _THIN, _HEIGHT), style.door) + _handle(moved - 0.7 * x, -_DEPTH - 0.06, style)
    return _neighbours(style) + _shell(style) + fixed + door


def _stove(style: _Style, angle: float) -> str:
    """A knob on the panel behind the plates is turned, and the first plate glows."""
    toy = _box((0, 0, -0.3), (_WIDTH, 0.27, 0.15), style.body) + _box((0, 0.3, 0.06), (_WIDTH, 0.02, 0.17), style.door)
    toy += _box((0, 0, -0.13), (_WIDTH, 0.28, 0.02), ".12 .12 .13")
    for i, (x, y) in enumerate(((-1, -1), (-1, 1), (1, -1), (1, 1))):
        turned = angle if i == 0 else 0.0
        toy += _disc((x * 0.15, y * 0.13, -0.108), 0.09, 0.006, _GLOW if turned else ".3 .3 .32")
        at = (x * 0.08, 0.26, 0.08 + y * 0.08)
        toy += _disc(at, 0.07, 0.02, ".5 .5 .5", 'euler="90 0 0"')
        grip = _box((0, -0.025, 0), (0.01, 0.02, 0.07), style.handle)
        mark = _box((0, -0.025, 0.06), (0.016, 0.022, 0.016), _RED)
        toy += f'<body pos="{_numbers(at)}" euler="0 {math.degrees(-turned)} 0">{grip}{mark}</body>'
    return toy


_BUILDERS: dict[str, Callable[[_Style, float], str]] = {
    "knob2": _stove, "knob3": _stove, "ldoor": _cupboard(-1), "rdoor": _cupboard(1), "sdoor": _sliding_cupboard,
    "micro": _microwave,
}  # fmt: skip
"""By task: the toy's MJCF at a position of the task's joint, 0 before and `Task.goal` after it (a sliding door is shut
or open)."""
