"""A dataset, its environment and a reward → a run folder, as `zest_rl.training.loop` draws it.

Beside what is drawn there, an unfinished run holds ``start/``, the behaviour cloning that the policy starts from, and
``checkpoint.npz``; and a run with ``reward="trex"`` keeps the reward that it learned from in ``reward/``.

A killed run goes on from its checkpoint: networks, optimizers, replayed steps and counts are restored. Episodes start
anew there, and random numbers are drawn from the seed and the steps done, so its result is as good as that of an
uninterrupted run, but not the same.
"""

from __future__ import annotations

import importlib.util
import random
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from zest_rl.agents.configs import START, OnlineConfig, config_of
from zest_rl.data.folders import CARD_FILE
from zest_rl.data.reader import Dataset, open_dataset
from zest_rl.errors import BadInput
from zest_rl.evaluation.environments import find_environment
from zest_rl.online.rewards import OnlineReward, learned_reward, own_reward
from zest_rl.rewards.cards import policy_card
from zest_rl.runtime import artifacts
from zest_rl.training.request import (
    OnProgress,
    RunConfig,
    TrainingConfig,
    check_request,
    data_sha256,
    default_run_dir,
    is_finished,
)
from zest_rl.training.runs import scorer_files
from zest_rl.training.runs import train as train_on_data
from zest_rl.types import Episode

TREX_UPDATES = 500
"""Gradient steps of the T-REX that is trained on the way; its accuracy on held-out pairs rises until about 400."""


def train(
    agent: str,
    dataset_id: str,
    agent_config: OnlineConfig | None = None,
    config: RunConfig | None = None,
    *,
    run_dir: Path | None = None,
    on_progress: OnProgress | None = None,
) -> Path:
    """Train a policy in the environment of a dataset, or go on with an interrupted run; a finished run returns at once.

    Args:
        agent: sac, ppo or trpo.
        dataset_id: Minari dataset; its environment, its scorer and its episodes are learned from.
        agent_config: that agent's config; default its defaults.
        config: where, and what is kept.
        run_dir: folder of this run alone; default `zest_rl.training.request.default_run_dir`.
        on_progress: called after every logged row.

    Returns:
        The run's folder, which `zest_rl.evaluation.evaluate.evaluate` takes.

    Raises:
        BadInput: stable-baselines3 is not installed, there is no such dataset, its environment cannot be made, new
            states have no such reward, or `run_dir` holds another run.
        ZestError: a reward is not finite, a checkpoint is damaged, or the folder cannot be written to.
    """
    for package in ("stable_baselines3", "sb3_contrib"):
        if importlib.util.find_spec(package) is None:
            raise BadInput(f"`zest train {agent}` needs {package}: pip install 'zest-rl[rl]'")
    config = RunConfig() if config is None else config
    agent_config = config_of(agent)() if agent_config is None else agent_config
    assert isinstance(agent_config, OnlineConfig)
    run_dir = run_dir or default_run_dir(agent, dataset_id, config.seed)
    with open_dataset(dataset_id) as dataset:
        if agent_config.reward == "truth" and not dataset.record.has_recorded_rewards:
            source = dataset.record.source_id
            own = replace(agent_config, reward="own")
            return train(agent, source, own, config, run_dir=run_dir, on_progress=on_progress)
        episodes = dataset.episodes()
        request = {
            "agent": agent,
            "config": asdict(agent_config),
            "seed": config.seed,
            "device": None if config.device == "auto" else config.device,
            "threads": config.threads,
            "snapshot_every": config.snapshot_every,
            "precision": "fp32",
            "data_sha256": data_sha256(episodes),
            "dataset": dataset.describe(),
        }
        if not is_finished(run_dir, request):
            _learn(dataset, episodes, request, agent_config, config, run_dir, on_progress)
    return run_dir


def _learn(
    dataset: Dataset,
    episodes: Sequence[Episode],
    request: Mapping[str, Any],
    agent_config: OnlineConfig,
    config: RunConfig,
    run_dir: Path,
    on_progress: OnProgress | None,
) -> None:
    """Learn what is asked for; only this imports torch and stable-baselines3, which take longer than a finished run."""
    import torch

    from zest_rl.agents.base import describe_data
    from zest_rl.online.learning import CHECKPOINT, Plan, learn
    from zest_rl.training.loop import torch_set_up, training_device

    facts, device = describe_data(episodes), training_device(config.device)
    threads = torch.get_num_threads() if config.threads is None else config.threads
    request = {**request, "device": str(device), "threads": threads}
    described = request | asdict(facts)
    environment = find_environment(described)
    if agent_config.reward != "trex":  # refused before anything is written
        reward = reward_of(agent_config.reward, dataset, episodes)
    with artifacts.lock(run_dir):
        check_request(run_dir, request)
        if (run_dir / "meta.json").exists():
            return
        with torch_set_up(config.seed, threads, device), _random_numbers_kept():
            on_data = TrainingConfig(seed=config.seed, device=config.device, threads=threads)
            if agent_config.reward == "trex":
                ranking = replace(on_data, n_updates=TREX_UPDATES)
                trex = train_on_data("trex", dataset.id, None, ranking, run_dir=run_dir / "reward")
                reward = learned_reward(trex, dataset, episodes)
            if not agent_config.from_scratch:
                cloning = replace(on_data, n_updates=agent_config.start_updates)
                train_on_data("bc", dataset.id, START, cloning, run_dir=run_dir / "start")
            files = scorer_files(dataset)
            plan = Plan(run_dir, agent_config, config, described, files, facts, episodes, environment, reward, device)
            learn(plan, on_progress)
        artifacts.write_bytes(run_dir / CARD_FILE, policy_card(artifacts.read_json(run_dir / "meta.json")).encode())
        (run_dir / CHECKPOINT).unlink(missing_ok=True)
        shutil.rmtree(run_dir / "start", ignore_errors=True)


def reward_of(spec: str, dataset: Dataset, episodes: Sequence[Episode]) -> OnlineReward:
    """Return the reward that ``own``, ``truth`` or the folder of a `zest train trex` names; raises as these do."""
    return own_reward(dataset, episodes) if spec in ("own", "truth") else learned_reward(Path(spec), dataset, episodes)


@contextmanager
def _random_numbers_kept() -> Iterator[None]:
    """Restore the global generators of Python and NumPy at the end: stable-baselines3 seeds and draws from them."""
    python, numpy = random.getstate(), np.random.get_state()  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(python)
        np.random.set_state(numpy)  # noqa: NPY002
