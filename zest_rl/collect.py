"""Expert + noise → a Minari dataset with successes and failures, at a chosen level of the expert's return.

As in the paper the expert's actions get uniform noise whose level is drawn per trajectory: episode i acts with
``clip(expert + U(−s_i, s_i))``, ``s_i = u_i · noise_max``, ``u_i ~ U(0, 1)``. Calibration moves `noise_max` alone and
looks at the returns of these very episodes, never at a trained policy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from zest_rl import artifacts
from zest_rl.data_writer import Recording
from zest_rl.envs import ACT_DIM, ENV_ID, HORIZON
from zest_rl.errors import BadInput, ZestError
from zest_rl.experts import add_uniform_noise, make_expert
from zest_rl.parallel import chunks, concatenate, map_jobs, read_arrays
from zest_rl.types import FloatArray

EPISODES_PER_JOB = 5
REFERENCE_STREAM = 2**31
"""Episodes from this index on serve the reference returns; datasets stay below it."""
LARGEST_NOISE = 2.0
N_REFERENCE = 100
"""Episodes that measure the expert."""
N_NOTHING = 10
"""Episodes of the robot doing nothing: their returns hardly differ."""
Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Behaviour:
    """Who acts, and how its episodes are numbered: episode i of a behaviour is always the same episode."""

    task: str
    policy: str
    """``"expert"``, or ``"nothing"``: the zero action, the lower reference of the normalized return."""
    noise_max: float = 0.0
    """Largest noise level; 1 is the whole action range to either side."""
    init_noise: float = 0.05
    """Half-width of the uniform noise on the arm's start, in rad."""
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.noise_max <= LARGEST_NOISE:
            raise BadInput(
                f"noise_max must be in [0, {LARGEST_NOISE}] (1 = the whole action range), got {self.noise_max}"
            )
        if self.policy not in ("expert", "nothing"):
            raise BadInput(f"policy must be 'expert' or 'nothing', got {self.policy!r}")
        if self.seed < 0:
            raise BadInput(f"seed must be 0 or positive, got {self.seed}")


def env_spec(task: str, init_noise: float = 0.05) -> gymnasium.envs.registration.EnvSpec:
    """Return the EnvSpec of a task; its JSON rebuilds the environment anywhere."""
    spec = gymnasium.spec(ENV_ID)
    return replace(spec, kwargs={"task": task, "init_noise": init_noise})


def rollout(behaviour: Behaviour, index: int) -> Arrays:
    """Run episode `index` of a behaviour: arrays named as in `Recording`, with a leading axis of length 1."""
    env_seed, level_seed = np.random.SeedSequence([behaviour.seed, index]).generate_state(2)
    rng = np.random.default_rng(level_seed)
    level = rng.uniform() * behaviour.noise_max
    env = gymnasium.make(env_spec(behaviour.task, behaviour.init_noise))
    expert = make_expert(behaviour.task, env)
    steps: dict[str, list[Any]] = {name: [] for name in ("obs", "actions", "qpos", "qvel", "gt_reward", "gt_success")}

    def record(obs: FloatArray, info: dict[str, Any]) -> None:
        steps["obs"].append(obs)
        steps["qpos"].append(info["state"]["qpos"])
        steps["qvel"].append(info["state"]["qvel"])
        steps["gt_reward"].append(info["gt"]["reward"])
        steps["gt_success"].append(info["gt"]["success"])

    record(*env.reset(seed=int(env_seed)))
    for _ in range(HORIZON):
        action = expert.act() if behaviour.policy == "expert" else np.zeros(ACT_DIM, np.float32)
        steps["actions"].append(add_uniform_noise(action, level, rng))
        obs, _, _, _, info = env.step(steps["actions"][-1])
        record(obs, info)
    env.close()
    episode = {name: np.stack(values)[None] for name, values in steps.items()}
    return {**episode, "seed": np.array([env_seed], dtype=np.int64), "level": np.array([level])}


def _rollouts(job: tuple[Behaviour, range]) -> Arrays:
    behaviour, indices = job
    return concatenate([rollout(behaviour, index) for index in indices])


