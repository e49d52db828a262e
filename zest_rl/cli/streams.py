"""The standard streams of the command."""

from __future__ import annotations

import io
import sys


def print_in_any_encoding() -> None:
    """Print a question mark, or on stderr an escape, for an arrow or a name that the locale cannot write."""
    for stream, errors in ((sys.stdout, "replace"), (sys.stderr, "backslashreplace")):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=errors)
