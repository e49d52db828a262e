"""``zest --completion bash|zsh|fish``: the script that completes verbs, flags, their values and datasets."""

from __future__ import annotations

import importlib
import shlex
from typing import Any, Literal, NamedTuple, get_args, get_origin

from zest_rl.cli.arguments import arguments_of, docs_of, hyphenated
from zest_rl.cli.config import recipe_names
from zest_rl.cli.verbs import VERBS
from zest_rl.errors import BadInput, nearest

DATASETS = (
    """$(sh -c 'cd "${MINARI_DATASETS_PATH:-$HOME/.minari/datasets}" 2>/dev/null && """
    """for f in */data/metadata.json */*/data/metadata.json; do [ -e "$f" ] && echo "${f%/data/*}"; done')"""
)
"""The ids of all datasets, in the words of all three shells."""

BASH = """_zest() {{
    local current="${{COMP_WORDS[COMP_CWORD]}}" previous="${{COMP_WORDS[COMP_CWORD-1]}}" command="${{COMP_WORDS[1]}}"
    local words=""
    case "$command" in {parents}) [ "$COMP_CWORD" -gt 2 ] && command="$command ${{COMP_WORDS[2]}}" ;; esac
    case "$COMP_CWORD:$command" in 1:*|*:-*) command="" ;; esac
    case "$command $previous" in
{values}
    *) case "$command: $current" in
{words}
        esac ;;
    esac
    COMPREPLY=($(compgen -W "$words" -- "$current"))
}}
complete -o default -F _zest zest"""

ZSH = "autoload -Uz compinit bashcompinit && compinit -u && bashcompinit\n"
"""zsh runs bash's script."""


class Flag(NamedTuple):
    """A flag of a command."""

    says: str
    values: str | None
    """Words that list its values; empty where these are files or anything, None where it takes none."""


class Command(NamedTuple):
    """A verb, with its sub-verb if it has some; or the command itself."""

    says: str
    flags: dict[str, Flag]
    words: str
    """Words that list its sub-verbs, or its positional arguments; empty where these are files."""


def completion(shell: str) -> str:
    """Return the script for a shell; raises `BadInput` if it is none of bash, zsh and fish."""
    if shell not in ("bash", "zsh", "fish"):
        raise BadInput(f"--completion is for a shell, got {shell!r}; {nearest(shell, ['bash', 'zsh', 'fish'])}")
    if shell == "fish":
        return _fish(_commands())
    return (ZSH if shell == "zsh" else "") + _bash(_commands())


def _commands() -> dict[str, Command]:
    """Return the command itself under an empty name, all verbs, and all sub-verbs as ``train dt``."""
    shells = Flag("print a script that completes the command", "bash zsh fish")
    others = {"--help": Flag("list the verbs", None), "--version": Flag("print the version", None)}
    commands = {"": Command("", {**others, "--completion": shells}, " ".join(VERBS))}
    for verb, says in VERBS.items():
        module = importlib.import_module(f"zest_rl.cli.{verb}")
        if hasattr(module, "Config"):
            commands[verb] = _command(verb, says, module.Config)
            continue
        configs = module.CONFIGS
        commands[verb] = Command(says, {"--help": Flag("list the sub-verbs", None)}, " ".join(configs))
        for name, config_class in configs.items():
            says = (config_class.__doc__ or "").splitlines()[0]
            commands[f"{verb} {name}"] = _command(f"{verb} {name}", says, config_class)
    return commands


def _command(verb: str, says: str, config_class: type[Any]) -> Command:
    docs, recipes = docs_of(config_class), " ".join(sorted(recipe_names(verb)))
    flags: dict[str, Flag] = {}
    words = ""
    for field, argument in arguments_of(config_class).items():
        values = DATASETS if field in ("dataset", "datasets") and verb != "collect" else ""
        if not argument.is_flag:
            words = recipes if argument.name == "RECIPE" else values
        elif argument.kind is bool:
            flags |= {name: Flag(docs[field], None) for name in (argument.name, f"--no-{hyphenated(field)}")}
        else:
            choices = get_args(argument.kind) if get_origin(argument.kind) is Literal else ()
            flags[argument.name] = Flag(docs[field], " ".join(choices) or values)
    common = {
        "--recipe": Flag("defaults for the arguments", recipes),
        "--json": Flag("print the result as JSON", None),
        "--help": Flag("list the arguments", None),
    }
    return Command(says, {**flags, **common}, words)


def _bash(commands: dict[str, Command]) -> str:
    parents = "|".join(dict.fromkeys(name.split()[0] for name in commands if " " in name))
    values, words = [], []
    for name, command in commands.items():
        for flag, (_, listed) in command.flags.items():
            if listed is not None:
                values.append(f'    "{name} {flag}") words="{listed}" ;;')
        words.append(f'        "{name}: "-*) words="{" ".join(command.flags)}" ;;')
        words.append(f'        "{name}: "*) words="{command.words}" ;;')
    return BASH.format(parents=parents, values="\n".join(values), words="\n".join(words))


def _fish(commands: dict[str, Command]) -> str:
    lines = []
    for name, command in commands.items():
        seen = [f"__fish_seen_subcommand_from {word}" for word in name.split()] or ["__fish_use_subcommand"]
        subs = {key.split()[-1]: sub.says for key, sub in commands.items() if key.rpartition(" ")[0] == name and key}
        if subs and name:
            seen.append(f"not __fish_seen_subcommand_from {command.words}")
        start = f"complete -c zest -n {shlex.quote('; and '.join(seen))}"
        lines += [f"{start} -f -a {sub} -d {shlex.quote(says)}" for sub, says in subs.items()]
        if command.words and not subs:
            lines.append(f"{start} -a {_fish_words(command.words)}")
        for flag, (says, values) in command.flags.items():
            line = f"{start} -l {flag.removeprefix('--')} -d {shlex.quote(says.partition('. ')[0])}"
            lines.append(line + ("" if values is None else f" -x -a {_fish_words(values)}" if values else " -r"))
    return "\n".join(lines)


def _fish_words(words: str) -> str:
    return "'" + words.removeprefix("$").replace("\\", "\\\\").replace("'", "\\'") + "'"
