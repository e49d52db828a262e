"""Makes the README's moving picture from a finished `zest reproduce demo`; run by `make hero`.

On top some pictures of the goal, below on the left the episode that they score highest, and on the right its scores::

    python docs/hero.py [runs/demo [docs/images/demo.webp]]

The episode is one of the evaluation of a policy that was trained on the scores. All is read from the output folder and
from the dataset.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from zest_rl.data.provenance import DatasetRecord
from zest_rl.data.reader import dataset_path
from zest_rl.errors import BadInput
from zest_rl.evaluation.evaluate import Evaluation, read_evaluation
from zest_rl.kitchen.scene import RenderConfig, open_renderer
from zest_rl.kitchen.videos import FPS, OVERVIEW
from zest_rl.report.charts import Axis, axis_over
from zest_rl.report.content import GoalPanel
from zest_rl.report.goals import goal_panel
from zest_rl.runtime import artifacts
from zest_rl.types import FloatArray, Frame

N_PICTURES = 4
"""Pictures shown of the start, and as many of the goal."""
EPISODE = 320
"""Side of the episode's frames, in pixels; the other lengths follow."""
PICTURE, GAP = 80, 8
TOP = PICTURE + 3 * GAP + 16
PLOT = (EPISODE + 56, TOP + 36, 2 * EPISODE + 72, TOP + EPISODE - 36)
"""Left, top, right and bottom of the curve."""
SIZE = (PLOT[2] + 2 * GAP, TOP + EPISODE)
INK, PALE, CURVE = "#1f2328", "#d0d7de", "#0969da"
FINER = 2
"""The curve is drawn larger by this factor, and then made smaller, so that its edge is smooth."""
HOLD_MS = 2000
"""How long the last frame stays."""


def scored_highest(output: Path) -> tuple[Evaluation, int]:
    """Return the evaluation and the index of the episode with the highest ZeST return.

    Raises:
        BadInput: no policy in the folder was scored while it acted.
    """
    evaluations = map(read_evaluation, sorted(path.parent for path in output.glob("cells/*/evaluations/*/result.json")))
    scored = [evaluation for evaluation in evaluations if "score" in evaluation.traces]
    if not scored:
        raise BadInput(f"{output} holds no evaluation of a policy that is asked for returns; type `make demo` first")
    returns = [evaluation.traces["score"][:, 1:].sum(axis=1) for evaluation in scored]
    best = int(np.argmax([values.max() for values in returns]))
    return scored[best], int(returns[best].argmax())


def draw_background(goal: GoalPanel, axis: Axis, n_steps: int) -> Image.Image:
    """Draw what does not move: the goal's pictures and the axes, that of the scores and that of the steps."""
    image = Image.new("RGB", SIZE, "white")
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(14)
    width = N_PICTURES * PICTURE
    for name, frames, left in (("start", goal.start, 0), ("goal", goal.goal, SIZE[0] - width)):
        draw.text((left + width / 2, GAP), name, INK, font, anchor="ma")
        for k, frame in enumerate(frames[:: max(1, len(frames) // N_PICTURES)][:N_PICTURES]):
            picture = Image.fromarray(frame).resize((PICTURE - 2, PICTURE - 2), Image.Resampling.LANCZOS)
            image.paste(picture, (left + k * PICTURE + 1, GAP + 20))
    x, y = SIZE[0] // 2, GAP + 20 + PICTURE // 2
    draw.line((x - 14, y, x + 10, y), INK, 3)
    draw.polygon(((x + 16, y), (x + 6, y - 6), (x + 6, y + 6)), INK)

    x0, y0, x1, y1 = PLOT
    draw.text(((x0 + x1) / 2, y0 - 14), "ZeST score of each frame", INK, font, anchor="mb")
    draw.text(((x0 + x1) / 2, SIZE[1] + 2), "step", INK, font, anchor="mb")
    for tick in axis.ticks:
        level = y1 - (y1 - y0) * axis.percent(tick) / 100
        draw.line((x0, level, x1, level), PALE)
        draw.text((x0 - 6, level), axis.label(tick), INK, font, anchor="rm")
    for step in range(0, n_steps + 1, 25):
        draw.text((x0 + (x1 - x0) * step / n_steps, y1 + 6), str(step), INK, font, anchor="ma")
    return image


def curve_points(scores: FloatArray, axis: Axis) -> list[tuple[float, float]]:
    """Return where each of the scores (T+1,) stands, in pixels from the corner of the plot."""
    width, height = PLOT[2] - PLOT[0], PLOT[3] - PLOT[1]
    steps = len(scores) - 1
    return [(width * t / steps, height * (1 - axis.percent(float(v)) / 100)) for t, v in enumerate(scores)]


def draw_step(background: Image.Image, frame: Frame, points: list[tuple[float, float]], step: int) -> Image.Image:
    """Draw one step: its frame, the curve so far, the rest of it pale, and the cursor."""
    image = background.copy()
    image.paste(Image.fromarray(frame), (0, TOP))
    plot = image.crop(PLOT).resize([FINER * (PLOT[2] - PLOT[0]), FINER * (PLOT[3] - PLOT[1])])
    draw = ImageDraw.Draw(plot)
    large = [(FINER * x, FINER * y) for x, y in points]
    x, y = large[step]
    draw.line((x, 0, x, plot.height), PALE, FINER)
    draw.line(large, PALE, 2 * FINER)
    draw.line(large[: step + 1], CURVE, 3 * FINER, joint="curve")
    draw.circle((x, y), 5 * FINER, CURVE)
    image.paste(plot.resize([side // FINER for side in plot.size], Image.Resampling.LANCZOS), PLOT[:2])
    return image


def main(output: Path = Path("runs/demo"), path: Path = Path("docs/images/demo.webp")) -> None:
    """Write the picture, atomically."""
    evaluation, index = scored_highest(output)
    dataset = DatasetRecord.of_run(artifacts.read_json(evaluation.run / "meta.json"))
    goal = goal_panel("", dataset.relabel, dataset_path(dataset.id))
    states, scores = evaluation.traces["qpos"][index], evaluation.traces["score"][index]
    axis = axis_over([0.0, *scores], 4, 0.05)
    background, points = draw_background(goal, axis, len(scores) - 1), curve_points(scores, axis)
    with open_renderer(RenderConfig(size=EPISODE, robot=True), (OVERVIEW,)) as renderer:
        images = [draw_step(background, renderer.render(q)[0], points, t) for t, q in enumerate(states)]
    durations = [round(1000 / FPS)] * (len(images) - 1) + [HOLD_MS]
    with artifacts.atomic_path(path) as temporary:
        images[0].save(
            temporary, "WEBP", save_all=True, append_images=images[1:], duration=durations, loop=0, quality=70
        )
    print(f"{path}: {len(images)} steps of {os.path.relpath(evaluation.folder, output)}, episode {index}")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
