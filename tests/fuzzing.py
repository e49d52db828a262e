"""Damaged inputs for readers, each read in a process of its own: a crash and a hang are outcomes like a refusal."""

from __future__ import annotations

import copy
import faulthandler
import json
import os
import random
import resource
import select
import signal
import struct
import traceback
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from zest_rl.errors import ZestError

MEMORY = 4 * 2**30
"""Bytes that reading one input may take beyond what the process holds already."""
LIMIT = 60.0
"""Seconds of processor time after which reading one input counts as a hang."""
_INTEGERS = (0, 1, -1, 2**15, 2**31 - 1, -(2**31), 2**32 - 1, 2**62, 2**63 - 1)
_VALUES: tuple[Any, ...] = (
    None, True, 0, -1, 1.5, 10**12, 10**400, float("nan"), float("inf"), "", "x", "../../etc/passwd", "/dev/zero",
    "{x.__class__}", "{:>3000000000}", "\x00", "\ud800", [], [[]], {}, {"": {}}, [None] * 3, "9" * 5000,
)  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """How a read ended: ``read``, ``refused`` (a `ZestError`), ``unexpected``, ``crashed`` or ``hung``."""

    kind: str
    detail: str
    """The repr of what was read, the message, or the end of the traceback."""


def outcome(read: Callable[[], Any]) -> Outcome:
    """Call `read` in a child process; what it returns is told by its repr, so let it return a hash of large data."""
    source, sink = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(source)
        try:
            _limit()
            kind, detail = _call(read)
            os.write(sink, json.dumps([kind, detail[-2000:]]).encode())
        finally:
            os._exit(0)
    os.close(sink)
    hung = not select.select([source], [], [], 10 * LIMIT)[0]
    if hung:
        os.kill(child, signal.SIGKILL)
    with os.fdopen(source, "rb") as pipe:
        told = pipe.read()
    _, status = os.waitpid(child, 0)
    if told:
        return Outcome(*json.loads(told))
    killed = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
    return Outcome("hung" if hung or killed == signal.SIGXCPU else "crashed", f"signal {killed}")


def _limit() -> None:
    faulthandler.disable()
    signal.signal(signal.SIGXCPU, signal.SIG_DFL)
    with open("/proc/self/statm", encoding="utf-8") as file:  # noqa: PTH123
        held = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (held + MEMORY, held + MEMORY))
    used = resource.getrusage(resource.RUSAGE_SELF)
    seconds = int(used.ru_utime + used.ru_stime + LIMIT)
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _call(read: Callable[[], Any]) -> tuple[str, str]:
    try:
        return "read", repr(read())
    except ZestError as error:
        return "refused", str(error)
    except BaseException:
        return "unexpected", traceback.format_exc()


def damaged_bytes(data: bytes, rng: random.Random) -> bytes:
    """Return `data` with one to three of: flipped bits, noise, extreme integers, holes, repeats, a missing end."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        if not changed:
            break
        at, n = rng.randrange(len(changed)), rng.choice((1, 2, 4, 8, 64, 512))
        match rng.randrange(7):
            case 0:
                changed[at] ^= 1 << rng.randrange(8)
            case 1:
                changed[at : at + n] = rng.randbytes(len(changed[at : at + n]))
            case 2:
                packed = struct.pack("<Q", rng.choice(_INTEGERS) % 2**64)[: rng.choice((1, 2, 4, 8))]
                changed[at : at + len(packed)] = packed
            case 3:
                changed[at : at + n] = bytes(len(changed[at : at + n]))
            case 4:
                changed[at:at] = changed[at : at + n]
            case 5:
                del changed[at : at + n]
            case 6:
                del changed[at:]
    return bytes(changed)


def damaged_json(value: Any, rng: random.Random) -> Any:
    """Return a copy of a JSON value of which one to three parts are removed, or are of another type or size."""
    changed = copy.deepcopy(value)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        places = list(_places(changed))
        if not places:
            return rng.choice(_VALUES)
        holder, key = rng.choice(places)
        if rng.random() < 0.2:
            del holder[key]
        else:
            holder[key] = copy.deepcopy(rng.choice(_VALUES))
    return changed


def _places(value: Any) -> Iterable[tuple[Any, Any]]:
    if isinstance(value, dict | list):
        for key in list(value) if isinstance(value, dict) else range(len(value)):
            yield value, key
            yield from _places(value[key])


def faults(outcomes: Iterable[Outcome]) -> tuple[Counter[str], list[Outcome]]:
    """Count outcomes by kind, and list those that no reader may have: unexpected, crashed, hung."""
    every = list(outcomes)
    return Counter(one.kind for one in every), [one for one in every if one.kind not in ("read", "refused")]
