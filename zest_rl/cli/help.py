"""What ``--help`` prints: of the command, of a verb with sub-verbs, and of a verb's arguments."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Mapping
from typing import Annotated, Any, get_type_hints

import tyro

from zest_rl.cli.arguments import arguments_of, docs_of
from zest_rl.cli.verbs import VERBS, usage

COMMON_FLAGS = """every verb also takes:
  --recipe FILE.toml  defaults for the arguments, by name; flags win; NAME alone: a recipe of the package
  --json              print the result as one JSON document on stdout"""

HELP = """usage: zest VERB [arguments]

A picture or a sentence as the reward function for offline robot learning:
goal spec + frames → embeddings → scores → relabeled dataset → trainer → policy → evaluation → report

verbs (`zest VERB --help` lists the arguments of one):
{verbs}

{common}

also: --help, --version, --completion bash|zsh|fish (docs/stages.md)

exit codes: 0 done, 1 failed, 2 bad input, 130 interrupted by Ctrl-C and 143 by SIGTERM (run the same command again to
go on; a second signal ends a command at once)

examples:
  zest doctor
  zest collect --task micro
  zest reproduce demo"""


def command_help() -> str:
    """List the verbs."""
    return HELP.format(
        verbs="\n".join(f"  {verb:<10} {summary}" for verb, summary in VERBS.items()), common=COMMON_FLAGS
    )


def sub_verb_help(verb: str, configs: Mapping[str, type[Any]]) -> str:
    """List the sub-verbs of a verb."""
    lines = [f"  {name:<10} {(config.__doc__ or '').splitlines()[0]}" for name, config in configs.items()]
    examples = [line for name in configs for line in _examples(f"{verb} {name}")[:2]]
    parts = [f"usage: zest {verb} SUB-VERB [arguments]", "", *lines, "", f"`zest {verb} SUB-VERB --help`"]
    return "\n".join([*parts, "", *dict.fromkeys(examples)])


def print_help(config_class: type[Any], verb: str, values: Mapping[str, Any]) -> None:
    """Print the help of a verb, with `values` as the defaults, and exit: what most people need, then the rest."""
    known, arguments, docs = usage(verb), arguments_of(config_class), docs_of(config_class)
    hints: dict[str, Any] = get_type_hints(config_class, include_extras=True)
    first: list[tuple[str, Any, Any]] = []
    advanced: list[tuple[str, Any, Any]] = []
    for field in dataclasses.fields(config_class):
        name, argument, default = field.name, arguments[field.name], values.get(field.name, field.default)
        hint = tyro.conf.arg(help=docs.get(name), help_behavior_hint="" if default in (None, ()) else None)
        comes_first = known is None or name in known.first or argument.is_required or not argument.is_flag
        annotated: Any = Annotated[hints[name], hint]
        (first if comes_first else advanced).append((name, annotated, dataclasses.field(default=default)))
    if advanced:
        nested = dataclasses.make_dataclass("Advanced", advanced, kw_only=True)
        first.append(("advanced", nested, dataclasses.field(default_factory=nested)))
    parts = (inspect.getdoc(config_class) or "", "\n".join(_examples(verb)), COMMON_FLAGS)
    tyro.cli(
        dataclasses.make_dataclass("Config", first, kw_only=True),
        args=["--help"],
        prog=f"zest {verb}",
        description="\n\n".join(filter(None, parts)),
        config=(tyro.conf.DisallowNone, tyro.conf.OmitArgPrefixes),
    )


def _examples(verb: str) -> list[str]:
    known = usage(verb)
    return ["examples:", *(f"  zest {verb} {words}".rstrip() for words in known.examples)] if known else []
