"""One training: environments, an algorithm, and what is written while it learns and at the end."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from zest_rl.agents import get_agent
from zest_rl.agents.base import DataFacts
from zest_rl.agents.configs import OnlineConfig
from zest_rl.agents.online import CorrectedPolicy
from zest_rl.errors import ZestError
from zest_rl.evaluation.environments import RunEnvironment
from zest_rl.online.algorithms import build, mean_network
from zest_rl.online.environments import RewardedVecEnv, make_environments
from zest_rl.online.rewards import OnlineReward
from zest_rl.runtime import artifacts
from zest_rl.runtime.arrays import read_arrays, write_arrays
from zest_rl.runtime.learner_state import restore, state_of
from zest_rl.runtime.records import reading_record
from zest_rl.training.log import MetricsLog
from zest_rl.training.request import OnProgress, RunConfig, snapshot_folder
from zest_rl.types import Episode

CHECKPOINT = "checkpoint.npz"
COLUMNS = ("step", "reward", "return", "value_loss", "steps_per_s")
"""Of the log: mean sums of the newest episodes' rewards, and of the environment's own, which nothing learns from unless
it is the reward; loss of the critics; all while exploring."""


@dataclass(frozen=True)
class Plan:
    """What a training is made from."""

    folder: Path
    agent_config: OnlineConfig
    config: RunConfig
    described: Mapping[str, Any]
    """The part of ``meta.json`` that is known before."""
    files: Mapping[str, bytes]
    facts: DataFacts
    episodes: Sequence[Episode]
    environment: RunEnvironment
    reward: OnlineReward
    device: torch.device


def learn(plan: Plan, on_progress: OnProgress | None) -> None:
    """Train from the last checkpoint, if any, to the end, and write the policy."""
    config = plan.agent_config
    actor = get_agent(plan.described["agent"]).networks(config, plan.facts).eval()
    assert isinstance(actor, CorrectedPolicy)
    if actor.start is not None:
        actor.start.load_state_dict(safetensors.torch.load_file(plan.folder / "start" / "model.safetensors"))
    state = _checkpoint(plan.folder)
    n_done = 0 if state is None else int(state["counts"][0])
    seconds = 0.0 if state is None else float(state.pop("seconds"))
    seed = int(np.random.SeedSequence([plan.config.seed, n_done]).generate_state(1)[0] >> 1)
    venv = make_environments(
        plan.environment, plan.facts, actor, plan.reward, config.n_envs, subprocesses=config.subprocesses
    )
    try:
        recorded = None if config.from_scratch else recorded_steps(plan, actor, venv)
        model = build(config, venv, recorded, seed=seed, device=plan.device)
        model.set_logger(Logger(None, []))  # its own would leave a folder in the system's temporary one
        if state is not None:
            with reading_record(plan.folder / CHECKPOINT, "delete it, and the run starts anew"):
                restore(model, state)
        with MetricsLog(plan.folder, n_done, COLUMNS) as log:
            recorder = Recorder(plan, actor, venv, log, on_progress, n_done, seconds)
            never: Any = None  # we read its logger ourselves
            model.learn(config.n_steps - n_done, recorder, log_interval=never, reset_num_timesteps=False)
            recorder.write_policy(plan.folder)
    finally:
        plan.reward.flush()
        venv.close()


def _checkpoint(folder: Path) -> dict[str, NDArray[Any]] | None:
    path = folder / CHECKPOINT
    state = read_arrays(path)
    if state is None and path.exists():
        raise ZestError(f"{path} is damaged; delete it, and the same command starts the run anew")
    return state


def recorded_steps(plan: Plan, actor: CorrectedPolicy, venv: RewardedVecEnv) -> ReplayBufferSamples:
    """Return the steps of the dataset, as they would have been seen in the environments."""
    before, after = (
        torch.from_numpy(plan.facts.normalize(np.concatenate([episode.obs[part] for episode in plan.episodes])))
        for part in (slice(None, -1), slice(1, None))
    )
    actions = torch.from_numpy(np.concatenate([episode.actions for episode in plan.episodes]))
    with torch.no_grad():
        corrections = ((actions - actor.cloned(before)) / actor.scale).clamp(-1, 1)
    dones = np.concatenate([np.arange(len(e), 0, -1) <= int(e.terminated) for e in plan.episodes]).astype(np.float32)
    rewards = venv.standardized(np.concatenate(list(plan.reward.recorded)))
    return ReplayBufferSamples(
        before, corrections, after, torch.from_numpy(dones)[:, None], torch.from_numpy(rewards)[:, None]
    )


class Recorder(BaseCallback):
    """Logs, checkpoints and snapshots, each every so many steps."""

    def __init__(
        self,
        plan: Plan,
        actor: CorrectedPolicy,
        venv: RewardedVecEnv,
        log: MetricsLog,
        on_progress: OnProgress | None,
        n_done: int,
        seconds: float,
    ):
        super().__init__()
        self._plan, self._actor, self._venv, self._log, self._on_progress = plan, actor, venv, log, on_progress
        self._n_shown, self._n_logged, self._tick, self._row_tick = 0, n_done, time.perf_counter(), time.perf_counter()
        self._last, self._seconds = n_done, seconds

    def _on_step(self) -> bool:
        config, before, now = self._plan.config, self._last, self.num_timesteps
        self._last = now

        def due(every: int | None) -> bool:
            return every is not None and before // every < now // every

        if due(config.log_every) and self._venv.returns:
            self._write_row()
        if now >= self._plan.agent_config.n_steps:
            return True
        if due(config.snapshot_every):
            folder = snapshot_folder(self._plan.folder, now)
            if not folder.exists():
                with artifacts.staged_folder(folder) as staging:
                    self.write_policy(staging)
        if due(config.checkpoint_every):
            self._plan.reward.flush()
            write_arrays(
                self._plan.folder / CHECKPOINT, {**state_of(self.model), "seconds": np.array(self._seconds_so_far())}
            )
        return True

    def _seconds_so_far(self) -> float:
        return self._seconds + time.perf_counter() - self._tick

    def _write_row(self) -> None:
        rewards, own = np.mean(self._venv.returns, axis=0)
        told, now = self.model.logger.name_to_value, time.perf_counter()
        row = {
            "reward": float(rewards),
            "return": float(own),
            "value_loss": float(told.get("train/critic_loss", told.get("train/value_loss", np.nan))),
            "steps_per_s": round((self.num_timesteps - self._n_logged) / (now - self._row_tick), 2),
        }
        self._log.write(self.num_timesteps, row)
        if self._on_progress is not None:
            self._on_progress(self.num_timesteps - self._n_shown, **row)
        self._n_shown = self._n_logged = self.num_timesteps
        self._row_tick = now

    def write_policy(self, folder: Path) -> None:
        """Write the current policy, and ``meta.json`` last."""
        self._actor.correction.load_state_dict(mean_network(self.model).state_dict())
        weights = safetensors.torch.save({name: t.cpu().contiguous() for name, t in self._actor.state_dict().items()})
        for name, content in {**self._plan.files, "model.safetensors": weights}.items():
            artifacts.write_bytes(folder / name, content)
        results = {
            "n_updates": self.model._n_updates,
            "n_params": sum(p.numel() for p in self._actor.parameters()),
            "model_sha256": artifacts.hash_bytes(weights),
            "train_seconds": round(self._seconds_so_far(), 3),
            "made_by": artifacts.provenance(),
        }
        artifacts.write_json(folder / "meta.json", {**self._plan.described, **results})
