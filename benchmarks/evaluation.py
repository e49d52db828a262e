"""Environment steps per second of a whole evaluation without online scores, against the bare environment on all cores.

Behaviour cloning is what the requirement is about: its network costs next to nothing, so what is missing from 100 % is
start-up, lockstep and bookkeeping, and what busy cores lose to each other. The last is told apart by running the bare
environment on all cores at once. The Decision Transformer (constant return-to-go) is shown beside it. The bare
environment takes the policy's own actions, as a step costs the more, the more the robot touches. Wall clock, and
nothing is left out: a call includes the start of its worker processes.
"""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import gymnasium
import numpy as np

from zest_rl.agents import AGENTS, load_policy
from zest_rl.evaluation.evaluate import EvaluationConfig, evaluate, target_return
from zest_rl.kitchen.behaviour import Behaviour, rollout
from zest_rl.kitchen.env import HORIZON, env_spec
from zest_rl.runtime.parallel import n_cores, one_thread
from zest_rl.training.loop import TrainingConfig, fit
from zest_rl.types import Episode

REQUIRED_SHARE = 0.7
N_RAW_EPISODES = 5
N_EPISODES = 100


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


def make_run(agent: str, folder: Path) -> Path:
    """Train an agent of full size for one update on one episode of the expert; return its run folder."""
    recorded = rollout(Behaviour("micro", "expert"), 0)
    obs, actions, gt_reward = (recorded[name][0] for name in ("obs", "actions", "gt_reward"))
    refs = {"ref_min_score": 0.0, "ref_max_score": 70.0}
    dataset = {"id": "one-episode-v0", "env_spec": env_spec("micro").to_json(), **refs, "zest": {}}
    episode = Episode(obs, actions, np.asarray(gt_reward[1:], dtype=np.float32), terminated=False)
    config = TrainingConfig(n_updates=1, device="cpu")
    return fit(agent, AGENTS[agent].config(), [episode], folder / agent, config, meta={"dataset": dataset})


def run() -> dict[str, object]:
    """Return steps per second of the bare environment on all cores and of evaluations, and whether enough is met."""
    cores, result, shares = n_cores(), {}, {}
    with tempfile.TemporaryDirectory() as folder, one_thread():
        for agent in ("bc", "dt"):
            run_dir = make_run(agent, Path(folder))
            before = raw_steps_per_s(run_dir)
            start = time.perf_counter()
            evaluate(run_dir, EvaluationConfig(n_episodes=N_EPISODES, rtg="constant"))
            ours = N_EPISODES * HORIZON / (time.perf_counter() - start)
            raw = (before + raw_steps_per_s(run_dir)) / 2 * cores
            with ProcessPoolExecutor(cores, multiprocessing.get_context("spawn")) as pool:
                together = sum(pool.map(raw_steps_per_s, [run_dir] * cores))
            shares[agent] = ours / raw
            result |= {
                f"{agent}_raw_steps_per_s": round(raw),
                f"{agent}_raw_steps_per_s_of_all_cores_at_once": round(together),
                f"{agent}_steps_per_s": round(ours),
                f"{agent}_share": round(shares[agent], 3),
                f"{agent}_share_of_all_cores_at_once": round(ours / together, 3),
            }
    return {
        "n_cores": cores,
        "n_episodes": N_EPISODES,
        **result,
        "required_share": REQUIRED_SHARE,
        "passed": shares["bc"] >= REQUIRED_SHARE,
    }
