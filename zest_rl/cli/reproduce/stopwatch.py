"""How long each stage of a comparison took, summed over the commands that its results took."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from zest_rl.runtime import artifacts


class Stopwatch:
    """Wall seconds by stage, written to a file after each stage, also of one that was cut short."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._before: dict[str, float] = artifacts.read_json(path) if path.exists() else {}
        self.seconds = dict(self._before)
        """By stage, of this command and those before."""

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time that the context is open to a stage."""
        started = time.monotonic()
        try:
            yield
        finally:
            self.seconds[name] = round(self.seconds.get(name, 0.0) + time.monotonic() - started, 1)
            artifacts.write_json(self._path, self.seconds)

    def discard(self) -> None:
        """Do not count this command, which found all done."""
        self.seconds = self._before
        artifacts.write_json(self._path, self.seconds)
