"""Environment steps per second of an evaluation without online scores, against the bare environment.

The agents are those of ``train/bc.toml`` and ``train/dt.toml`` (constant return-to-go). What is missing from 100 % are
their networks, lockstep and bookkeeping. The bare environment runs in as many processes at once, because busy cores
slow each other down, before and after the evaluation, and takes the policy's own actions, as a step costs the more, the
more the robot touches. Wall clock. The start of the worker processes is in ``steps_per_s`` and ``share``; required is
the share once all of them have finished their first part.
"""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import gymnasium
import numpy as np

from zest_rl.agents import load_policy
from zest_rl.agents.configs import BCConfig, DTConfig, OptimizerConfig
from zest_rl.evaluation.evaluate import N_JOBS, EvaluationConfig, evaluate, target_return
from zest_rl.kitchen.behaviour import Behaviour, rollout
from zest_rl.kitchen.env import HORIZON, env_spec
from zest_rl.runtime.parallel import n_cores, one_thread
from zest_rl.training.loop import fit
from zest_rl.training.request import TrainingConfig
from zest_rl.types import Episode

AGENTS = {
    "bc": BCConfig(n_networks=3, learning_rate=1e-3, dropout=0.0, batch_size=320),
    "dt": DTConfig(context_len=1, timesteps="relative", learning_rate=1e-3, dropout=0.0, batch_size=320),
}
REQUIRED_SHARES = {"bc": 0.9, "dt": 0.8}
N_RAW_EPISODES = 5
N_EPISODES = 200
N_PROCESSES = min(n_cores(), N_JOBS // 2)


def raw_steps_per_s(run: Path) -> float:
    """Return the steps per second of one process that takes the actions of a policy, known beforehand, in one env."""
    policy, config = load_policy(run), EvaluationConfig(rtg="constant")
    env = gymnasium.make(env_spec("micro"))
    actions = []
    for episode in range(N_RAW_EPISODES):
        obs, _ = env.reset(seed=config.seed + episode)
        policy.begin(1, target_return(policy, config))
        for _ in range(HORIZON):
            actions.append(policy.act(obs[None])[0])
            obs, *_ = env.step(actions[-1])
            if policy.uses_return:
                policy.observe(np.zeros(1, dtype=np.float32))
    start = time.perf_counter()
    for i, action in enumerate(actions):
        if i % HORIZON == 0:
            env.reset(seed=config.seed + i // HORIZON)
        env.step(action)
    seconds = time.perf_counter() - start
    env.close()
    return len(actions) / seconds


def raw_steps_per_s_at_once(run: Path) -> float:
    """Return the steps per second of `N_PROCESSES` such processes together."""
    with ProcessPoolExecutor(N_PROCESSES, multiprocessing.get_context("spawn")) as pool:
        return sum(pool.map(raw_steps_per_s, [run] * N_PROCESSES))


def make_run(agent: str, agent_config: OptimizerConfig, folder: Path) -> Path:
    """Train an agent of full size for one update on one episode of the expert; return its run folder."""
    recorded = rollout(Behaviour("micro", "expert"), 0)
    obs, actions, gt_reward = (recorded[name][0] for name in ("obs", "actions", "gt_reward"))
    refs = {"ref_min_score": 0.0, "ref_max_score": 70.0}
    dataset = {"id": "one-episode-v0", "env_spec": env_spec("micro").to_json(), **refs, "zest": {}}
    episode = Episode(obs, actions, np.asarray(gt_reward[1:], dtype=np.float32), terminated=False)
    config = TrainingConfig(n_updates=1, device="cpu")
    return fit(agent, agent_config, [episode], folder / agent, config, meta={"dataset": dataset})


def run() -> dict[str, object]:
    """Return steps per second of the bare environment in all processes at once and of evaluations, and their shares."""
    result: dict[str, object] = {"n_processes": N_PROCESSES, "n_episodes": N_EPISODES}
    passed = True
    with tempfile.TemporaryDirectory() as folder, one_thread():
        for agent, agent_config in AGENTS.items():
            run_dir, ends = make_run(agent, agent_config, Path(folder)), list[tuple[int, float]]()
            before = raw_steps_per_s_at_once(run_dir)
            start = time.perf_counter()
            evaluate(
                run_dir,
                EvaluationConfig(n_episodes=N_EPISODES, rtg="constant"),
                n_workers=N_PROCESSES,
                on_progress=lambda n, ends=ends: ends.append((n, time.perf_counter())),  # type: ignore[misc]
            )
            whole = N_EPISODES * HORIZON / (time.perf_counter() - start)
            rest = ends[N_PROCESSES:]  # once each process has finished a part
            started = sum(n for n, _ in rest) * HORIZON / (rest[-1][1] - ends[N_PROCESSES - 1][1])
            raw = (before + raw_steps_per_s_at_once(run_dir)) / 2
            result |= {
                f"{agent}_raw_steps_per_s_at_once": round(raw),
                f"{agent}_steps_per_s": round(whole),
                f"{agent}_steps_per_s_once_started": round(started),
                f"{agent}_share": round(whole / raw, 3),
                f"{agent}_share_once_started": round(started / raw, 3),
                f"{agent}_required_share_once_started": REQUIRED_SHARES[agent],
            }
            passed &= started / raw >= REQUIRED_SHARES[agent]
    return {**result, "passed": passed}
