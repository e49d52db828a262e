"""Filling what masks hide, against a loop over pixels and over time."""

from __future__ import annotations

import numpy as np
import pytest

from zest_rl.data.masks import filled, first_seen


def naive(frames: np.ndarray, masks: np.ndarray) -> np.ndarray:
    """(T, H, W, 3) frames of one view."""
    out = frames.copy()
    n_steps, height, width = masks.shape
    for y in range(height):
        for x in range(width):
            seen = [t for t in range(n_steps) if not masks[t, y, x]]
            for t in range(n_steps):
                before = [s for s in seen if s <= t]
                out[t, y, x] = frames[before[-1] if before else seen[0] if seen else 0, y, x]
    return out


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9, 1.0])
def test_a_hidden_pixel_shows_what_it_showed_last_else_what_it_shows_first(share: float) -> None:
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (2, 6, 5, 4, 3), dtype=np.uint8)  # two views
    masks = rng.random((2, 6, 5, 4)) < share
    steps = [(list(frames[:, t]), list(masks[:, t])) for t in range(6)]
    kept = frames.copy()
    shown = np.array(list(filled(steps, first_seen(steps)))).swapaxes(0, 1)
    for view in range(2):
        np.testing.assert_array_equal(shown[view], naive(frames[view], masks[view]))
    np.testing.assert_array_equal(frames, kept, "nothing is changed in place")
