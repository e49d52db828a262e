"""Frames with a robot in view → frames without it: what a mask hides is filled from other frames of a static camera.

A pixel shows what it showed in the last frame in which it was seen, else what it will show in the first one; where it
is never seen, what it shows in the first frame of all, so that it does not change.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from zest_rl.types import Frame

Mask = NDArray[np.bool_]
"""(H, W), true where something hides the scene."""
Step = tuple[Sequence[Frame], Sequence[Mask]]
"""What V cameras show at one step, and where the scene is hidden from each."""


def first_seen(steps: Iterable[Step]) -> list[Frame]:
    """Return what each pixel shows in the first step in which it is seen: V frames (H, W, 3)."""
    shown, hidden = list[Frame](), list[Mask]()
    for frames, masks in steps:
        if not shown:
            shown, hidden = [frame.copy() for frame in frames], [mask.copy() for mask in masks]
        for view, (frame, mask) in enumerate(zip(frames, masks, strict=True)):
            now = hidden[view] & ~mask
            shown[view][now] = frame[now]
            hidden[view] &= mask
        if not any(mask.any() for mask in hidden):
            break
    return shown


def filled(steps: Iterable[Step], background: Sequence[Frame]) -> Iterator[list[Frame]]:
    """Yield V frames in which hidden pixels show what they showed last; at first, `background` (`first_seen`)."""
    shown = list(background)
    for frames, masks in steps:
        shown = [np.where(m[..., None], old, new) for m, old, new in zip(masks, shown, frames, strict=True)]
        yield shown
