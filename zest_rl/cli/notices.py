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
    """Let `ui` tell each `Notice`, which Python would print with the line of code that it comes from."""
    with warnings.catch_warnings():
        show = warnings.showwarning

        def tell(
            message: Warning | str, category: type[Warning], filename: str, lineno: int,
            file: TextIO | None = None, line: str | None = None,
        ) -> None:  # fmt: skip
            if issubclass(category, Notice):
                ui.warn(str(message))
            else:
                show(message, category, filename, lineno, file, line)

        warnings.showwarning = tell
        yield
