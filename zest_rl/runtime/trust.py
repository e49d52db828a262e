"""Whom this user trusts: what data may run or load by naming it, see ``SECURITY.md``.

A dataset or a run of somebody else may name a policy or a network, and with it a program, a package or a file. It is
used only if this user named the very same on this machine (`zest adopt`, ``--embedder``, ``--env``) or trusted it by
``--trust``. What was named lies in the folder ``trusted`` of the cache, a small file each, policies by the content of
their files, embedders and functions that make environments by name: delete one to forget it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from zest_rl.errors import BadInput
from zest_rl.runtime import artifacts
from zest_rl.runtime.cache import cache_folder


def remember(kind: str, named: Any) -> None:
    """Keep that this user named it.

    Args:
        kind: ``embedder``, ``environment`` or ``policy``.
        named: all that defines it, JSON-ready.
    """
    path = _record(kind, named)
    if not path.exists():
        artifacts.write_json(path, {kind: named})


def is_remembered(kind: str, named: Any) -> bool:
    """Whether this user named it; arguments as in `remember`."""
    return _record(kind, named).exists()


def check_trusted(kind: str, named: Any, what: str) -> None:
    """Refuse to use what this user did not name.

    Args:
        kind: as in `remember`.
        named: as in `remember`.
        what: sentence on what would happen, for the message.

    Raises:
        BadInput: it was not named on this machine.
    """
    if not is_remembered(kind, named):
        shown = "".join(c if c.isprintable() else repr(c)[1:-1] for c in what)  # a terminal obeys escape sequences
        raise BadInput(
            f"{shown}. You did not name this {kind} on this machine; if you trust whoever did, add --trust (in Python "
            "trust=True), which is remembered for this very one"
        )


def _record(kind: str, named: Any) -> Path:
    return cache_folder("trusted") / f"{kind}-{artifacts.hash_json(named)}.json"
