"""``zest --completion SHELL``: the script that completes verbs, flags, their values, recipes and datasets."""

from __future__ import annotations

import importlib
from argparse import ArgumentParser, BooleanOptionalAction
from typing import Any, Literal, get_args, get_origin

import shtab

from zest_rl.cli.arguments import arguments_of, docs_of
from zest_rl.cli.config import recipe_names
from zest_rl.cli.verbs import VERBS
from zest_rl.errors import BadInput, nearest

SHELLS = ("bash", "zsh", "fish")
DATASETS = (
    """$(sh -c 'cd "${MINARI_DATASETS_PATH:-$HOME/.minari/datasets}" 2>/dev/null && """
    """for f in */data/metadata.json */*/data/metadata.json; do [ -e "$f" ] && echo "${f%/data/*}"; done')"""
)
"""The ids of all datasets, in the words of all three shells."""


def completion(shell: str) -> str:
    """Return the script for a shell; raises `BadInput` if it is none of bash, zsh and fish."""
    if shell not in SHELLS:
        raise BadInput(f"--completion is for a shell, got {shell!r}; {nearest(shell, SHELLS)}")
    command = ArgumentParser("zest")
    command.add_argument("--version", action="version", version="", help="print the version")
    command.add_argument("--completion", choices=SHELLS, help="print a script that completes the command")
    verbs = command.add_subparsers()
    for verb, says in VERBS.items():
        module, parser = importlib.import_module(f"zest_rl.cli.{verb}"), verbs.add_parser(verb, help=says)
        if hasattr(module, "Config"):
            _add_arguments(parser, verb, module.Config)
            continue
        sub_verbs = parser.add_subparsers()
        for name, config_class in module.CONFIGS.items():
            says = (config_class.__doc__ or "").splitlines()[0]
            _add_arguments(sub_verbs.add_parser(name, help=says), f"{verb} {name}", config_class)
    return shtab.complete(command, shell)


def _add_arguments(parser: ArgumentParser, verb: str, config_class: type[Any]) -> None:
    """Tell a parser what follows a verb; it is never run."""
    docs = docs_of(config_class)
    recipes = _or_files(f"{verb.replace(' ', '_')}_recipes", " ".join(sorted(recipe_names(verb))))
    datasets = _or_files("datasets", DATASETS)
    for field, argument in arguments_of(config_class).items():
        says = docs[field].partition(". ")[0].replace("%", "%%")
        if argument.is_flag and argument.kind is bool:
            parser.add_argument(argument.name, action=BooleanOptionalAction, help=says)
            continue
        name = argument.name if argument.is_flag else field
        added: Any = parser.add_argument(name, nargs="*" if argument.n_words[-1] > 1 else None, help=says)
        if get_origin(argument.kind) is Literal:
            added.choices = get_args(argument.kind)
        elif field in ("dataset", "datasets") and verb != "collect":
            added.complete = datasets
        else:
            added.complete = recipes if argument.name == "RECIPE" else shtab.FILE
    recipe: Any = parser.add_argument("--recipe", help="defaults for the arguments")
    recipe.complete = recipes
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def _or_files(what: str, words: str) -> dict[str, Any]:
    """Return the functions of the shells that complete some words, or files."""
    name = f"_zest_{what}_or_files"
    return {
        "bash": name,
        "zsh": name,
        "fish": f"({name})",
        "preamble": {
            "bash": f'{name}() {{ compgen -W "{words}" -- "$1"; compgen -f -- "$1"; }}',
            "zsh": f"{name}() {{ compadd -- {words}; _files; }}",
            "fish": f"function {name}; printf '%s\\n' {words}; __fish_complete_path (commandline -ct); end",
        },
    }
