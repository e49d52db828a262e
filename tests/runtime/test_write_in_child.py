from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
import warnings

import pytest

from zest_rl.errors import BadInput, Notice, ZestError
from zest_rl.runtime.child import write_in_child


def add(one: int, other: int) -> int:
    return one + other


def refuse() -> None:
    raise BadInput("the rule")


def fail() -> None:
    raise ValueError("a bug")


def fill_the_disk() -> None:
    raise OSError(28, os.strerror(28))


def notice() -> None:
    warnings.warn("files are left out", Notice, stacklevel=1)


def die(number: int) -> None:
    os.kill(os.getpid(), number)
    time.sleep(60)


def test_what_is_returned_and_refused_in_the_child_arrives_here() -> None:
    assert write_in_child("the file", add, 1, 2) == 3
    with pytest.raises(BadInput, match=r"^the rule$"):
        write_in_child("the file", refuse)


def test_other_errors_of_the_child_say_what_could_not_be_written() -> None:
    with pytest.raises(ZestError, match=r"^the file could not be written: ValueError: a bug; nothing was left behind"):
        write_in_child("the file", fail)
    with pytest.raises(ZestError, match=r"^the file could not be written: the disk is full; nothing was left behind"):
        write_in_child("the file", fill_the_disk)


@pytest.mark.parametrize(
    ("number", "cause"),
    [
        (signal.SIGSEGV, "SIGSEGV: a native library crashed, such as GL, HDF5 or CUDA"),
        (signal.SIGBUS, "SIGBUS: a native library crashed"),
        (signal.SIGKILL, "SIGKILL: killed, or out of memory"),
    ],
)
def test_a_child_that_dies_is_an_error_that_names_the_signal(number: int, cause: str) -> None:
    with pytest.raises(ZestError, match=rf"^the file could not be written: the writing process died \({cause}"):
        write_in_child("the file", die, number)


def test_a_write_that_is_interrupted_as_it_starts_leaves_no_process() -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    def send() -> None:
        while not multiprocessing.active_children():
            time.sleep(0.001)
        os.kill(os.getpid(), signal.SIGTERM)

    before, sender = signal.signal(signal.SIGTERM, interrupt), threading.Thread(target=send)
    sender.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            write_in_child("the file", time.sleep, 600)
    finally:
        sender.join()
        signal.signal(signal.SIGTERM, before)
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("setting", ["ignore", "error"])
def test_notices_of_the_child_arrive_whatever_python_is_told_of_warnings(
    setting: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONWARNINGS", setting)
    monkeypatch.setattr("sys.warnoptions", [setting])  # which a child gets
    with pytest.warns(Notice, match="files are left out"):
        write_in_child("the file", notice)
