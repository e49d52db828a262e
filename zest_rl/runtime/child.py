"""One function in a child process: what kills a process there is an error here."""

from __future__ import annotations

import errno
import multiprocessing
import os
from collections.abc import Callable
from typing import Any, TypeVar, cast

from zest_rl.errors import ZestError
from zest_rl.runtime.parallel import cause_of_death, die_with_parent, starting_children

Result = TypeVar("Result")


def write_in_child(what: str, write: Callable[..., Result], *args: object) -> Result:
    """Return ``write(*args)``, called in a child process: on a full disk HDF5 kills its process.

    Args:
        what: is written, for messages: "the dataset".
        write: a module-level function that writes to a temporary place; result and arguments are picklable.
        args: its arguments.

    Raises:
        ZestError: as raised by `write`; or it failed otherwise, or the process died.
    """
    context = multiprocessing.get_context("spawn")
    receive, send = context.Pipe(duplex=False)
    child = context.Process(target=_report, args=(send, write, *args))
    with starting_children():
        child.start()
    send.close()
    try:
        error, result = receive.recv()
    except EOFError:
        child.join()
        error, result = f"the writing process died ({cause_of_death(child.exitcode)})", None
    except KeyboardInterrupt:
        child.kill()  # it writes to a place that is removed now
        raise
    finally:
        child.join()
    if isinstance(error, ZestError):
        raise error
    if error is not None:
        raise ZestError(f"{what} could not be written: {error}; nothing was left behind, try again")
    return cast(Result, result)


def _report(send: Any, write: Callable[..., Any], *args: object) -> None:
    die_with_parent()  # else it would go on writing to the files of the next attempt
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # on a full disk HDF5 prints hundreds of tracebacks
    try:
        result = write(*args)
    except ZestError as error:
        send.send((error, None))
    except Exception as error:
        full = os.strerror(errno.ENOSPC) in str(error)
        send.send(("the disk is full" if full else f"{type(error).__name__}: {error}", None))
    else:
        send.send((None, result))
