"""The frames of an episode as small JPEG pictures to look at, made when they are first asked for."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from itertools import islice

from PIL import Image

from zest_rl.runtime.gl import release_gl
from zest_rl.sources.base import EpisodeFrames, RenderedFrames
from zest_rl.types import Frame

SIDE, QUALITY = 448, 85
"""Longest side of a picture in pixels, and its quality as a JPEG."""


@contextmanager
def drawing_thread() -> Iterator[Executor]:
    """Yield a thread for all that draws or reads frames; what it is doing at the end of the context, it finishes."""
    thread = ThreadPoolExecutor(1)
    try:
        yield thread
    finally:
        thread.submit(release_gl)
        thread.shutdown(wait=False)


class Film:
    """One episode. All calls come from one thread: frames may be drawn by GL."""

    def __init__(self, frames: EpisodeFrames, episode: int) -> None:
        """Read nothing yet."""
        self._frames, self._episode = frames, episode
        self._jpegs = dict[tuple[int, int], bytes]()
        """By step and view."""
        self._n_read = 0
        self._steps: Iterator[Sequence[Frame]] | None = None

    def jpeg(self, step: int, view: int) -> bytes:
        """Return what a view shows at a step; one after the last that was recorded repeats it."""
        if (step, view) not in self._jpegs:
            if isinstance(self._frames, RenderedFrames):
                (self._jpegs[step, view],) = map(_jpeg, self._frames.at(self._episode, step, view))
            else:
                self._read_up_to(step)
        return self._jpegs[min(step, self._n_read - 1) if self._n_read else step, view]

    def _read_up_to(self, step: int) -> None:
        if self._steps is None:
            self._steps = iter(self._frames.read(self._episode))
        for frames in islice(self._steps, step + 1 - self._n_read):
            self._jpegs |= {(self._n_read, view): _jpeg(frame) for view, frame in enumerate(frames)}
            self._n_read += 1


def frames_at(frames: EpisodeFrames, episode: int, step: int) -> Sequence[Frame]:
    """Return the V frames of a step as the scorer sees them; one after the last that was recorded repeats it."""
    if isinstance(frames, RenderedFrames):
        return frames.at(episode, step)
    return list(islice(frames.read(episode), step + 1))[-1]


def _jpeg(frame: Frame) -> bytes:
    image, buffer = Image.fromarray(frame), io.BytesIO()
    image.thumbnail((SIDE, SIDE))
    image.save(buffer, "JPEG", quality=QUALITY)
    return buffer.getvalue()
