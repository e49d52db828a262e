"""JSON of our own files → dataclasses; what is not as this package writes it is refused with the file's name."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from zest_rl.errors import BadInput, ZestError
from zest_rl.runtime.address_space import is_out_of_memory

T = TypeVar("T")


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
        TypeError: a field is missing, unknown, of another type, or a number that is not finite.
        ValueError: the dataclass refuses a value.
    """
    given = dict(values)
    return record(**{**given, **field_values(record, given)})


def field_values(record: type[Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values in JSON that a dataclass has fields for, with tuples for lists where the field is a tuple.

    Raises:
        TypeError: one is not of its field's type, or not finite.
    """
    known = {name: (values[name], hint) for name, hint in get_type_hints(record).items() if name in values}
    for name, (value, hint) in known.items():
        if not _fits(value, hint):
            raise TypeError(f"{name} must be {getattr(hint, '__name__', hint)}, got {value!r:.80}")
    return {
        name: tuple(value) if isinstance(value, list) and _fits((), hint) else value
        for name, (value, hint) in known.items()
    }


def _fits(value: Any, hint: Any) -> bool:
    """Whether a JSON value is of the type of a field, or what is made into it."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is UnionType:
        return any(_fits(value, part) for part in parts)
    if origin is Literal:
        return value in parts
    if origin is tuple:
        return isinstance(value, list | tuple) and all(_fits(item, parts[0]) for item in value)
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
    return isinstance(value, origin or hint) and not (hint is int and isinstance(value, bool))
