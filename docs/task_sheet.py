"""Makes the README's picture of the six tasks: each before and after, as its scores see it; run by `make hero`.

By hand::

    python docs/task_sheet.py [docs/images/tasks.webp]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from zest_rl.kitchen.scene import N_QPOS, RenderConfig, open_renderer, task_cameras
from zest_rl.kitchen.tasks import TASKS
from zest_rl.kitchen.views import scene_pair
from zest_rl.runtime import artifacts

PICTURE, GAP, TITLE = 140, 4, 22
"""Pixels: side of a picture, space between pictures, height of a name."""
N_VIEWS = 8
"""Of the ring; the picture is from the middle of those from which the object is seen."""


def main(path: Path = Path("docs/images/tasks.webp")) -> None:
    """Write the picture, atomically: a column for each task, its start above its goal."""
    cell = PICTURE + GAP
    sheet = Image.new("RGB", (len(TASKS) * cell - GAP, TITLE + 2 * cell - GAP), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(14)
    for column, (name, task) in enumerate(TASKS.items()):
        draw.text((column * cell + PICTURE / 2, 2), name, "#1f2328", font, anchor="ma")
        cameras = task_cameras(task, N_VIEWS)
        with open_renderer(RenderConfig(), (cameras[len(cameras) // 2],)) as renderer:
            for row, (frame,) in enumerate(scene_pair(renderer, np.zeros(N_QPOS), task)):
                picture = Image.fromarray(frame).resize((PICTURE, PICTURE), Image.Resampling.LANCZOS)
                sheet.paste(picture, (column * cell, TITLE + row * cell))
    with artifacts.atomic_path(path) as temporary:
        sheet.save(temporary, "WEBP", quality=85)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
