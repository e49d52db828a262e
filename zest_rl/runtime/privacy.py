"""What is published (pages, results, provenance) without folders of this machine, passwords and tokens."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

HIDDEN = "…"
_WORD_IS_PATH = re.compile(r"(?<![^=:@,])/(?!/)(?:[^,]*/)?")
"""The folders of a path that a word is, or follows ``--flag=``, ``family:`` or ``model@``; they may have spaces."""
_PATH_IN_TEXT = re.compile(r"(?<![^\s'\"(])/(?!/)(?:[^\s,'\"]*/)?")
_SECRET_FLAG = r"-{%s}[\w-]*?(?:pass(?:word|wd|phrase)?|secret|token|api[-_]?key|credentials?|auth)"
_FLAG = re.compile(_SECRET_FLAG % "1,2", re.IGNORECASE)
_SECRET_KEY = re.compile(_SECRET_FLAG % "0,2", re.IGNORECASE)
_SECRET = re.compile(
    rf"(?:(?<!\S)({_SECRET_FLAG % '0,2'}=|{_SECRET_FLAG % '1,2'}\s+)|(?<=://)(?=[^/@\s]+@))[^@\s]+", re.IGNORECASE
)
_TOKEN = re.compile(r"\b(?:hf_|gh[pousr]_|github_pat_|glpat-|sk-|xox[abprs]-|AKIA)[\w-]{10,}")


def masked(value: Any) -> Any:
    """Return a JSON-ready value whose strings name no folder and hold no secret.

    ``--goal=/home/me/goals`` becomes ``--goal=…/goals``, ``--password=x`` ``--password=…``; in a list of words, what
    follows ``--password`` is hidden, and in a mapping the value of ``password``. Keys that become equal are numbered.
    """
    if isinstance(value, str):
        return _mask_json(value) if value.startswith("{") else _mask(value)
    if isinstance(value, Mapping):
        shown: dict[Any, Any] = {}
        for key, item in value.items():
            name, n = masked(key), 1
            while name in shown:
                name, n = f"{masked(key)} ({n + 1})", n + 1
            shown[name] = HIDDEN if isinstance(key, str) and _SECRET_KEY.fullmatch(key) else masked(item)
        return shown
    if isinstance(value, list | tuple):
        flags = [isinstance(item, str) and _FLAG.fullmatch(item) is not None for item in value]
        return [HIDDEN if hide else masked(item) for hide, item in zip([False, *flags], value, strict=False)]
    return value


def _mask_json(text: str) -> str:
    """Mask what is in an object that a string holds, such as an EnvSpec; leave one without secrets as it is."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return _mask(text)
    shown = masked(value)
    return text if shown == value else json.dumps(shown, ensure_ascii=False)


def _mask(text: str) -> str:
    text = _TOKEN.sub(HIDDEN, _SECRET.sub(rf"\g<1>{HIDDEN}", text))
    if text.startswith("command:"):
        return " ".join(_WORD_IS_PATH.sub(f"{HIDDEN}/", word) for word in text.split())
    return _PATH_IN_TEXT.sub(f"{HIDDEN}/", _WORD_IS_PATH.sub(f"{HIDDEN}/", text))
