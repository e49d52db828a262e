"""An imperfect expert of the kitchen, and its episodes.

As in the paper the expert's actions get uniform noise whose level is drawn per trajectory: episode i acts with
``clip(expert + U(−s_i, s_i))``, ``s_i = u_i · noise_max``, ``u_i ~ U(0, 1)``. The other flaws, also drawn per
trajectory, are fields of `Behaviour`. The actions of an expert found by RL are sampled, too.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from zest_rl.data.writer import Recording
from zest_rl.errors import BadInput, ZestError
from zest_rl.kitchen.collect_config import LARGEST, check_flaws, check_n_episodes
from zest_rl.kitchen.env import ACT_DIM, HORIZON, N_QVEL, OBS_DIM, env_spec
from zest_rl.kitchen.experts import DONE_PROGRESS, Manner, add_uniform_noise, make_expert
from zest_rl.kitchen.rl_expert import make_rl_expert, weights_file
from zest_rl.kitchen.scene import N_QPOS
from zest_rl.kitchen.tasks import get_task
from zest_rl.runtime import artifacts
from zest_rl.runtime.arrays import Arrays, Layout, concatenate, read_arrays
from zest_rl.runtime.cache import cache_folder
from zest_rl.runtime.parallel import cached_jobs, chunks, read_parts
from zest_rl.types import FloatArray

EPISODES_PER_JOB = 5
_ARRAYS = ("obs", "actions", "qpos", "qvel", "gt_reward", "gt_success")  # of a `Recording`
STOP_BETWEEN = (0.1, 1.0)
_CODE = ("behaviour.py", "env.py", "arm.py", "experts.py", "tasks.py")  # with the behaviour, determines an episode
POLICIES = ("expert", "rl", "rl-mean", "nothing")


@dataclass(frozen=True)
class Behaviour:
    """A policy with its flaws and seed: episode i of a behaviour is always the same episode."""

    task: str
    policy: str
    """``"expert"``: scripted; ``"rl"``: trained, its actions sampled; ``"rl-mean"``: trained, acting by its mean;
    ``"nothing"``: the zero action, the lower reference of the normalized return."""
    noise_max: float = 0.0
    """Largest noise level; 1 is the whole action range to either side."""
    stop_share: float = 0.0
    """Share of the episodes in which the expert stops early, at a progress drawn from U(`STOP_BETWEEN`)."""
    slow_max: float = 0.0
    """At each step the expert makes the share 1 − U(0, slow_max) of its movement."""
    bias_max: float = 0.0
    """Largest constant error of an action: U(−b, b) in each component for a whole episode, b ~ U(0, bias_max)."""
    grip_max: float = 0.0
    """Largest error of the grip, in m: U(−g, g) along each axis, g ~ U(0, grip_max)."""
    init_noise: float = 0.05
    """Half-width of the uniform noise on the arm's start, in rad."""
    seed: int = 0

    def __post_init__(self) -> None:
        get_task(self.task)
        check_flaws({name: getattr(self, name) for name in LARGEST})
        if self.policy not in POLICIES:
            raise BadInput(f"policy must be one of {', '.join(POLICIES)}, got {self.policy!r}")
        if self.seed < 0:
            raise BadInput(f"seed must be 0 or positive, got {self.seed}")

    def without_flaws(self) -> Behaviour:
        """Return this behaviour, with the same starts, without flaws and with actions that are not sampled."""
        values: dict[str, Any] = dict.fromkeys(LARGEST, 0.0)
        return replace(self, policy="rl-mean" if self.policy == "rl" else self.policy, **values)

    def with_value(self, flaw: str, value: float) -> Behaviour:
        """Return this behaviour with another value of one of `LARGEST`."""
        values: dict[str, Any] = {flaw: value}
        return replace(self, **values)


def rollout(behaviour: Behaviour, index: int) -> Arrays:
    """Run episode `index` of a behaviour: arrays named as in `Recording`, with a leading axis of length 1."""
    env_seed, noise_seed, manner_seed = np.random.SeedSequence([behaviour.seed, index]).generate_state(3)
    rng = np.random.default_rng(noise_seed)
    level = rng.uniform() * behaviour.noise_max
    manner, bias = draw_manner(behaviour, np.random.default_rng(manner_seed))
    env = gymnasium.make(env_spec(behaviour.task, behaviour.init_noise))
    act = _actor(behaviour, env, manner, bias, rng)
    steps: dict[str, list[Any]] = {name: [] for name in _ARRAYS}

    def record(obs: FloatArray, info: dict[str, Any]) -> None:
        steps["obs"].append(obs)
        steps["qpos"].append(info["state"]["qpos"])
        steps["qvel"].append(info["state"]["qvel"])
        steps["gt_reward"].append(info["gt"]["reward"])
        steps["gt_success"].append(info["gt"]["success"])

    record(*env.reset(seed=int(env_seed)))
    for _ in range(HORIZON):
        steps["actions"].append(add_uniform_noise(act(), level, rng))
        obs, _, _, _, info = env.step(steps["actions"][-1])
        record(obs, info)
    env.close()
    return {
        **{name: np.stack(values)[None] for name, values in steps.items()},
        "seed": np.array([env_seed], dtype=np.int64),
        "level": np.array([level]),
        "stop_at": np.array([manner.stop_at]),
        "speed": np.array([manner.speed]),
    }


