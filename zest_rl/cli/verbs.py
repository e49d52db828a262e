"""The verbs of ``zest``; of each, the flags that most people need and an example or two."""

from __future__ import annotations

from typing import NamedTuple

VERBS = {
    "doctor": "check versions, rendering, weights and disk; say how to fix each",
    "collect": "an expert with noise → a Minari dataset",
    "goal": "an episode or a video → goal pictures: its first and last frame, as the scorer sees them",
    "relabel": "a dataset and a goal (pictures or sentences) → a dataset with ZeST rewards",
    "inspect": "a relabeled dataset → what its rewards are worth, before anything is trained on them",
    "curate": "a relabeled dataset → which episodes to drop, why, and a dataset without them",
    "explore": "a dataset → a local page: drop pictures on it, see all episodes scored at once",
    "select": "datasets and a goal → does the goal find its frames (`goals`), `actions`, real `footage`?",
    "follow": "an episode that reaches several goals → its similarity to each of them over time",
    "export": "a dataset → a file that other offline-RL code reads",
    "train": "a dataset → a policy; `zest train --help` lists the algorithms",
    "adopt": "a policy that another program trained → a run folder, as `train` leaves one",
    "evaluate": "a policy → returns and success in MuJoCo, with videos",
    "reproduce": "a recipe → a whole table or figure, cell by cell; rerun it to resume",
    "report": "results → one HTML file",
    "push": "a dataset or a policy → the Hugging Face Hub",
}


class Usage(NamedTuple):
    """How most people use a verb."""

    first: tuple[str, ...]
    """The fields that help lists before the advanced ones."""
    examples: tuple[str, ...]
    """What may follow ``zest VERB``."""


USAGES = {
    "doctor": Usage((), ("", "--json")),
    "collect": Usage(("task", "n_episodes", "seed", "dataset"), ("--task micro", "--recipe mixed --task sdoor")),
    "goal": Usage(("episode", "output"), ("zest/kitchen-micro-noisy-v0 --episode 3", "door.mp4 --output door/")),
    "relabel": Usage(
        ("goal", "frames", "embedder", "preview"),
        (
            "zest/kitchen-micro-noisy-v0 --goal same-scene",
            "door/mine-v0 --frames observations/image --goal pictures/",
            "door/mine-v0 --frames observations/image --goal pictures/ --preview seen.png",
        ),
    ),
    "inspect": Usage(("output",), ("zest/kitchen-micro-noisy-zest-0a1b2c3d-v0",)),
    "curate": Usage(
        ("keep", "dry_run", "source"),
        ("zest/kitchen-micro-noisy-zest-0a1b2c3d-v0 --dry-run", "zest/cups-zest-0a1b2c3d-v0 --source cups/ --keep 0.9"),
    ),
    "explore": Usage(
        ("goal", "frames", "embedder", "port", "browser"),
        ("zest/kitchen-micro-noisy-v0", "door/mine-v0 --frames observations/image --goal pictures/"),
    ),
    "select goals": Usage(
        ("task", "goal", "embedder", "top", "context"), ("zest/kitchen-micro-noisy-v0 --goal same-scene",)
    ),
    "select actions": Usage(
        ("task", "goal", "embedder", "top"), ("zest/kitchen-micro-noisy-v0 zest/kitchen-sdoor-noisy-v0 --goal toys",)
    ),
    "select footage": Usage(
        ("goals", "ask", "pool", "embedder", "top"), ("clips/", "clips/ --goals rendered/ --pool all")
    ),
    "follow kitchen": Usage(("goal", "output"), ("sdoor knob3 micro",)),
    "follow video": Usage(
        ("goals", "embedder", "output"),
        ("dinner.mp4 --goals cupboard_open.png cup_out.png", "dinner.mp4 --goals cupboard/ cup/ --output dinner.html"),
    ),
    "export": Usage(("to", "output"), ("zest/kitchen-micro-noisy-v0 --to d3rlpy",)),
    "train": Usage(
        ("n_updates", "batch_size", "seed", "device", "run_dir"),
        ("zest/kitchen-micro-noisy-v0", "zest/kitchen-micro-noisy-v0 --n-updates 2000 --seed 1"),
    ),
    **{
        f"train {agent}": Usage(
            ("n_steps", "reward", "from_scratch", "seed", "run_dir"),
            (
                "zest/kitchen-micro-noisy-zest-0a1b2c3d-v0",
                f"zest/kitchen-micro-noisy-zest-0a1b2c3d-v0 --reward truth --n-steps {n_steps}",
            ),
        )
        for agent, n_steps in (("sac", 5000), ("ppo", 10000), ("trpo", 10000))
    },
    "adopt": Usage(
        ("dataset", "name", "run_dir"), ('torchscript:iql.pt --dataset zest/kitchen-micro-noisy-v0 --name "IQL, mine"',)
    ),
    "evaluate": Usage(
        ("n_episodes", "seed", "env", "videos"),
        ("runs/kitchen-micro-noisy-v0-bc-seed0", "runs/kitchen-micro-noisy-v0-bc-seed0 --n-episodes 20 --no-videos"),
    ),
    "reproduce": Usage(("output", "n_workers"), ("demo", "eval/table1_quick.toml --output runs/mine")),
    "report": Usage(("output", "title"), ("runs/bc-seed0 runs/bc-seed1 runs/dt-seed0 runs/dt-seed1",)),
    "push": Usage(
        ("private", "dry_run"),
        ("zest/kitchen-micro-noisy-zest-0a1b2c3d-v0 me/zest --dry-run", "runs/dt-seed0 me/micro-dt --private"),
    ),
}
"""By the verb, with its sub-verb where their flags differ."""


def usage(verb: str) -> Usage | None:
    """Return how most people use ``zest VERB``, if that is known."""
    return USAGES.get(verb, USAGES.get(verb.split()[0]))
