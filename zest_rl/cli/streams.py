"""The standard streams of the command."""

from __future__ import annotations

import io
import os
import select
import sys


def print_in_any_encoding() -> None:
    """Print a question mark, or on stderr an escape, for an arrow or a name that the locale cannot write."""
    for stream, errors in ((sys.stdout, "replace"), (sys.stderr, "backslashreplace")):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=errors)


def are_read() -> bool:
    """Whether nobody has closed the other ends of stdout and stderr, as ``| head`` does when it has read enough."""
    poll = select.poll()
    for handle in (1, 2):
        poll.register(handle, 0)
    return not any(event & select.POLLERR for _, event in poll.poll(0))


def drop_output() -> None:
    """Send what is still to be printed nowhere, so that Python does not complain of it at its end."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for handle in (1, 2):
        os.dup2(nowhere, handle)
