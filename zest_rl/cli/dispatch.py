"""The words of a command line → a verb that is run and its result printed."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from contextlib import redirect_stdout
from types import ModuleType
from typing import Any

from zest_rl import __version__
from zest_rl.cli.config import parse_config
from zest_rl.cli.help import command_help, sub_verb_help
from zest_rl.cli.notices import notices_by
from zest_rl.cli.output import print_result
from zest_rl.cli.terminal import StreamUi
from zest_rl.cli.verbs import VERBS
from zest_rl.errors import BadInput, nearest


def dispatch(words: list[str]) -> int:
    """Run what `words` ask for, and return the exit code."""
    first, *rest = words or [""]
    if not words or first in ("-h", "--help", "help"):
        print(command_help(), file=sys.stdout if words else sys.stderr)
        return 0 if words else 2
    if first == "--version":
        print(f"zest {__version__}")
        return 0
    if first == "--completion":
        from zest_rl.cli.completion import completion

        print(completion(rest[0] if rest else ""))
        return 0
    if first.startswith("-"):
        raise BadInput(f"the verb comes first: zest VERB {first}; verbs: {', '.join(VERBS)}")
    if first not in VERBS:
        raise BadInput(f"unknown verb {first!r}; {nearest(first, VERBS)}")
    return _run_verb(importlib.import_module(f"zest_rl.cli.{first}"), first, rest)


def _run_verb(module: ModuleType, verb: str, words: list[str]) -> int:
    config_class = getattr(module, "Config", None)
    if config_class is None:
        configs: Mapping[str, type[Any]] = module.CONFIGS
        if words[:1] in (["-h"], ["--help"]):
            print(sub_verb_help(verb, configs))
            return 0
        if not words or words[0] not in configs:
            got = repr(words[0]) if words else "nothing"
            raise BadInput(
                f"`zest {verb}` needs a sub-verb first, got {got}; {nearest(words[0] if words else '', configs)}"
            )
        config_class, verb, words = configs[words[0]], f"{verb} {words[0]}", words[1:]
    config, as_json = parse_config(config_class, words, verb)
    ui = StreamUi(results=None if as_json else sys.stdout)
    with redirect_stdout(sys.stderr), notices_by(ui):  # whatever a library prints must not mix with the result
        result: dict[str, Any] = module.run(config, ui)
    if result:
        print_result(result, getattr(module, "summary", None), as_json=as_json)
    return 0 if result.get("ok", True) else 1
