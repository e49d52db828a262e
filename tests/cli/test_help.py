"""What help says of each verb is complete, and its examples are commands that can be typed."""

from __future__ import annotations

import importlib
import shlex
from typing import Any

import pytest

from zest_rl import cli
from zest_rl.cli.arguments import arguments_of, docs_of
from zest_rl.cli.config import parse_config
from zest_rl.cli.verbs import USAGES, VERBS, usage


def configs() -> dict[str, type[Any]]:
    """All verbs with arguments, ``train dt`` and its like among them."""
    found = {}
    for verb in VERBS:
        module = importlib.import_module(f"zest_rl.cli.{verb}")
        config_class = getattr(module, "Config", None)
        subs = {verb: config_class} if config_class else {f"{verb} {sub}": c for sub, c in module.CONFIGS.items()}
        found.update(subs)
    return found


CONFIGS = configs()


@pytest.mark.parametrize("verb", CONFIGS)
def test_every_argument_of_a_verb_is_explained_and_its_examples_can_be_typed(verb: str) -> None:
    assert set(docs_of(CONFIGS[verb])) >= set(arguments_of(CONFIGS[verb]))
    known = usage(verb)
    assert known is not None
    assert set(known.first) <= set(arguments_of(CONFIGS[verb]))
    for words in known.examples:
        assert parse_config(CONFIGS[verb], shlex.split(words), verb)


def test_usages_are_of_verbs_that_there_are() -> None:
    assert {verb for verb in USAGES if verb not in CONFIGS} == {"train"}, "its algorithms share one"


def test_help_has_examples_and_lists_the_flags_of_most_people_before_the_others(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["relabel", "--help"]) == 0
    out = capsys.readouterr().out
    parts = ("zest relabel zest/", "Folder with init/", "advanced options", "--tolerance")
    places = [out.index(part) for part in parts]
    assert places == sorted(places)
    assert "None" not in out, "no default is said once, in words"
