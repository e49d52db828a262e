"""Progress bars on a terminal, a line every now and then elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO

from zest_rl.cli.ui import Advance, joined

if TYPE_CHECKING:
    from rich.progress import Progress

LINE_INTERVAL = 10.0
"""Seconds between two progress lines where no bar can be drawn."""


class StreamUi:
    """A `Ui` on a text stream: progress bars on a terminal, a line every 10 s elsewhere."""

    def __init__(
        self,
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
        *,
        results: TextIO | None = None,
    ) -> None:
        """Talk on `stream` (default stderr), and show parts of the result on `results`; None: nowhere, as for JSON."""
        self._stream, self._results = stream if stream is not None else sys.stderr, results
        self._clock = clock
        self._bars: Progress | None = None

    def say(self, text: str) -> None:
        """Print a line, above the bars when some are shown."""
        if self._bars is not None:
            self._bars.console.print(text, markup=False, highlight=False, soft_wrap=True)
        else:
            print(text, file=self._stream, flush=True)

    def warn(self, text: str) -> None:
        """Print a line that starts with ``warning:``."""
        self.say(f"warning: {text}")

    def show(self, text: str) -> None:
        """Print a line of the result at once."""
        if self._results is not None:
            print(text, file=self._results, flush=True)

    @contextmanager
    def progress(self, description: str, total: int) -> Iterator[Advance]:
        """Show a bar on a terminal, else a line every 10 s and one at the end."""
        with (self._bar if self._stream.isatty() else self._lines)(description, total) as advance:
            yield advance

    @contextmanager
    def _bar(self, description: str, total: int) -> Iterator[Advance]:
        from zest_rl.cli.bars import progress_bars  # rich is needed on a terminal alone

        outermost, bars = self._bars is None, self._bars or progress_bars(self._stream)
        if outermost:
            self._bars = bars
            bars.start()
        task = bars.add_task(description, total=total, fields="")
        try:
            yield lambda n=1, **fields: bars.update(task, advance=n, fields=joined(fields))
        finally:
            if outermost:
                bars.stop()
                self._bars = None
            else:
                bars.remove_task(task)

    @contextmanager
    def _lines(self, description: str, total: int) -> Iterator[Advance]:
        start = last = self._clock()
        done = 0

        def advance(n: int = 1, **fields: object) -> None:
            nonlocal done, last
            done += n
            now = self._clock()
            if now - last >= LINE_INTERVAL or done == total:
                last = now
                share = done / total if total else 1.0
                left = (now - start) * (total - done) / done if done else 0.0
                timing = f"{now - start:.0f} s" + (f", about {left:.0f} s left" if done < total else "")
                extra = f", {joined(fields)}" if fields else ""
                self.say(f"{description}: {done}/{total} ({share:.0%}), {timing}{extra}")

        yield advance
