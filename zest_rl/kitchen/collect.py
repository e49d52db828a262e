"""Imperfect expert → a Minari dataset with successes and failures, at a chosen level of the expert's return.

As in the paper the expert's actions get uniform noise whose level is drawn per trajectory: episode i acts with
``clip(expert + U(−s_i, s_i))``, ``s_i = u_i · noise_max``, ``u_i ~ U(0, 1)``. The other ways to fall short, each drawn
per trajectory, too, are fields of `Behaviour`. Calibration moves one of them and looks at the returns of these very
episodes, never at a trained policy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from zest_rl.data.writer import Recording
from zest_rl.errors import BadInput, ZestError, nearest
from zest_rl.kitchen.env import ACT_DIM, ENV_ID, HORIZON
from zest_rl.kitchen.experts import DONE_PROGRESS, Manner, add_uniform_noise, make_expert
from zest_rl.kitchen.tasks import get_task
from zest_rl.metrics import statistics
from zest_rl.runtime import artifacts
from zest_rl.runtime.arrays import concatenate
from zest_rl.runtime.parallel import cached_jobs, chunks, read_parts
from zest_rl.types import FloatArray

EPISODES_PER_JOB = 5
REFERENCE_STREAM = 2**31
"""Episodes from this index on serve the reference returns; datasets stay below it."""
LARGEST = {"noise_max": 2.0, "stop_share": 1.0, "slow_max": 0.9, "bias_max": 1.0, "grip_max": 0.1}
"""Bounds of what makes an expert imperfect, and what can be calibrated."""
STOP_BETWEEN = (0.1, 1.0)
TOLERANCE = 0.5
"""Percent of the expert within which a calibrated dataset meets its level."""
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
    stop_share: float = 0.0
    """Share of the episodes in which the expert stops early, at a progress drawn from U(`STOP_BETWEEN`)."""
    slow_max: float = 0.0
    """The expert makes a share 1 − U(0, slow_max) of its movement at each step."""
    bias_max: float = 0.0
    """Largest constant error of an action: each component is off by U(−b, b) all episode, b ~ U(0, bias_max)."""
    grip_max: float = 0.0
    """Largest error of the grip, in m: it is off by U(−g, g) along each axis, g ~ U(0, grip_max)."""
    init_noise: float = 0.05
    """Half-width of the uniform noise on the arm's start, in rad."""
    seed: int = 0

    def __post_init__(self) -> None:
        get_task(self.task)
        for name, largest in LARGEST.items():
            if not 0 <= getattr(self, name) <= largest:
                raise BadInput(f"{name} must be in [0, {largest}], got {getattr(self, name)}")
        if self.policy not in ("expert", "nothing"):
            raise BadInput(f"policy must be 'expert' or 'nothing', got {self.policy!r}")
        if self.seed < 0:
            raise BadInput(f"seed must be 0 or positive, got {self.seed}")

    def without_flaws(self) -> Behaviour:
        """Return the same starts, acted on as well as can be."""
        values: dict[str, Any] = dict.fromkeys(LARGEST, 0.0)
        return replace(self, **values)

    def with_value(self, knob: str, value: float) -> Behaviour:
        """Return this behaviour with another value of one of `LARGEST`."""
        values: dict[str, Any] = {knob: value}
        return replace(self, **values)


def env_spec(task: str, init_noise: float = 0.05) -> gymnasium.envs.registration.EnvSpec:
    """Return the EnvSpec of a task; its JSON rebuilds the environment anywhere."""
    spec = gymnasium.spec(ENV_ID)
    return replace(spec, kwargs={"task": task, "init_noise": init_noise})


def rollout(behaviour: Behaviour, index: int) -> Arrays:
    """Run episode `index` of a behaviour: arrays named as in `Recording`, with a leading axis of length 1."""
    env_seed, noise_seed, manner_seed = np.random.SeedSequence([behaviour.seed, index]).generate_state(3)
    rng = np.random.default_rng(noise_seed)
    level = rng.uniform() * behaviour.noise_max
    manner, bias = draw_manner(behaviour, np.random.default_rng(manner_seed))
    env = gymnasium.make(env_spec(behaviour.task, behaviour.init_noise))
    expert = make_expert(behaviour.task, env, manner)
    steps: dict[str, list[Any]] = {name: [] for name in ("obs", "actions", "qpos", "qvel", "gt_reward", "gt_success")}

    def record(obs: FloatArray, info: dict[str, Any]) -> None:
        steps["obs"].append(obs)
        steps["qpos"].append(info["state"]["qpos"])
        steps["qvel"].append(info["state"]["qvel"])
        steps["gt_reward"].append(info["gt"]["reward"])
        steps["gt_success"].append(info["gt"]["success"])

    record(*env.reset(seed=int(env_seed)))
    for _ in range(HORIZON):
        action = expert.act() + bias if behaviour.policy == "expert" else np.zeros(ACT_DIM, np.float32)
        steps["actions"].append(add_uniform_noise(action, level, rng))
        obs, _, _, _, info = env.step(steps["actions"][-1])
        record(obs, info)
    env.close()
    episode = {name: np.stack(values)[None] for name, values in steps.items()}
    drawn = {"level": level, "stop_at": manner.stop_at, "speed": manner.speed}
    return {
        **episode,
        "seed": np.array([env_seed], dtype=np.int64),
        **{name: np.array([value]) for name, value in drawn.items()},
    }


