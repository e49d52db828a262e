"""Copies of a dataset's environment for stable-baselines3: observations are normalised, actions are corrections."""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from zest_rl.agents.base import DataFacts
from zest_rl.agents.online import CorrectedPolicy
from zest_rl.data.observations import MAX_STANDARDIZED
from zest_rl.errors import Notice, ZestError
from zest_rl.evaluation.environments import RunEnvironment, act_in
from zest_rl.online.rewards import OnlineReward, Steps
from zest_rl.sources.base import StateViews
from zest_rl.types import FloatArray

WATCHED = 1000
"""Steps after which a reward that never changed is told."""
N_RECENT = 20
"""Episodes whose returns are averaged in the log."""


class Teller(gymnasium.Wrapper[FloatArray, FloatArray, Any, Any]):
    """One copy: observations as a dataset holds them, and in ``info`` the other arguments of `Steps`."""

    def __init__(self, environment: RunEnvironment, facts: DataFacts, views: StateViews | None):
        super().__init__(gymnasium.wrappers.TimeLimit(environment.make(), environment.horizon))
        self._environment, self._views = environment, views
        self.observation_space = spaces.Box(-np.inf, np.inf, (facts.obs_dim,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (facts.act_dim,), np.float32)

    def _state(self, first: NDArray[np.float64] | None) -> NDArray[np.float64]:
        return np.zeros(0) if self._views is None else self._views.read(self.env.unwrapped, first)

    def reset(self, **options: Any) -> tuple[FloatArray, dict[str, Any]]:
        """Start an episode."""
        observation, _ = self.env.reset(**options)
        self._first = self._after = self._state(None)
        return self._environment.flatten([observation])[0], {}

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Take a step."""
        observation, own, terminated, truncated, _ = self.env.step(act_in(self.env, action))
        before, self._after = self._after, self._state(self._first)
        told = {"first": self._first, "before": before, "after": self._after}
        return self._environment.flatten([observation])[0], float(own), bool(terminated), bool(truncated), told


class RewardedVecEnv(VecEnvWrapper):
    """N copies, whose actions are corrections of the cloned action and whose rewards are standardised."""

    def __init__(self, venv: VecEnv, facts: DataFacts, actor: CorrectedPolicy, reward: OnlineReward):
        bounds = spaces.Box(-MAX_STANDARDIZED, MAX_STANDARDIZED, (facts.obs_dim,), np.float32)
        super().__init__(venv, observation_space=bounds)
        recorded = np.concatenate(list(reward.recorded))
        self._facts, self._actor, self._reward = facts, actor, reward
        self._mean, self._scale = recorded.mean(), recorded.std() or 1.0
        self._obs: FloatArray = np.zeros(0, np.float32)
        self._sums = np.zeros((2, self.num_envs))
        self._n_steps, self._extremes = 0, (np.inf, -np.inf)
        self.returns: deque[tuple[float, float]] = deque(maxlen=N_RECENT)
        """Of the newest episodes: sums of the rewards, and of the environment's own."""

    def standardized(self, rewards: FloatArray) -> FloatArray:
        """Return rewards in standard deviations of the dataset's, so that all kinds have one scale."""
        standardized: FloatArray = ((rewards - self._mean) / self._scale).astype(np.float32)
        return standardized

    def reset(self) -> FloatArray:
        """Start all episodes."""
        self._sums[:] = 0
        self._obs = self._facts.normalize(np.asarray(self.venv.reset()))
        return self._obs

    def step_async(self, actions: FloatArray) -> None:
        """Act by the clone and the corrections (N, act_dim) in [-1, 1]."""
        with torch.no_grad():
            cloned = self._actor.cloned(torch.from_numpy(self._obs))
            whole = cloned + self._actor.scale * torch.from_numpy(np.asarray(actions, np.float32))
        self.venv.step_async(whole.clamp(-1, 1).numpy())

    def step_wait(self) -> VecEnvStepReturn:
        """Return normalised observations and standardised rewards.

        Raises:
            ZestError: a reward or an observation is NaN or infinite.
        """
        obs, own, dones, infos = self.venv.step_wait()
        own = np.asarray(own, np.float32)
        last = np.stack([info.get("terminal_observation", o) for info, o in zip(infos, obs, strict=True)])
        states = (np.stack([info.pop(name) for info in infos]) for name in ("first", "before", "after"))
        if not np.isfinite(last).all():
            raise ZestError(f"the environment observes NaN or infinity after {self._n_steps} steps; it has diverged")
        rewards = self._reward.of_steps(Steps(last, own, *states))
        if not np.isfinite(rewards).all():
            raise ZestError(f"rewards must be finite, got {rewards} after {self._n_steps} steps; check the reward")
        self._watch(rewards)
        self._sums += [rewards, own]
        for i in np.flatnonzero(dones):
            infos[i]["terminal_observation"] = self._facts.normalize(last[i])
            self.returns.append((float(self._sums[0, i]), float(self._sums[1, i])))
            self._sums[:, i] = 0
        self._obs = self._facts.normalize(np.asarray(obs))
        return self._obs, self.standardized(rewards), dones, infos

    def _watch(self, rewards: FloatArray) -> None:
        """Tell once if the first rewards are all the same."""
        was_short, self._n_steps = self._n_steps < WATCHED, self._n_steps + len(rewards)
        if was_short:
            self._extremes = min(self._extremes[0], rewards.min()), max(self._extremes[1], rewards.max())
            if self._n_steps >= WATCHED and self._extremes[0] == self._extremes[1]:
                warnings.warn(
                    f"the reward was {self._extremes[0]:zg} in each of the first {self._n_steps} steps: there is "
                    "nothing to learn from yet; start from a dataset that reaches the object (without --from-scratch)",
                    Notice,
                    stacklevel=2,
                )


def make_environments(
    environment: RunEnvironment,
    facts: DataFacts,
    actor: CorrectedPolicy,
    reward: OnlineReward,
    n_envs: int,
    *,
    subprocesses: bool,
) -> RewardedVecEnv:
    """Make N copies, each in a process of its own if asked for; close them after use."""
    copies: list[Callable[[], gymnasium.Env[Any, Any]]] = [partial(Teller, environment, facts, reward.views)] * n_envs
    venv: VecEnv = SubprocVecEnv(copies) if subprocesses else DummyVecEnv(copies)
    return RewardedVecEnv(venv, facts, actor, reward)
