"""Ctrl-C, and SIGTERM, which clusters send before they take a machine away."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

INTERRUPTED = "interrupted; run the same command again to go on"


def exit_code(interruption: KeyboardInterrupt) -> int:
    """Return 128 plus the number of the signal, as shells have it: 130 for Ctrl-C, 143 for SIGTERM."""
    return 128 + int(*interruption.args or [signal.SIGINT])


@contextmanager
def interruptible() -> Iterator[list[int]]:
    """Raise `KeyboardInterrupt` at the first signal, and end the process at the second one, which may hit the clean-up.

    Nothing is left running then: whatever this process started ends with it. The list takes the first signal's number:
    a library that was just being imported may make another error of the exception.
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():  # others receive no signals
        yield received
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        for each in before:
            signal.signal(each, end)
        received.append(number)
        raise KeyboardInterrupt(number)

    def end(number: int, frame: FrameType | None) -> None:
        with suppress(OSError):  # nobody reads
            os.write(2, f"{INTERRUPTED}\n".encode())
        os._exit(128 + number)

    signals = (each for each in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(each) is not signal.SIG_IGN)
    before = {each: signal.getsignal(each) for each in signals}
    for each in before:
        signal.signal(each, interrupt)
    try:
        yield received
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)