def draw_manner(behaviour: Behaviour, rng: np.random.Generator) -> tuple[Manner, FloatArray]:
    """Draw how the expert acts in one episode, and the constant error (9,) float32 of its actions.

    Every number is drawn whether it is used or not, so that an episode's draws do not depend on which ways to fall
    short are switched on, nor on how far: what is calibrated moves each episode along a line.
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
    for name in cached_jobs(_rollouts, jobs, folder, n_workers=n_workers):
        if on_progress is not None:
            on_progress(len(jobs[name][1]))
    return read_parts(folder, jobs)


def behaviour_folder(behaviour: Behaviour) -> Path:
    """Where `run_behaviour` keeps finished parts."""
    code = [
        artifacts.hash_file(Path(__file__).with_name(name)) for name in ("collect.py", "env.py", "arm.py", "experts.py")
    ]
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
            replace(behaviour.without_flaws(), policy=policy),
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
    knob: str,
    n_episodes: int,
    references: References,
    target: float,
    *,
    tolerance: float = TOLERANCE,
    n_rounds: int = 12,
    n_workers: int | None = None,
    on_round: Callable[[float, float], None] | None = None,
) -> Behaviour:
    """Find the value of one field of a behaviour at which its episodes' mean normalized return meets `target`.

    The level falls as the value rises. Tried are the value where a straight line between the two nearest levels known
    meets the target (kept off both ends), and twice the value while none was low enough.

    Args:
        behaviour: what acts; its field `knob` is ignored.
        knob: a key of `LARGEST`.
        n_episodes: the dataset's size; the very episodes of the dataset are used.
        references: the two ends of the scale.
        target: percent of the expert, e.g. 81.19.
        tolerance: stop within this many percent.
        n_rounds: at most so many tries.
        n_workers: processes, default one per core.
        on_round: called with (value, percent) after each.

    Raises:
        BadInput: `target` is not in (0, 100], or `knob` is not one that can be calibrated.
        ZestError: no value within `tolerance` was found.
    """
    if not 0 < target <= 100:
        raise BadInput(f"the level to calibrate to must be in (0, 100] percent of the expert, got {target}")
    if knob not in LARGEST:
        raise BadInput(f"{knob!r} cannot be calibrated; {nearest(knob, LARGEST)}")
    below, above = (0.0, 100.0), None  # (value, level) next to the target
    only_flaw = behaviour.with_value(knob, 0.0) == behaviour.without_flaws()
    value = 0.3 * LARGEST[knob] if only_flaw else 0.0  # with no other flaw the level at 0 is the expert's
    for _ in range(n_rounds):
        tried = behaviour.with_value(knob, round(value, 4))
        episodes = run_behaviour(tried, n_episodes, n_workers=n_workers)
        level = float(statistics.normalized_return(returns(episodes), references.minimum, references.expert).mean())
        if on_round is not None:
            on_round(getattr(tried, knob), level)
        if abs(level - target) <= tolerance:
            return tried
        if value == (LARGEST[knob] if level > target else 0.0):
            break  # no further to go
        if level > target:
            below = (value, level)
        else:
            above = (value, level)
        if above is None:
            value = min(2 * value or 0.3 * LARGEST[knob], LARGEST[knob])
        else:
            share = (below[1] - target) / (below[1] - above[1]) if below[1] > above[1] else 0.5
            value = below[0] + np.clip(share, 0.1, 0.9) * (above[0] - below[0])
    raise ZestError(
        f"no {knob} in [0, {LARGEST[knob]}] brings the dataset to {target} ± {tolerance} % of the expert (the last "
        f"try, {getattr(tried, knob)}, gave {level:.2f} %); collect more episodes or choose it by hand"
    )


def recordings(episodes: Mapping[str, NDArray[Any]]) -> list[Recording]:
    """Turn stacked episodes into what `zest_rl.data.writer.write_dataset` takes."""
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
