"""The progress bars of a terminal."""

from __future__ import annotations

from typing import TextIO

from rich import progress
from rich.console import Console


def progress_bars(stream: TextIO) -> progress.Progress:
    """Return bars with counts, times and fields; start and stop them."""
    return progress.Progress(
        progress.TextColumn("{task.description}", markup=False),
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
        progress.TimeElapsedColumn(),
        progress.TimeRemainingColumn(),
        progress.TextColumn("{task.fields[fields]}", markup=False),
        console=Console(file=stream),
    )
