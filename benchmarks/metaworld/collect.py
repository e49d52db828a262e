"""Imperfect scripted policies of Meta-World → a Minari dataset per task, at 81 % of the expert's return.

``python -m benchmarks.metaworld.collect [TASK …]``. The policies are the package's own. Their flaws are those of the
kitchen's mixed datasets (`zest_rl.kitchen.behaviour`), drawn per episode: noise, slowness, a constant error, and early
stops. How slow they are is calibrated, on the return of the dataset's own episodes alone.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace

import gymnasium
import numpy as np
from metaworld.policies import ENV_POLICY_MAP
from numpy.typing import NDArray

from benchmarks.metaworld.envs import HORIZON, TASKS, make
from zest_rl.data.reader import exists
from zest_rl.errors import ZestError
from zest_rl.metrics.statistics import normalized_return
from zest_rl.simulation.recorder import Recorder

LEVEL, TOLERANCE = 81.0, 0.5
"""Percent of the expert that a dataset is calibrated to; and how far it may be from that."""
NARROWEST = 1e-4
"""Interval of `Flaws.slow_max` in which the bisection gives up."""
N_EPISODES, N_REFERENCE = 100, 100
REFERENCE_STREAM = 2**31
"""First index of the episodes for reference returns; datasets stay below it."""


@dataclass(frozen=True)
class Flaws:
    """Of the policy; with none it is the expert."""

    slow_max: float = 0.0
    """The hand makes the share 1 − U(0, slow_max) of its movement; calibrated."""
    noise_max: float = 0.0
    """Largest level of uniform noise on the actions, drawn from U(0, noise_max)."""
    bias_max: float = 0.0
    """Largest constant error of an action: U(−b, b) in each component, b ~ U(0, bias_max)."""
    stop_share: float = 0.0
    """Share of the episodes in which it stops, at a time drawn from U(.1, 1) of the horizon."""


MIXED = Flaws(noise_max=0.4, bias_max=0.03, stop_share=0.1)


def run_episode(env: gymnasium.Env, task: str, flaws: Flaws | None, seed: int, index: int) -> float:
    """Run episode `index` of a dataset, always the same one, and return its return; without `flaws` nothing is done.

    Every number is drawn whether it is used or not, so that calibration changes each episode continuously.
    """
    env_seed, noise_seed, flaw_seed = np.random.SeedSequence([seed, index]).generate_state(3)
    noise, drawn = np.random.default_rng(noise_seed), np.random.default_rng(flaw_seed)
    slow, level, bias, stops, stop_at = drawn.uniform(size=5)
    direction = drawn.uniform(-1, 1, 4)
    policy, total = ENV_POLICY_MAP[f"{task}-v3"](), 0.0
    obs, _ = env.reset(seed=int(env_seed))
    for step in range(HORIZON):
        action = np.zeros(4)
        if flaws is not None:
            if not (stops < flaws.stop_share and step >= (0.1 + 0.9 * stop_at) * HORIZON):
                action = np.clip(
                    policy.get_action(obs.astype(np.float64)), -1, 1
                )  # a copy, for it changes its argument
                action[:3] *= 1 - slow * flaws.slow_max
            action = action + bias * flaws.bias_max * direction
            action = action + level * flaws.noise_max * noise.uniform(-1, 1, 4)
        obs, reward, _, _, _ = env.step(np.clip(action, -1, 1).astype(np.float32))
        total += float(reward)
    return total


def run_episodes(
    env: gymnasium.Env, task: str, flaws: Flaws | None, seed: int, n_episodes: int, first: int = 0
) -> NDArray[np.float64]:
    """Return the returns of episodes `first` … : (N,)."""
    return np.array([run_episode(env, task, flaws, seed, first + index) for index in range(n_episodes)])


def collect(task: str, dataset_id: str, seed: int, n_episodes: int) -> None:
    """Measure the references, bisect `slow_max` until the dataset is at `LEVEL`, and write it.

    Raises:
        ZestError: no value brings the dataset to the level.
    """
    env = make(task)
    expert, nothing = (
        float(run_episodes(env, task, flaws, seed, N_REFERENCE, REFERENCE_STREAM).mean()) for flaws in (Flaws(), None)
    )
    print(f"{task}: expert {expert:.2f}, nothing {nothing:.2f}")
    low, high, level = 0.0, 1.0, 0.0
    while abs(level - LEVEL) > TOLERANCE:
        if high - low < NARROWEST:
            raise ZestError(
                f"{task}: no slow_max brings {n_episodes} episodes to {LEVEL} ± {TOLERANCE} %; collect more"
            )
        flaws, recorder = replace(MIXED, slow_max=(low + high) / 2), Recorder(make(task))
        returns = run_episodes(recorder, task, flaws, seed, n_episodes)
        level = float(normalized_return(returns, nothing, expert).mean())
        print(f"  slow_max {flaws.slow_max:.4f}: {level:.2f} % of the expert", flush=True)
        low, high = (flaws.slow_max, high) if level > LEVEL else (low, flaws.slow_max)
    path = recorder.write(
        dataset_id,
        f"Meta-World {task}-v3: {n_episodes} episodes of {HORIZON} steps by its scripted policy with {flaws}, drawn "
        f"per episode; {level:.2f} % of the flawless policy's return.",
        ref_min_score=nothing,
        ref_max_score=expert,
    )
    print(f"  {path}")


def main() -> None:
    """Collect what is not there yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", default=TASKS, metavar="TASK", help=f"of {', '.join(TASKS)}; default all")
    parser.add_argument("--episodes", type=int, default=N_EPISODES, help=f"default {N_EPISODES}")
    parser.add_argument("--seed", type=int, default=0, help="0 for the table, others for development")
    parser.add_argument("--name", default="metaworld/{task}-mixed-v0", help="id of the datasets")
    arguments = parser.parse_args()
    if unknown := set(arguments.tasks) - set(TASKS):
        parser.error(f"unknown task {', '.join(sorted(unknown))}; choose from {', '.join(TASKS)}")
    for task in arguments.tasks:
        dataset_id = arguments.name.replace("{task}", task)
        if exists(dataset_id):
            print(f"{dataset_id} is there already")
        else:
            collect(task, dataset_id, arguments.seed, arguments.episodes)


if __name__ == "__main__":
    main()
