"""How a verb talks while it works: sentences, warnings, progress on stderr; on stdout the parts of the result."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol


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

    def show(self, text: str) -> None:
        """Print a part of the result, for people, as soon as it is known."""

    def progress(self, description: str, total: int) -> AbstractContextManager[Advance]:
        """Show the progress of `total` units of work for as long as the context is open; may be nested."""


class SilentUi:
    """A `Ui` that says nothing, for tests and for calling a verb from Python."""

    def say(self, text: str) -> None:
        """Say nothing."""

    def warn(self, text: str) -> None:
        """Say nothing."""

    def show(self, text: str) -> None:
        """Show nothing."""

    @contextmanager
    def progress(self, description: str, total: int) -> Iterator[Advance]:
        """Show nothing."""

        def advance(n: int = 1, **fields: object) -> None:
            pass

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


def shortened(names: Sequence[str], n: int = 6) -> str:
    """Join names, all but the first `n` as a number."""
    more = [f"and {len(names) - n} more"] if len(names) > n else []
    return ", ".join([*names[:n], *more])


def joined(fields: dict[str, object]) -> str:
    """Write named figures in one line."""
    return ", ".join(f"{name} {v:.4g}" if isinstance(v, float) else f"{name} {v}" for name, v in fields.items())