def _actor(
    behaviour: Behaviour, env: gymnasium.Env[Any, Any], manner: Manner, bias: FloatArray, rng: np.random.Generator
) -> Callable[[], FloatArray]:
    """Return what acts on `env`, before noise; `rng` samples the actions of an expert that is randomized."""
    if behaviour.policy == "nothing":
        return lambda: np.zeros(ACT_DIM, np.float32)
    if behaviour.policy == "expert":
        expert = make_expert(behaviour.task, env, manner)
    else:
        expert = make_rl_expert(behaviour.task, env, rng if behaviour.policy == "rl" else None)
    return lambda: expert.act() + bias


def draw_manner(behaviour: Behaviour, rng: np.random.Generator) -> tuple[Manner, FloatArray]:
    """Draw the expert's manner in one episode, and the constant error (9,) float32 of its actions.

    Every number is drawn whether it is used or not, so that an episode's draws depend neither on which flaws are on nor
    on their size: calibration changes each episode continuously.
    """
    stops, stop_at, slow, grip, bias = rng.uniform(size=5)
    directions = rng.uniform(-1.0, 1.0, 3 + ACT_DIM)
    low, high = STOP_BETWEEN
    manner = Manner(
        stop_at=low + (high - low) * stop_at if stops < behaviour.stop_share else DONE_PROGRESS,
        speed=1.0 - slow * behaviour.slow_max,
        grip_error=tuple(grip * behaviour.grip_max * directions[:3]),
    )
    return manner, (bias * behaviour.bias_max * directions[3:]).astype(np.float32)


_Job = tuple[Behaviour, range]


def _rollouts(job: _Job) -> Arrays:
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

    One of the episodes that were in the cache is run again, and compared.

    Returns:
        Arrays named as in `Recording`, each with a leading axis of length `n_episodes`.

    Raises:
        BadInput: `n_episodes` is below 1 or above `MAX_EPISODES`.
        ZestError: a process died, or the cache holds other episodes.
    """
    check_n_episodes(n_episodes)
    folder = behaviour_folder(behaviour)
    jobs = {}
    for part in chunks(n_episodes, EPISODES_PER_JOB):
        indices = range(first + part.start, first + part.stop)
        jobs[f"episodes-{indices.start}-{indices.stop}"] = (behaviour, indices)
    cache_folder("episodes")
    with artifacts.lock(folder):
        cache_folder("episodes", folder.name)  # here, because the command before may have removed it
        _check(folder, jobs)
        options: dict[str, Any] = {"n_workers": n_workers, "stage": "rolling out the expert", "layout": _layout}
        for name in cached_jobs(_rollouts, jobs, folder, **options):
            if on_progress is not None:
                on_progress(len(jobs[name][1]))
        return read_parts(folder, jobs, {name: _layout(job) for name, job in jobs.items()})


def _check(folder: Path, jobs: Mapping[str, _Job]) -> None:
    """Run one of the episodes in the cache again, and compare.

    Raises:
        ZestError: it is another; nothing is deleted, because either may be right.
    """
    kept = [name for name in jobs if (folder / f"{name}.npz").exists()]
    if not kept:
        return
    rng = np.random.default_rng()
    name = kept[rng.integers(len(kept))]
    behaviour, indices = jobs[name]
    i = int(rng.integers(len(indices)))
    if (cached := read_arrays(folder / f"{name}.npz", _layout(jobs[name]))) is None:
        return
    again = rollout(behaviour, indices[i])
    if not all(np.allclose(array[i], again[name][0], atol=1e-3) for name, array in cached.items()):
        raise ZestError(
            f"episodes in the cache {folder} are not those that this machine computes: its files were exchanged, or "
            "made on another one; delete that folder, then run the same command again"
        )


def _layout(job: _Job) -> Layout:
    n = len(job[1])
    frames, number = (n, HORIZON + 1), (np.float64, (n,))
    return {
        "obs": (np.float32, (*frames, OBS_DIM)),
        "actions": (np.float32, (n, HORIZON, ACT_DIM)),
        "qpos": (np.float64, (*frames, N_QPOS)),
        "qvel": (np.float64, (*frames, N_QVEL)),
        "gt_reward": (np.float32, frames),
        "gt_success": (np.bool_, frames),
        "seed": (np.int64, (n,)),
        "level": number,
        "stop_at": number,
        "speed": number,
    }


def remove_parts(behaviour: Behaviour) -> None:
    """Remove what `run_behaviour` kept, once no other command reads it."""
    folder = behaviour_folder(behaviour)
    if folder.exists():
        with artifacts.lock(folder):
            shutil.rmtree(folder, ignore_errors=True)


def behaviour_folder(behaviour: Behaviour) -> Path:
    """Where `run_behaviour` keeps finished parts."""
    files = [Path(__file__).with_name(name) for name in _CODE]
    if behaviour.policy.startswith("rl"):
        files += [Path(__file__).with_name("rl_expert.py"), weights_file(behaviour.task)]
    code = [artifacts.hash_file(path) for path in files]
    key = {**asdict(behaviour), "code": code, "versions": artifacts.versions()}
    return artifacts.cache_dir() / "episodes" / artifacts.hash_json(key)[:20]


def returns(episodes: Mapping[str, NDArray[Any]]) -> NDArray[np.float64]:
    """Ground-truth return of each episode: (N,)."""
    return np.asarray(episodes["gt_reward"][:, 1:].sum(axis=1, dtype=np.float64))


def recordings(episodes: Mapping[str, NDArray[Any]]) -> list[Recording]:
    """Turn stacked episodes into recordings for `zest_rl.data.writer.write_dataset`."""
    return [
        Recording(seed=int(seed), terminated=False, **{name: episodes[name][i] for name in _ARRAYS})
        for i, seed in enumerate(episodes["seed"])
    ]
