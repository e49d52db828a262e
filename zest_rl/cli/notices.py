"""The warnings of the rooms below, told like a verb's own."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

from zest_rl.cli.ui import Ui
from zest_rl.errors import Notice


@contextmanager
def notices_by(ui: Ui) -> Iterator[None]:
    """Let `ui` tell each `Notice` once, which Python would print with the line of code that it comes from."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", Notice)  # whatever PYTHONWARNINGS says
        show, told = warnings.showwarning, set[str]()

        def tell(
            message: Warning | str, category: type[Warning], filename: str, lineno: int,
            file: TextIO | None = None, line: str | None = None,
        ) -> None:  # fmt: skip
            if not issubclass(category, Notice):
                show(message, category, filename, lineno, file, line)
            elif (text := str(message)) not in told:
                told.add(text)
                ui.warn(text)

        warnings.showwarning = tell
        yield
