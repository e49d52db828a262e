"""The verbs of ``zest``, and the help that lists them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from zest_rl.cli.config import COMMON_FLAGS

VERBS = {
    "doctor": "check versions, rendering, weights and disk; say how to fix each",
    "collect": "an expert with noise → a Minari dataset",
    "goal": "an episode or a video → goal pictures: its first and last frame, as the scorer sees them",
    "relabel": "a dataset and a goal (pictures or sentences) → a dataset with ZeST rewards",
    "inspect": "a relabeled dataset → what its rewards are worth, before anything is trained on them",
    "select": "datasets and a goal → does the goal find its frames (`goals`), `actions`, real `footage`?",
    "follow": "an episode that reaches several goals → its similarity to each of them over time",
    "export": "a dataset → a file that other offline-RL code reads",
    "train": "a dataset → a policy, by `bc` or `dt`",
    "adopt": "a policy that another program trained → a run folder, as `train` leaves one",
    "evaluate": "a policy → returns and success in MuJoCo, with videos",
    "reproduce": "a recipe → a whole table or figure, cell by cell; rerun it to resume",
    "report": "results → one HTML file",
}

HELP = """usage: zest VERB [arguments]

A picture or a sentence as the reward function for offline robot learning:
goal spec + frames → embeddings → scores → relabeled dataset → trainer → policy → evaluation → report

verbs (`zest VERB --help` lists the arguments of one):
{verbs}

{common}

also: --help, --version

exit codes: 0 done, 1 failed, 2 bad input, 130 interrupted by Ctrl-C and 143 by SIGTERM (run the same command again to
go on; a second signal ends a command at once)

examples:
  zest doctor
  zest collect --task micro
  zest reproduce eval/demo.toml""".format(
    verbs="\n".join(f"  {verb:<10} {summary}" for verb, summary in VERBS.items()), common=COMMON_FLAGS
)


def sub_verb_help(verb: str, configs: Mapping[str, type[Any]]) -> str:
    """List the sub-verbs of a verb."""
    lines = [f"  {name:<10} {(config.__doc__ or '').splitlines()[0]}" for name, config in configs.items()]
    return "\n".join([f"usage: zest {verb} SUB-VERB [arguments]", "", *lines, "", f"`zest {verb} SUB-VERB --help`"])
