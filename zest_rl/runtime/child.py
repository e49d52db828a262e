"""One function in a child process: what kills a process there is an error here."""

from __future__ import annotations

import errno
import multiprocessing
import os
import warnings
from collections.abc import Callable
from typing import Any, TypeVar, cast

from zest_rl.errors import Notice, ZestError
from zest_rl.runtime.parallel import cause_of_death, prepare_child, starting_children

Result = TypeVar("Result")


def write_in_child(what: str, write: Callable[..., Result], *args: object) -> Result:
    """Return ``write(*args)``, called in a child process: on a full disk HDF5 kills its process. A `Notice` comes here.

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
    try:
        with starting_children():
            child.start()
        send.close()
        error, result, notices = receive.recv()
    except EOFError:
        child.join()
        error, result, notices = f"the writing process died ({cause_of_death(child.exitcode)})", None, ()
    except KeyboardInterrupt:
        if child.pid is not None:
            child.kill()  # it writes to a place that is removed now
        raise
    finally:
        if child.pid is not None:
            child.join()
    for notice in notices:
        warnings.warn(notice, Notice, stacklevel=2)
    if isinstance(error, ZestError):
        raise error
    if error is not None:
        raise ZestError(f"{what} could not be written: {error}; nothing was left behind, try again")
    return cast(Result, result)


def _report(send: Any, write: Callable[..., Any], *args: object) -> None:
    prepare_child()  # else it would go on writing to the files of the next attempt
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # on a full disk HDF5 prints hundreds of tracebacks
    error: ZestError | str | None = None
    result = None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", Notice)  # whatever PYTHONWARNINGS says
        try:
            result = write(*args)
        except ZestError as refusal:
            error = refusal
        except Exception as failure:
            full = os.strerror(errno.ENOSPC) in str(failure)
            error = "the disk is full" if full else f"{type(failure).__name__}: {failure}"
    notices = dict.fromkeys(str(warning.message) for warning in caught if issubclass(warning.category, Notice))
    send.send((error, result, list(notices)))
