"""Where a verb's config comes from: the defaults of its dataclass, then a recipe (TOML), then flags. Later wins."""

from __future__ import annotations

import argparse
import dataclasses
import os
import tomllib
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    NamedTuple,
    NoReturn,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveTypeInfo

from zest_rl.errors import BadInput, nearest

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

C = TypeVar("C", bound="DataclassInstance")

RECIPE_FOLDERS = ("datasets", "train", "eval")

COMMON_FLAGS = """every verb also takes:
  --recipe FILE.toml  defaults for the arguments, by name; flags win
  --json              print the result as one JSON document on stdout"""


def read_recipe(path: Path) -> dict[str, Any]:
    """Read a recipe file.

    A path is looked up from the working directory; ``eval/demo.toml`` and its like then among the recipes that come
    with the package.

    Raises:
        BadInput: there is no such file, or it is not TOML.
    """
    from zest_rl.runtime.artifacts import shipped  # brings NumPy, which `zest --help` does without

    places = [path]
    if path.parts[:1] and path.parts[0] in RECIPE_FOLDERS:
        places.append(shipped(path.parts[0]).joinpath(*path.parts[1:]))
    file = next((place for place in places if place.is_file()), None)
    if file is None:
        others = {other.name for place in places for other in place.parent.glob("*.toml")}
        raise BadInput(f"there is no recipe {path}; {nearest(path.name, others)}")
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise BadInput(f"recipe {path} is not TOML: {error}") from error


def expand_variables(path: Path) -> Path:
    """Replace ``$NAME`` by environment variables, so that a recipe may name a folder that is elsewhere for everybody.

    Raises:
        BadInput: one of them is not set.
    """
    expanded = Path(os.path.expandvars(path))
    if "$" in str(expanded) and not expanded.exists():
        raise BadInput(f"{expanded} names an environment variable that is not set; set it to where the data are")
    return expanded


def load_config(config_class: type[C], recipe: Mapping[str, Any], source: str) -> C:
    """Build a config from a recipe's table alone; `source` names the table in messages.

    Raises:
        BadInput: unknown keys, wrong types or missing required keys (the message lists all of them), or the config
            refuses a value.
    """
    values, problems = _read_table(config_class, recipe)
    given = {_hyphenated(key) for key in recipe}
    required = [_hyphenated(field) for field, argument in _arguments(config_class).items() if argument.is_required]
    problems += [f"{key!r} is required" for key in required if key not in given]
    _refuse(problems, source)
    try:
        return config_class(**values)
    except BadInput as error:
        raise BadInput(f"{source}: {error}") from error


def parse_config(config_class: type[C], argv: Sequence[str], verb: str) -> tuple[C, bool]:
    """Build the config of ``zest <verb> <argv>``; also tell whether ``--json`` was asked for.

    A recipe may carry ``verb = "collect"``, which must then be `verb` (``"train bc"`` for a verb with sub-verbs).

    Raises:
        BadInput: flags or recipe keys are unknown, missing or of the wrong type (the message lists all of them), or
            the config refuses a value.
        SystemExit: code 0, after ``--help`` was printed.
    """
    given, unknown = _split_words(config_class, argv)
    as_json, asks_for_help, recipe_path = (given.pop(flag, None) for flag in ("--json", "--help", "--recipe"))
    values: dict[str, Any] = {}
    if recipe_path == "":
        raise BadInput("--recipe needs a file: --recipe FILE.toml")
    if recipe_path is not None:
        recipe = read_recipe(Path(recipe_path))
        meant = recipe.pop("verb", verb)
        if meant != verb:
            raise BadInput(f"recipe {recipe_path} is for `zest {meant}`, not for `zest {verb}`")
        values, problems = _read_table(config_class, recipe)
        _refuse(problems, f"recipe {recipe_path}")
    if asks_for_help:
        _print_help(config_class, verb, values)
    flags, problems = _read_words(config_class, given)
    values |= flags
    required = {field: argument.name for field, argument in _arguments(config_class).items() if argument.is_required}
    problems += [f"{name} is required" for field, name in required.items() if field not in values | given]
    _refuse([*unknown, *problems], f"zest {verb}")
    return config_class(**values), bool(as_json)


class _Argument(NamedTuple):
    """A field of a config, as its user sees it."""

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
    def is_flag(self) -> bool:
        """Whether it is given by name, not by position."""
        return self.name.startswith("--")


def _arguments(config_class: type[Any]) -> dict[str, _Argument]:
    """Return a verb's arguments, by field."""
    hints = get_type_hints(config_class, include_extras=True)
    arguments = {}
    for field in dataclasses.fields(config_class):
        hint = hints[field.name]
        kind, *extras = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        placeholder = next((extra.metavar for extra in extras if hasattr(extra, "metavar")), field.name.upper())
        name = placeholder if tyro.conf.Positional in extras else f"--{_hyphenated(field.name)}"
        is_required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        arguments[field.name] = _Argument(name, kind, is_required)
    return arguments


