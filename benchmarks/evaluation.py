"""Environment steps per second of a whole evaluation without online scores, against the bare environment on all cores.

Behaviour cloning is what the requirement is about: its network costs next to nothing, so what is missing from 100 % is
start-up, lockstep and bookkeeping. The Decision Transformer (constant return-to-go) is shown beside it. Wall clock, and
nothing is left out: a call includes the start of its worker processes, which is told apart by two calls of different
length. Run it on a quiet machine.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import gymnasium
import numpy as np

from zest_rl.agents import AGENTS
from zest_rl.collect import Behaviour, env_spec, rollout
from zest_rl.envs import HORIZON
from zest_rl.evaluation import EvaluationConfig, evaluate
from zest_rl.parallel import n_cores
from zest_rl.training import train
from zest_rl.types import Episode

REQUIRED_SHARE = 0.7
N_RAW_EPISODES = 10
SHORT, LONG = 25, 100
"""Episodes per core of the two evaluations; `SHORT` is the default of `zest evaluate` on two cores."""


def raw_steps_per_s() -> float:
    """Return the steps per second of one process that takes random actions in one environment."""
    env = gymnasium.make(env_spec("micro"))
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(HORIZON)]
    start = time.perf_counter()
    for _ in range(N_RAW_EPISODES):
        env.reset()
        for action in actions:
            env.step(action)
    seconds = time.perf_counter() - start
    env.close()
    return N_RAW_EPISODES * HORIZON / seconds


def make_run(agent: str, folder: Path) -> Path:
    """Train an agent of full size for one update on one episode of the expert; return its run folder."""
    recorded = rollout(Behaviour("micro", "expert"), 0)
    obs, actions, gt_reward = (recorded[name][0] for name in ("obs", "actions", "gt_reward"))
    dataset = {"env_spec": env_spec("micro").to_json(), "ref_min_score": 0.0, "ref_max_score": 70.0, "zest": {}}
    episode = Episode(obs, actions, np.asarray(gt_reward[1:], dtype=np.float32), terminated=False)
    config = AGENTS[agent].config()
    return train(agent, config, [episode], folder / agent, n_updates=1, seed=0, meta={"dataset": dataset}, device="cpu")


def evaluation_seconds(run: Path, n_episodes: int) -> float:
    """Return the seconds that one call of `evaluate` takes on all cores."""
    start = time.perf_counter()
    evaluate(run, EvaluationConfig(n_episodes=n_episodes, rtg="constant"))
    return time.perf_counter() - start


def run() -> dict[str, object]:
    """Return steps per second, shares of the bare environment's, seconds of start-up, and whether enough is met."""
    cores = n_cores()
    raw = [raw_steps_per_s()]
    seconds: dict[tuple[str, int], float] = {}
    with tempfile.TemporaryDirectory() as folder:
        for agent in ("bc", "dt"):
            run_dir = make_run(agent, Path(folder))
            for per_core in (SHORT, LONG):
                seconds[agent, per_core] = evaluation_seconds(run_dir, per_core * cores)
            raw.append(raw_steps_per_s())
    bare = float(np.mean(raw)) * cores
    result: dict[str, object] = {
        "n_cores": cores,
        "raw_steps_per_s_per_core": round(bare / cores),
        "raw_spread": f"{min(raw):.0f} to {max(raw):.0f}",
    }
    shares = {key: key[1] * cores * HORIZON / value / bare for key, value in seconds.items()}
    for agent in ("bc", "dt"):
        per_episode = (seconds[agent, LONG] - seconds[agent, SHORT]) / (LONG - SHORT)
        result[f"{agent}_steps_per_s"] = round(shares[agent, LONG] * bare)
        result[f"{agent}_share"] = round(shares[agent, LONG], 3)
        result[f"{agent}_share_of_{SHORT}_per_core"] = round(shares[agent, SHORT], 3)
        result[f"{agent}_start_up_s"] = round(seconds[agent, SHORT] - SHORT * per_episode, 2)
    return {**result, "required_share": REQUIRED_SHARE, "passed": shares["bc", LONG] >= REQUIRED_SHARE}


def main() -> None:
    """Print the comparison; exit with 1 when the required share is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    as_json = parser.parse_args().json
    result = run()
    if as_json:
        print(json.dumps(result))
    else:
        for name, value in result.items():
            print(f"{name:26} {value}")
    sys.exit(0 if result["passed"] else 1)


if __name__ == "__main__":
    main()
