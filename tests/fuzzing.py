"""Damaged inputs for readers, each read in a process of its own: a crash and a hang are outcomes like a refusal."""

from __future__ import annotations

import copy
import faulthandler
import functools
import json
import os
import random
import resource
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
    return outcomes(lambda _: read(), 1)[0]


def outcomes(read: Callable[[int], Any], n: int) -> list[Outcome]:
    """Call `read` with 0 … n - 1 in a child process, and in another one after each that crashes or hangs."""
    ends: list[Outcome] = []
    while len(ends) < n:
        ends += _read_some(read, range(len(ends), n))
    return ends


def _read_some(read: Callable[[int], Any], inputs: range) -> list[Outcome]:
    """Read inputs until one of them ends the child process: at least one."""
    source, sink = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(source)
        try:
            memory = _held() + MEMORY
            for i in inputs:
                _limit(memory)
                kind, detail = _call(functools.partial(read, i))
                os.write(sink, json.dumps([kind, detail[-2000:]]).encode() + b"\n")
        finally:
            os._exit(0)
    os.close(sink)
    with os.fdopen(source, "rb") as pipe:
        ends = [Outcome(*json.loads(line)) for line in pipe if line.endswith(b"\n")]  # a kill may cut the last
    _, status = os.waitpid(child, 0)
    if len(ends) < len(inputs):
        killed = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
        hung = killed in (signal.SIGALRM, signal.SIGXCPU)
        ends.append(Outcome("hung" if hung else "crashed", f"signal {killed}"))
    return ends


def with_memory(n_bytes: int, read: Callable[[], Any]) -> Any:
    """Call `read` with room for so many bytes more; for a child process, as the limit stays."""
    resource.setrlimit(resource.RLIMIT_AS, (_held() + n_bytes,) * 2)
    return read()


def _held() -> int:
    """Return the address space of this process in bytes."""
    with open("/proc/self/statm") as file:  # noqa: PTH123
        return int(file.read().split()[0]) * resource.getpagesize()


def _limit(memory: int) -> None:
    faulthandler.disable()
    signal.signal(signal.SIGXCPU, signal.SIG_DFL)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(int(10 * LIMIT))
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    used = resource.getrusage(resource.RUSAGE_SELF)
    seconds = int(used.ru_utime + used.ru_stime + LIMIT)
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, resource.RLIM_INFINITY))
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
