"""Where a verb's config comes from: the defaults of its dataclass, then a recipe (TOML), then flags. Later wins."""

from __future__ import annotations

import dataclasses
import io
import os
import tomllib
import types
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

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

    candidates = [path]
    if path.parts[:1] and path.parts[0] in RECIPE_FOLDERS:
        candidates.append(shipped(path.parts[0]).joinpath(*path.parts[1:]))
    found = next((candidate for candidate in candidates if candidate.is_file()), None)
    if found is None:
        others = {other.name for candidate in candidates for other in candidate.parent.glob("*.toml")}
        raise BadInput(f"there is no recipe {path}; {nearest(path.name, others)}")
    try:
        return tomllib.loads(found.read_text(encoding="utf-8"))
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
    values, problems = _check(config_class, recipe)
    problems += [
        f"{_flag(field.name)!r} is required"
        for field in dataclasses.fields(config_class)
        if _default(field) is dataclasses.MISSING and _flag(field.name) not in map(_flag, recipe)
    ]
    _refuse(problems, source)
    try:
        return config_class(**values)
    except BadInput as error:
        raise BadInput(f"{source}: {error}") from error


def parse_config(config_class: type[C], argv: Sequence[str], verb: str) -> tuple[C, bool]:
    """Build the config of ``zest <verb> <argv>``; also tell whether ``--json`` was asked for.

    A recipe may carry ``verb = "collect"``, which must then be `verb` (``"train bc"`` for a verb with sub-verbs).

    Raises:
        BadInput: a flag or recipe key is unknown, missing or of the wrong type, or the config refuses a value.
        SystemExit: code 0, after ``--help`` was printed.
    """
    flags, recipe_path, as_json = split_common_flags(argv)
    values: dict[str, Any] = {}
    if recipe_path is not None:
        recipe = read_recipe(recipe_path)
        meant = recipe.pop("verb", verb)
        if meant != verb:
            raise BadInput(f"recipe {recipe_path} is for `zest {meant}`, not for `zest {verb}`")
        values, problems = _check(config_class, recipe)
        _refuse(problems, f"recipe {recipe_path}")
    return _parse_flags(config_class, flags, verb, values), as_json


def split_common_flags(argv: Sequence[str]) -> tuple[list[str], Path | None, bool]:
    """Take ``--recipe FILE`` and ``--json`` out of `argv`; return the rest, the recipe's path, whether JSON is wanted.

    Raises:
        BadInput: ``--recipe`` has no file.
    """
    rest: list[str] = []
    recipe: Path | None = None
    as_json = False
    words = iter(argv)
    for word in words:
        name, equals, value = word.partition("=")
        if name == "--recipe":
            value = value if equals else next(words, "")
            if not value:
                raise BadInput("--recipe needs a file: --recipe FILE.toml")
            recipe = Path(value)
        elif word == "--json":
            as_json = True
        else:
            rest.append(word)
    return rest, recipe, as_json


def _parse_flags(config_class: type[C], flags: Sequence[str], verb: str, values: Mapping[str, Any]) -> C:
    """Let tyro turn flags into a config whose defaults are `values`, and its complaints into one `BadInput`."""
    import tyro

    # Defaults in the shape that tyro wants them: an instance. It is not valid yet, so __post_init__ must not run.
    draft = object.__new__(config_class)
    for field in dataclasses.fields(config_class):
        default = values.get(field.name, _default(field))
        object.__setattr__(draft, field.name, tyro.MISSING if default is dataclasses.MISSING else default)
    description = f"{config_class.__doc__}\n\n{COMMON_FLAGS}"
    complaint = io.StringIO()
    try:
        with redirect_stderr(complaint):
            return tyro.cli(config_class, args=flags, prog=f"zest {verb}", description=description, default=draft)
    except SystemExit as stop:
        if not stop.code:
            raise
        refusal = _cause(stop)
        if refusal is not None:
            raise refusal from None
        raise BadInput(_unbox(complaint.getvalue())) from None


def _cause(error: BaseException) -> BadInput | None:
    """Return the `BadInput` of a config's ``__post_init__`` that led to tyro's exit, if one did."""
    earlier: BaseException | None = error
    while earlier is not None and not isinstance(earlier, BadInput):
        earlier = earlier.__cause__ or earlier.__context__
    return earlier


def _unbox(text: str) -> str:
    """Turn tyro's framed message into plain lines."""
    lines = [line.strip("│|").strip() for line in text.splitlines() if not line.startswith(("╭", "╰", "+"))]
    parts = " ".join(line if line.strip("─-") else "\n" for line in lines).split("\n")
    return "\n  ".join(part.strip() for part in parts)


def _check(config_class: type[Any], recipe: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return the recipe's values, converted to the types of the config's fields, and all that is wrong with it."""
    kinds = get_type_hints(config_class)
    values: dict[str, Any] = {}
    problems: list[str] = []
    for key, value in recipe.items():
        name = key.replace("-", "_")
        if name not in kinds:
            problems.append(f"unknown key {key!r}; {nearest(_flag(name), map(_flag, kinds))}")
        elif name in values:
            problems.append(f"{key!r} is given twice, with '-' and with '_'")
        else:
            try:
                values[name] = _convert(value, kinds[name])
            except TypeError:
                problems.append(f"{key!r} must be {_describe(kinds[name])}, got {value!r}")
    return values, problems


def _refuse(problems: Sequence[str], source: str) -> None:
    if problems:
        raise BadInput(f"{source}: " + "\n  ".join(problems))


def _convert(value: object, kind: Any) -> Any:
    """Convert a TOML value to the annotation `kind`; TypeError when it does not fit."""
    origin, args = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if origin is Annotated:
        return _convert(value, args[0])
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
    if origin is Annotated:
        return _describe(args[0])
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


def _flag(name: str) -> str:
    return name.replace("_", "-")


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default
