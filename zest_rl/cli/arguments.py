"""The fields of a verb's config, as its user sees them."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import sys
import textwrap
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any, NamedTuple, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveTypeInfo


class Argument(NamedTuple):
    """A field of a config."""

    name: str
    """``--flag``, or the placeholder of a positional argument."""
    kind: Any
    """The field's type."""
    is_required: bool

    @property
    def rule(self) -> Any:
        """Tyro's rule for that type: how many words, and what they stand for."""
        return ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(self.kind, set()))

    @property
    def n_words(self) -> Sequence[int]:
        """How many words its value may have, in ascending order."""
        n = self.rule.nargs
        return range(sys.maxsize) if n == "*" else sorted(n) if isinstance(n, tuple) else [n]

    @property
    def is_flag(self) -> bool:
        """Whether it is given by name, not by position."""
        return self.name.startswith("--")


def arguments_of(config_class: type[Any]) -> dict[str, Argument]:
    """Return a verb's arguments, by field."""
    hints = get_type_hints(config_class, include_extras=True)
    arguments = {}
    for field in dataclasses.fields(config_class):
        hint = hints[field.name]
        kind, *extras = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        placeholder = next((extra.metavar for extra in extras if hasattr(extra, "metavar")), field.name.upper())
        name = placeholder if tyro.conf.Positional in extras else f"--{hyphenated(field.name)}"
        is_required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        arguments[field.name] = Argument(name, kind, is_required)
    return arguments


def words_of(config: Any) -> list[str]:
    """Return what a user types after the verb to get a config: whatever differs from its defaults."""
    words = list[str]()
    defaults = {field.name: field.default for field in dataclasses.fields(config)}
    for field, argument in arguments_of(type(config)).items():
        value = getattr(config, field)
        if value == defaults[field]:
            continue
        if argument.is_flag:
            words.append(f"--no-{hyphenated(field)}" if value is False else argument.name)
        if not isinstance(value, bool):
            words += map(str, value if isinstance(value, tuple) else [value])
    return words


def docs_of(config_class: type[Any]) -> dict[str, str]:
    """Return what the string below a field says, by field, in one line."""
    docs = {}
    for base in reversed(config_class.__mro__):
        try:
            body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0].body  # type: ignore[attr-defined]
        except (OSError, TypeError):  # made while the program runs, or by C
            continue
        for field, text in pairwise(body):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
                docs[ast.unparse(field.target)] = " ".join(str(text.value.value).split())
    return docs


def hyphenated(name: str) -> str:
    """Return the name that users type."""
    return name.replace("_", "-")