def _print_help(config_class: type[Any], verb: str, values: Mapping[str, Any]) -> None:
    """Print the help of a verb, with `values` as the defaults, and exit."""
    hints = get_type_hints(config_class, include_extras=True)
    defaults = [(name, hints[name], dataclasses.field(default=value)) for name, value in values.items()]
    with_defaults = dataclasses.make_dataclass("Config", defaults, bases=(config_class,), frozen=True, kw_only=True)
    description = f"{config_class.__doc__}\n\n{COMMON_FLAGS}"
    tyro.cli(with_defaults, args=["--help"], prog=f"zest {verb}", description=description)


class _WordSplitter(argparse.ArgumentParser):
    """Sorts the words of a command line by the arguments that they belong to."""

    def error(self, message: str) -> NoReturn:
        """Raise instead of exiting."""
        raise BadInput(message)


def _split_words(config_class: type[Any], argv: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """Return the words that a command line gives for each field and common flag, and what those are that fit none."""
    splitter = _WordSplitter(add_help=False, allow_abbrev=False, argument_default=argparse.SUPPRESS)
    splitter.add_argument("--recipe", dest="--recipe", nargs="?", const="")
    splitter.add_argument("--json", dest="--json", action="store_true")
    splitter.add_argument("-h", "--help", dest="--help", action="store_true")
    arguments = _arguments(config_class)
    for field, argument in arguments.items():
        n_words = argument.rule.nargs
        if not argument.is_flag:
            splitter.add_argument(field, nargs="*" if n_words == "*" else "?")
        elif argument.kind is bool:
            splitter.add_argument(argument.name, dest=field, action=argparse.BooleanOptionalAction)
        else:
            splitter.add_argument(argument.name, dest=field, nargs=n_words)
    given, unknown = splitter.parse_known_intermixed_args([_with_hyphens(word) for word in argv])
    flags = [argument.name for argument in arguments.values() if argument.is_flag]
    return vars(given), [
        f"unknown flag {word!r}; {nearest(word, flags)}" if word.startswith("--") else f"unexpected {word!r}"
        for word in unknown
    ]


def _read_words(config_class: type[Any], given: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return the values that the words of `_split_words` stand for, as the help says, and what is wrong with them."""
    values: dict[str, Any] = {}
    problems: list[str] = []
    for field, words in given.items():
        argument = _arguments(config_class)[field]
        texts = words if isinstance(words, list) else [str(words)]
        try:
            values[field] = argument.rule.instance_from_str(texts)
        except ValueError:
            problems.append(f"{argument.name} must be {_describe(argument.kind)}, got {' '.join(texts)!r}")
    return values, problems


def _read_table(config_class: type[Any], recipe: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return the recipe's values, converted to the types of the config's fields, and all that is wrong with it."""
    arguments = _arguments(config_class)
    values: dict[str, Any] = {}
    problems: list[str] = []
    for key, value in recipe.items():
        field = key.replace("-", "_")
        if field not in arguments:
            problems.append(f"unknown key {key!r}; {nearest(_hyphenated(key), map(_hyphenated, arguments))}")
        elif field in values:
            problems.append(f"{key!r} is given twice, with '-' and with '_'")
        else:
            try:
                values[field] = _convert(value, arguments[field].kind)
            except TypeError:
                problems.append(f"{key!r} must be {_describe(arguments[field].kind)}, got {value!r}")
    return values, problems


def _refuse(problems: Sequence[str], source: str) -> None:
    if problems:
        raise BadInput(f"{source}: " + "\n  ".join(problems))


def _convert(value: object, kind: Any) -> Any:
    """Convert a TOML value to the annotation `kind`; TypeError when it does not fit."""
    origin, args = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if origin is dict and isinstance(value, dict):
        return {key: _convert(item, args[1]) for key, item in value.items()}
    if origin in (Union, types.UnionType):
        for option in args:
            try:
                return _convert(value, option)
            except TypeError:
                continue
    if origin is Literal and any(value == choice and type(value) is type(choice) for choice in args):
        return value
    if origin in (tuple, list) and isinstance(value, list):
        if origin is list or args[-1] is Ellipsis:
            return origin(_convert(item, args[0]) for item in value)
        if len(args) == len(value):
            return tuple(_convert(item, arg) for item, arg in zip(value, args, strict=True))
    if kind is Path and isinstance(value, str):
        return Path(value)
    if kind is float and type(value) in (int, float):
        return float(value)  # type: ignore[arg-type]  # the line above narrows to int or float
    if kind in (str, int, bool) and type(value) is kind:
        return value
    raise TypeError


def _describe(kind: Any) -> str:
    origin, args = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return " or ".join(_describe(option) for option in args if option is not type(None))
    if origin is dict:
        return "a table" if args[1] is Any else "a table of tables"
    if origin is Literal:
        return "one of " + ", ".join(repr(choice) for choice in args)
    if origin is list or (origin is tuple and args[-1] is Ellipsis):
        return f"a list of {_describe(args[0])}"
    if origin is tuple:
        return "a list [" + ", ".join(_describe(arg) for arg in args) + "]"
    return {str: "a string", Path: "a path (string)", int: "an integer", float: "a number", bool: "true or false"}[kind]


def _hyphenated(name: str) -> str:
    return name.replace("_", "-")


def _with_hyphens(word: str) -> str:
    """Spell ``--n_episodes`` as ``--n-episodes``."""
    flag, equals, value = word.partition("=")
    return _hyphenated(flag) + equals + value if word.startswith("--") else word
