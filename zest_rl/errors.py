"""The errors that a user can mend, how they name what was probably meant, and the warnings."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class ZestError(Exception):
    """Something failed although the input was valid (a full disk, a missing GL library). Exit code 1."""


class BadInput(ZestError, ValueError):
    """The input breaks a rule; the message says rule, got, expected and what to do. Exit code 2."""


class Notice(UserWarning):
    """What the user should know although the work goes on, such as files that are left out."""


def nearest(name: str, valid: Iterable[str], limit: int = 3) -> str:
    """Return ``"did you mean 'x'? valid: …"`` for a name that is not among `valid`."""
    names = sorted(valid)
    close = difflib.get_close_matches(name, names, n=limit, cutoff=0.5)
    hint = f"did you mean {' or '.join(repr(c) for c in close)}? " if close else ""
    return f"{hint}valid: {', '.join(names) if names else '(none)'}"
