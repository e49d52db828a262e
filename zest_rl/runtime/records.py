"""JSON of our own files → dataclasses; what is not as this package writes it is refused with the file's name."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

from zest_rl.errors import BadInput, ZestError
from zest_rl.runtime.address_space import is_out_of_memory

T = TypeVar("T")

_KINDS: Mapping[str, tuple[type, ...]] = {
    "str": (str,), "int": (int,), "bool": (bool,), "float": (float, int), "None": (type(None),),
    "tuple[float, ...]": (list, tuple),
}  # fmt: skip
"""What JSON has for the annotation of a field; fields of other types are checked by the dataclass itself."""


@contextmanager
def reading_record(path: Path, advice: str = "restore it from a copy, or make it again") -> Iterator[None]:
    """Name the file if what it holds has other keys, types or sizes than what this package writes.

    Raises:
        BadInput: anything that the block raises but what says something else than that the file is wrong, which is
            passed on: a `ZestError`, an `OSError`, and too little memory.
    """
    try:
        yield
    except (ZestError, OSError):
        raise
    except Exception as error:
        if is_out_of_memory(error):
            raise
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        raise BadInput(f"{path} is not as this package writes it ({reason}); {advice}") from error


def from_json(record: type[T], values: Mapping[str, Any]) -> T:
    """Build a flat dataclass from its fields in JSON, where lists stand for tuples.

    Raises:
        TypeError: a field is missing, unknown or of another type.
        ValueError: a number is not finite, or the dataclass refuses a value.
    """
    given = dict(values)
    for field in fields(record):  # type: ignore[arg-type]  # dataclasses have no common type
        if field.name not in given:
            continue
        value, options = given[field.name], str(field.type).split(" | ")
        if not all(option in _KINDS for option in options):
            continue
        allowed = tuple(kind for option in options for kind in _KINDS[option])
        if type(value) not in allowed:
            raise TypeError(f"{field.name} must be {field.type}, got {str(value)[:40]!r}")
        numbers = (
            value if isinstance(value, list | tuple) else [value] if "float" in options and value is not None else []
        )
        if not all(type(number) in (float, int) and math.isfinite(number) for number in numbers):
            raise ValueError(f"{field.name} must be finite, got {str(value)[:40]}")
        if isinstance(value, list):
            given[field.name] = tuple(value)
    return record(**given)
