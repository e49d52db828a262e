"""How a verb talks while it works: sentences, warnings, progress. All of it goes to stderr; stdout is the result's."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING, Protocol, TextIO

if TYPE_CHECKING:
    from rich.progress import Progress

LINE_INTERVAL = 10.0
"""Seconds between two progress lines where no bar can be drawn."""


class Advance(Protocol):
    """Reports `n` more units of work; `fields` (a loss, a rate) are shown beside the progress."""

    def __call__(self, n: int = 1, **fields: object) -> None:
        """Report progress."""


class Ui(Protocol):
    """What a verb's ``run`` may say to its user."""

    def say(self, text: str) -> None:
        """Tell what is done now and where it is written."""

    def warn(self, text: str) -> None:
        """Tell what the user should know although the work goes on."""

    def progress(self, description: str, total: int) -> AbstractContextManager[Advance]:
        """Show the progress of `total` units of work for as long as the context is open; may be nested."""


class SilentUi:
    """A `Ui` that says nothing, for tests and for calling a verb from Python."""

    def say(self, text: str) -> None:
        """Say nothing."""

    def warn(self, text: str) -> None:
        """Say nothing."""

    @contextmanager
    def progress(self, description: str, total: int) -> Iterator[Advance]:
        """Show nothing."""

        def advance(n: int = 1, **fields: object) -> None:
            pass

        yield advance


class StreamUi:
    """A `Ui` on a text stream: progress bars on a terminal, a line every 10 s elsewhere."""

    def __init__(self, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self._stream = stream if stream is not None else sys.stderr
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

    @contextmanager
    def progress(self, description: str, total: int) -> Iterator[Advance]:
        """Show a bar on a terminal, else a line every 10 s and one at the end."""
        show = self._bar if self._stream.isatty() else self._lines
        with show(description, total) as advance:
            yield advance

    @contextmanager
    def _bar(self, description: str, total: int) -> Iterator[Advance]:
        outermost = self._bars is None
        bars = self._bars if self._bars is not None else _progress_bars(self._stream)
        if outermost:
            self._bars = bars
            bars.start()
        task = bars.add_task(description, total=total, fields="")
        try:
            yield lambda n=1, **fields: bars.update(task, advance=n, fields=_join(fields))
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
                extra = f", {_join(fields)}" if fields else ""
                self.say(f"{description}: {done}/{total} ({share:.0%}), {timing}{extra}")

        yield advance


@contextmanager
def progress_in_parts(ui: Ui, description: str) -> Iterator[Callable[[int, int], None]]:
    """Show progress in percent; yield a function of (parts done, parts in all) for work that tells its size late."""
    with ui.progress(description, 100) as advance:
        shown = 0

        def on_progress(done: int, total: int) -> None:
            nonlocal shown
            percent = max(shown, 100 * done // total)  # the next stage of the work starts anew
            advance(percent - shown)
            shown = percent

        yield on_progress


def _progress_bars(stream: TextIO) -> Progress:
    from rich import progress
    from rich.console import Console

    return progress.Progress(
        progress.TextColumn("{task.description}", markup=False),
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
        progress.TimeElapsedColumn(),
        progress.TimeRemainingColumn(),
        progress.TextColumn("{task.fields[fields]}", markup=False),
        console=Console(file=stream),
    )


def _join(fields: dict[str, object]) -> str:
    return ", ".join(f"{name} {v:.4g}" if isinstance(v, float) else f"{name} {v}" for name, v in fields.items())
