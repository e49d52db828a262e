"""How large a picture may be, whatever it comes in: a file, a video or an array."""

from __future__ import annotations

from zest_rl.errors import BadInput

MAX_PIXELS = 16_000_000
"""Larger pictures are refused before they are unpacked: a file of a few kB can unpack to gigabytes."""
MAX_ASPECT = 100
"""So are longer ones: an embedder that scales the short side of 1 x 100,000 pixels to 224 would need gigabytes."""


def check_size(width: int, height: int, what: str) -> None:
    """Raise `BadInput` if a picture is too large or too long."""
    if width * height > MAX_PIXELS:
        raise BadInput(
            f"{what} is too large: {width} x {height} pixels, at most {MAX_PIXELS / 1e6:.0f} million are read; scale "
            "it down"
        )
    if max(width, height) > MAX_ASPECT * min(width, height):
        raise BadInput(
            f"{what} is too long: {width} x {height} pixels, one side may be {MAX_ASPECT} times the other; crop it"
        )
