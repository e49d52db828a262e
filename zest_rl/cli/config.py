"""Where a verb's config comes from: the defaults of its dataclass, then a recipe (TOML), then flags. Later wins."""

from __future__ import annotations

import os
import tomllib
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Any,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
)

from zest_rl.cli.arguments import Argument, arguments_of, hyphenated
from zest_rl.cli.help import print_help
from zest_rl.errors import BadInput, nearest

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

C = TypeVar("C", bound="DataclassInstance")

RECIPE_FOLDERS = ("datasets", "train", "eval")


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
    except (ValueError, RecursionError) as error:
        raise BadInput(f"recipe {path} is not TOML: {error}") from error


def recipe_path(given: Path, verb: str) -> Path:
    """Return the path of a recipe that may be given by name: ``demo`` of `zest reproduce` is ``eval/demo.toml``.

    Raises:
        BadInput: no recipe of that name comes with the package.
    """
    if len(given.parts) != 1 or given.suffix or given.is_file():
        return given
    folder, names = _recipe_folder(verb), recipe_names(verb)
    if given.name not in names:
        raise BadInput(f"there is no recipe {given} in {folder}; {nearest(given.name, names)}")
    return Path(folder, f"{given}.toml")


def recipe_names(verb: str) -> set[str]:
    """Return the names of the recipes of a verb that are here or come with the package."""
    from zest_rl.runtime.artifacts import shipped

    folder = _recipe_folder(verb)
    return {path.stem for place in (Path(folder), shipped(folder)) for path in place.glob("*.toml")}


def _recipe_folder(verb: str) -> str:
    return {"collect": "datasets", "train": "train"}.get(verb.split()[0], "eval")


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
    given = {hyphenated(key) for key in recipe}
    required = [hyphenated(field) for field, argument in arguments_of(config_class).items() if argument.is_required]
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
    given, problems, last = _split_words(config_class, argv)
    as_json, asks_for_help, recipe_words = (given.pop(flag, None) for flag in ("--json", "--help", "--recipe"))
    values: dict[str, Any] = {}
    if recipe_words is not None:
        if not any(recipe_words):
            _refuse([*problems, "--recipe needs a file: --recipe FILE.toml"], f"zest {verb}")
        path = recipe_path(Path(recipe_words[0]), verb)
        recipe = read_recipe(path)
        meant = recipe.pop("verb", verb)
        if meant != verb:
            raise BadInput(f"recipe {path} is for `zest {meant}`, not for `zest {verb}`")
        values, recipe_problems = _read_table(config_class, recipe)
        _refuse(recipe_problems, f"recipe {path}")
    if asks_for_help is not None:
        print_help(config_class, verb, values)
    arguments = arguments_of(config_class)
    missing = [field for field, argument in arguments.items() if argument.is_required and field not in values | given]
    positional = next((field for field in missing if not arguments[field].is_flag), None)
    if positional is not None and last in arguments and arguments[last].rule.nargs == "*":
        given[positional] = [given[last].pop()]  # `--frames a b DATASET`: the list took one word too many
        missing.remove(positional)
    flags, wrong = _read_words(config_class, given)
    wrong += [f"{arguments[field].name} is required{_taker(arguments[field], arguments, given)}" for field in missing]
    _refuse([*problems, *wrong], f"zest {verb}")
    return config_class(**values | flags), as_json is not None


class _Words(NamedTuple):
    """The words of a command line."""

    given: dict[str, list[str]]
    """By the field, or the common flag, that they are values of."""
    problems: list[str]
    """What is wrong with those that are of none."""
    last: str
    """What the last value was taken for; empty if it stands by itself."""


def _split_words(config_class: type[Any], argv: Sequence[str]) -> _Words:
    """Sort the words of a command line by the arguments that they belong to; after ``--``, all are positional."""
    arguments = arguments_of(config_class)
    flags: dict[str, tuple[str, int, list[str]]] = {  # what is given, by how many words at most, and which if by none
        "--recipe": ("--recipe", 1, []),
        "--json": ("--json", 0, []),
        "--help": ("--help", 0, []),
        "-h": ("--help", 0, []),
    }
    for field, argument in arguments.items():
        if argument.is_flag and argument.kind is bool:
            flags[argument.name] = field, 0, ["True"]
            flags[f"--no-{hyphenated(field)}"] = field, 0, ["False"]
        elif argument.is_flag:
            flags[argument.name] = field, argument.n_words[-1], []
    given: dict[str, list[str]] = {}
    problems: list[str] = []
    positional: list[str] = []
    key, room, last = "", 0, ""
    for i, word in enumerate(argv):
        if word == "--":
            positional += argv[i + 1 :]
            break
        if not _is_flag(word):
            last = key if room else ""
            (given[key] if room else positional).append(word)
            room = max(room - 1, 0)
            continue
        name, equals, value = word.partition("=")
        name, room = hyphenated(name), 0
        if name not in flags:
            names = [argument.name for argument in arguments.values() if argument.is_flag]
            problems.append(f"unknown flag {name!r}; {nearest(name, names)}")
            continue
        key, room, words = flags[name]
        given[key] = [*words]
        if equals and not room:
            problems.append(f"{name} takes no value, got {value!r}; write {name} alone")
        elif equals:
            given[key], room = [value], 0
    for field, argument in arguments.items():
        if positional and not argument.is_flag:
            n_words = argument.n_words[-1]
            given[field], positional = positional[:n_words], positional[n_words:]
    return _Words(given, [*problems, *(f"unexpected {word!r}" for word in positional)], last)


def _taker(missing: Argument, arguments: Mapping[str, Argument], given: Mapping[str, Sequence[str]]) -> str:
    """Name the flags whose lists may have taken the word of a missing positional argument."""
    lists = [
        f"{arguments[field].name} took {' '.join(given[field])!r}"
        for field in given
        if field in arguments and arguments[field].is_flag and arguments[field].rule.nargs == "*" and given[field]
    ]
    if missing.is_flag or not lists:
        return ""
    return f": {', '.join(lists)}; write {missing.name} before the flags"


def _is_flag(word: str) -> bool:
    """Whether a word names a flag: it starts with a hyphen, and is no negative number and no sentence."""
    try:
        float(word)
    except ValueError:
        return word.startswith("-") and word != "-" and " " not in word.partition("=")[0]
    return False


def _read_words(config_class: type[Any], given: Mapping[str, Sequence[str]]) -> tuple[dict[str, Any], list[str]]:
    """Return the values that the words of `_split_words` stand for, as the help says, and what is wrong with them."""
    values: dict[str, Any] = {}
    problems: list[str] = []
    for field, words in given.items():
        argument = arguments_of(config_class)[field]
        try:
            if len(words) not in argument.n_words:
                raise ValueError
            values[field] = argument.rule.instance_from_str([*words])
        except ValueError:
            got = repr(" ".join(words)) if words else "nothing; write it after the flag"
            problems.append(f"{argument.name} must be {_describe(argument.kind)}, got {got}")
    return values, problems


def _read_table(config_class: type[Any], recipe: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return the recipe's values, converted to the types of the config's fields, and all that is wrong with it."""
    arguments = arguments_of(config_class)
    values: dict[str, Any] = {}
    problems: list[str] = []
    for key, value in recipe.items():
        field = key.replace("-", "_")
        if field not in arguments:
            problems.append(f"unknown key {key!r}; {nearest(hyphenated(key), map(hyphenated, arguments))}")
        elif field in values:
            problems.append(f"{key!r} is given twice, with '-' and with '_'")
        else:
            try:
                values[field] = _convert(value, arguments[field].kind)
            except (TypeError, OverflowError):
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