def run_behaviour(
    behaviour: Behaviour,
    n_episodes: int,
    *,
    first: int = 0,
    n_workers: int | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> Arrays:
    """Run episodes `first` … `first` + `n_episodes` − 1 on all cores; finished parts are kept in the cache.

    Returns:
        Arrays named as in `Recording`, each with a leading axis of length `n_episodes`.
    """
    if n_episodes < 1:
        raise BadInput(f"n_episodes must be at least 1, got {n_episodes}")
    folder = behaviour_folder(behaviour)
    jobs = {}
    for part in chunks(n_episodes, EPISODES_PER_JOB):
        indices = range(first + part.start, first + part.stop)
        jobs[f"episodes-{indices.start}-{indices.stop}"] = (behaviour, indices)
    map_jobs(
        _rollouts,
        jobs,
        folder,
        n_workers=n_workers,
        on_done=None if on_progress is None else lambda name: on_progress(len(jobs[name][1])),
    )
    parts = [read_arrays(folder / f"{name}.npz") for name in jobs]
    return concatenate([part for part in parts if part is not None])


def behaviour_folder(behaviour: Behaviour) -> Path:
    """Where `run_behaviour` keeps finished parts."""
    code = [artifacts.hash_file(Path(__file__).with_name(name)) for name in ("collect.py", "envs.py", "experts.py")]
    key = {**asdict(behaviour), "code": code, "versions": artifacts.versions()}
    return artifacts.cache_dir() / "episodes" / artifacts.hash_json(key)[:20]


@dataclass(frozen=True)
class References:
    """The two ends of the normalized return, and the expert's success rate."""

    minimum: float
    """Mean return of the robot doing nothing."""
    expert: float
    """Mean return of the expert without noise."""
    expert_success: float
    n_episodes: int


def measure_references(
    behaviour: Behaviour,
    n_episodes: int = N_REFERENCE,
    *,
    n_workers: int | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> References:
    """Measure expert and do-nothing returns on starts that no dataset uses.

    Raises:
        ZestError: the expert does no better than the robot doing nothing.
    """
    runs = {
        policy: run_behaviour(
            replace(behaviour, policy=policy, noise_max=0.0),
            n,
            first=REFERENCE_STREAM,
            n_workers=n_workers,
            on_progress=on_progress,
        )
        for policy, n in (("expert", n_episodes), ("nothing", N_NOTHING))
    }
    minimum, expert = (float(returns(runs[policy]).mean()) for policy in ("nothing", "expert"))
    if not expert > minimum:
        raise ZestError(f"the expert of task {behaviour.task!r} returns {expert:.3f}, no more than doing nothing")
    return References(minimum, expert, float(runs["expert"]["gt_success"].any(axis=1).mean()), n_episodes)


def returns(episodes: Mapping[str, NDArray[Any]]) -> NDArray[np.float64]:
    """Ground-truth return of each episode: (N,)."""
    return np.asarray(episodes["gt_reward"][:, 1:].sum(axis=1, dtype=np.float64))


def calibrate(
    behaviour: Behaviour,
    n_episodes: int,
    references: References,
    target: float,
    *,
    tolerance: float = 0.5,
    n_rounds: int = 10,
    n_workers: int | None = None,
    on_round: Callable[[float, float], None] | None = None,
) -> float:
    """Find the `noise_max` at which the episodes' mean normalized return meets `target`, by bisection.

    Args:
        behaviour: task and seed; its `noise_max` is ignored.
        n_episodes: the dataset's size; the very episodes of the dataset are used.
        references: the two ends of the scale.
        target: percent of the expert, e.g. 81.19.
        tolerance: stop within this many percent.
        n_rounds: at most so many tries.
        n_workers: processes, default one per core.
        on_round: called with (noise_max, percent) after each.

    Raises:
        BadInput: `target` is not in (0, 100].
        ZestError: no level within `tolerance` was found.
    """
    if not 0 < target <= 100:
        raise BadInput(f"the level to calibrate to must be in (0, 100] percent of the expert, got {target}")
    low, high = 0.0, LARGEST_NOISE
    for _ in range(n_rounds):
        noise_max = round((low + high) / 2, 4)
        episodes = run_behaviour(replace(behaviour, noise_max=noise_max), n_episodes, n_workers=n_workers)
        level = 100 * (returns(episodes).mean() - references.minimum) / (references.expert - references.minimum)
        if on_round is not None:
            on_round(noise_max, level)
        if abs(level - target) <= tolerance:
            return noise_max
        low, high = (noise_max, high) if level > target else (low, noise_max)
    raise ZestError(
        f"no noise_max in [0, {LARGEST_NOISE}] brings the dataset to {target} ± {tolerance} % of the expert "
        f"(the last try, {noise_max}, gave {level:.2f} %); collect more episodes or choose noise_max by hand"
    )


def recordings(episodes: Mapping[str, NDArray[Any]]) -> list[Recording]:
    """Turn stacked episodes into what `zest_rl.data_writer.write_dataset` takes."""
    return [
        Recording(
            seed=int(episodes["seed"][i]),
            obs=episodes["obs"][i],
            actions=episodes["actions"][i],
            terminated=False,
            qpos=episodes["qpos"][i],
            qvel=episodes["qvel"][i],
            gt_reward=episodes["gt_reward"][i],
            gt_success=episodes["gt_success"][i],
        )
        for i in range(len(episodes["seed"]))
    ]
