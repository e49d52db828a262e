"""A dataset → a run folder that is usable without it: it holds the data's facts and the scorer of their rewards."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

from zest_rl.agents.configs import config_of
from zest_rl.data.folders import CARD_FILE
from zest_rl.data.reader import Dataset, open_dataset
from zest_rl.rewards.cards import policy_card
from zest_rl.runtime import artifacts
from zest_rl.runtime.hub import REWARD_FILES, SCORER_FILE
from zest_rl.training.distributed import launched
from zest_rl.training.request import OnProgress, TrainingConfig, asked, default_run_dir, is_finished, snapshots


def train(
    agent: str,
    dataset_id: str,
    agent_config: Any = None,
    config: TrainingConfig | None = None,
    *,
    run_dir: Path | None = None,
    on_progress: OnProgress | None = None,
) -> Path:
    """Train a policy on a dataset, or go on with an interrupted run; a finished run returns at once.

    Args:
        agent: name in `zest_rl.agents.AGENTS`.
        dataset_id: Minari dataset; its rewards are the only information about quality.
        agent_config: that agent's config; default its defaults.
        config: how long and where; default the defaults of `TrainingConfig`.
        run_dir: folder of this run alone; default `zest_rl.training.request.default_run_dir`.
        on_progress: see `OnProgress`.

    Returns:
        The run's folder, which `zest_rl.evaluation.evaluate.evaluate` takes. It holds the dataset's scorer, if the
        dataset has one, so that the policy can be evaluated with online scores.

    Raises:
        BadInput: there is no such dataset, or as in `fit`.
        ZestError: a file of the dataset is damaged, or as in `fit`.
    """
    config = TrainingConfig() if config is None else config
    with open_dataset(dataset_id) as dataset:
        episodes, meta, files = dataset.episodes(), {"dataset": dataset.describe()}, scorer_files(dataset)
        agent_config = config_of(agent)() if agent_config is None else agent_config
        if getattr(agent_config, "inputs", "obs") == "embeddings":
            from zest_rl.rewards.by_learned import embeddings_of

            embeddings = embeddings_of(dataset, dataset.path / SCORER_FILE, device=config.device)
            episodes = [replace(e, obs=seen.mean(axis=1)) for e, seen in zip(episodes, embeddings, strict=True)]
    run_dir = run_dir or default_run_dir(agent, dataset_id, config.seed)
    request = asked(agent, agent_config, episodes, config)
    if launched().size > 1 or not is_finished(run_dir, request | meta):
        from zest_rl.training.loop import fit  # imports torch, which takes longer than all else for a finished run

        options: dict[str, Any] = {"meta": meta, "files": files, "on_progress": on_progress}
        fit(agent, agent_config, episodes, run_dir, config, request=request, **options)
    if launched().leads:
        for folder, (name, content) in product((run_dir, *snapshots(run_dir)), files.items()):
            if not (folder / name).exists():  # earlier versions wrote it when all else was there
                artifacts.write_bytes(folder / name, content)
        if not (run_dir / CARD_FILE).exists():
            artifacts.write_bytes(run_dir / CARD_FILE, policy_card(artifacts.read_json(run_dir / "meta.json")).encode())
    return run_dir


def scorer_files(dataset: Dataset) -> dict[str, bytes]:
    """Return the files that a run needs for online rewards: name → content; none if the dataset has no scorer."""
    names = [name for name in (SCORER_FILE, *REWARD_FILES) if (dataset.path / name).exists()]
    return {name: (dataset.path / name).read_bytes() for name in names}
