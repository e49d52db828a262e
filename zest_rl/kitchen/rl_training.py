"""How the experts of ``experts_rl/`` were trained: ``python -m zest_rl.kitchen.rl_training sdoor --seed 0``.

Soft actor-critic (Haarnoja et al. 2018) by stable-baselines3 on the ground truth, with a reaching term that leads the
hand to the contact. The network that solves most of 20 starts, and of these the one with the largest return, is kept
and judged on 100 others. The result is the same for the same seed, versions and processor, also where the training was
killed: the same command goes on from ``TASK.checkpoint.npz``, which holds all that changes, as arrays.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import gymnasium
import numpy as np

from zest_rl.errors import BadInput, ZestError
from zest_rl.kitchen.env import ARM_DIM, HORIZON, KitchenEnv, env_spec
from zest_rl.kitchen.experts import kitchen_of
from zest_rl.kitchen.rl_expert import FEATURE_DIM, WEIGHTS, RLExpert, Senses, Weights
from zest_rl.kitchen.tasks import SUCCESS_PROGRESS, TASKS
from zest_rl.runtime import artifacts
from zest_rl.runtime.arrays import read_arrays, write_arrays
from zest_rl.runtime.records import from_json, reading_record
from zest_rl.types import FloatArray

N_STEPS = 40_000
CHECK_EVERY = 2_500
ENOUGH = 3
"""Training ends early when all starts are solved at so many checks in a row."""
CHECK_STARTS, TEST_STARTS = range(10_000, 10_020), range(20_000, 20_100)
SAC: dict[str, Any] = {
    "gamma": 0.97,
    "n_steps": 3,
    "learning_rate": 7e-4,
    "learning_starts": 1000,
    "target_entropy": -4.0,  # with the usual -9 the exploration ends before the hand finds the handle
    "policy_kwargs": {"net_arch": [128, 128]},
}
"""Arguments of stable-baselines3's SAC that are not its defaults."""


class ShapedKitchen(gymnasium.Wrapper[FloatArray, FloatArray, FloatArray, FloatArray]):
    """The kitchen as the expert sees it, with the reward that it is trained on."""

    def __init__(self, task: str) -> None:
        super().__init__(gymnasium.make(env_spec(task)))
        self.kitchen: KitchenEnv = kitchen_of(task, self.env)
        self._senses = Senses(self.kitchen)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (FEATURE_DIM,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[FloatArray, Any]:
        """Start an episode."""
        self.before_reset = self.kitchen.np_random.bit_generator.state  # from which this episode can be started again
        _, info = self.env.reset(seed=seed, options=options)
        return self._senses.features(), info

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Advance by 80 ms."""
        _, _, terminated, truncated, info = self.env.step(action)
        distance, behind = float(np.linalg.norm(self._senses.gap())), self._senses.way_behind_door()
        reward = shaped_reward(self.kitchen.progress, distance, action, behind)
        return self._senses.features(), reward, terminated, truncated, info


def shaped_reward(progress: float, distance: float, action: FloatArray, behind: float | None = None) -> float:
    """Return the progress and more for its beginning and its end, for nearness (m) to the contact, and for calm.

    The term of the distance falls everywhere, since a hand far away must be led, and is steep near the contact. It
    fades as the part begins to move. From then on the way round the edge of a door counts likewise: a door that is ajar
    is best pushed from inside, away from its bar.

    Args:
        progress: of the task's joint.
        distance: from the tip to the contact, in m.
        action: (9,).
        behind: how far the tip must go to push a door from inside, in m.
    """
    progress = min(max(progress, 0.0), 1.03)
    moved = 0.3 * (1.0 - np.exp(-progress / 0.05))
    done = 0.5 * (progress >= SUCCESS_PROGRESS)
    near = 0.3 * (1.0 + max(0.0, 1.0 - progress / 0.3) * (_nearness(distance) - 1.0))
    inside = 0.3 * (1.0 + _nearness(behind)) if behind is not None else 0.0
    calm = -0.02 * np.square(action[:ARM_DIM]).mean()
    return float(progress + moved + done + near + inside + calm)


def _nearness(distance: float) -> float:
    return float(1.0 - np.tanh(distance / 0.1) - 1.5 * distance)


def measure(weights: Weights, task: str, starts: range) -> tuple[float, float]:
    """Return success and mean ground-truth return of the expert's mean actions from `starts`, seeds of the kitchen."""
    env = gymnasium.make(env_spec(task))
    expert = RLExpert(kitchen_of(task, env), weights)
    successes, returns = [], []
    for start in starts:
        env.reset(seed=start)
        infos = [env.step(expert.act())[-1]["gt"] for _ in range(HORIZON)]
        successes.append(any(info["success"] for info in infos))
        returns.append(sum(float(info["reward"]) for info in infos))
    env.close()
    return float(np.mean(successes)), float(np.mean(returns))


@dataclass
class Progress:
    """How far a training has come, besides what its networks have learned."""

    seed: int
    n_steps: int
    """Asked for."""
    step: int = 0
    """Done."""
    solved: int = 0
    """Checks in a row at which all starts were solved."""
    best: tuple[float, float] = (-1.0, 0.0)
    """Success and return of the weights that are kept."""
    kept_at: int = 0
    """Step."""
    seconds: float = 0.0


def train(task: str, seed: int, n_steps: int, folder: Path) -> dict[str, Any]:
    """Train an expert, or go on with a training that was killed; write the weights, and last the record of them.

    ``folder/TASK.safetensors`` is written whenever it is better than before.

    Returns:
        The record, as in ``folder/TASK.json``.

    Raises:
        BadInput: the folder has a checkpoint of another seed or number of steps.
        ZestError: stable-baselines3 is not installed, or the checkpoint is damaged.
    """
    try:
        from stable_baselines3 import SAC as SoftActorCritic
        from stable_baselines3.common.logger import Logger
    except ImportError as error:
        raise ZestError("experts are trained by stable-baselines3; run: pip install 'zest-rl[rl]'") from error
    import torch
    from safetensors.numpy import save

    torch.set_num_threads(1)  # networks this small are not faster with more
    env, checkpoint = ShapedKitchen(task), folder / f"{task}.checkpoint.npz"
    model = SoftActorCritic("MlpPolicy", env, seed=seed, device="cpu", buffer_size=n_steps + 1, **SAC)
    model.set_logger(Logger(None, []))  # its own would leave a folder in the system's temporary one at each `learn`
    progress, kept = Progress(seed, n_steps), dict[str, FloatArray]()
    if checkpoint.exists():
        progress, kept = _resume(checkpoint, model, env, progress)
        print(f"{task}: goes on after {progress.step} steps", file=sys.stderr, flush=True)
    start = time.monotonic() - progress.seconds
    while progress.step + CHECK_EVERY <= n_steps and progress.solved < ENOUGH:
        model.learn(CHECK_EVERY, reset_num_timesteps=False)
        progress.step += CHECK_EVERY
        weights = {name: tensor.numpy().copy() for name, tensor in model.actor.state_dict().items()}
        found = measure(weights, task, CHECK_STARTS)
        progress.seconds = time.monotonic() - start
        print(f"{task}: {progress.step} steps, {progress.seconds:.0f} s: success {found[0]:.0%}, return {found[1]:.2f}",
              file=sys.stderr, flush=True)  # fmt: skip
        if found > progress.best:
            progress.best, progress.kept_at, kept = found, progress.step, weights
            artifacts.write_bytes(folder / f"{task}.safetensors", save(kept))
        progress.solved = progress.solved + 1 if found[0] == 1.0 else 0
        _save(checkpoint, model, env, progress, kept)
    success, episode_return = measure(kept, task, TEST_STARTS)
    record = {
        "task": task,
        "command": f"python -m zest_rl.kitchen.rl_training {task} --seed {seed} --steps {n_steps}",
        "seed": seed,
        "kept_at_step": progress.kept_at,
        "wall_seconds": round(time.monotonic() - start),
        "n_starts": len(TEST_STARTS),
        "success": success,
        "return": round(episode_return, 2),
        "weights_sha256": artifacts.hash_arrays(*(kept[name] for name in sorted(kept))),
        "versions": {name: version(name) for name in ("stable-baselines3", "torch", "mujoco", "gymnasium", "numpy")},
        "revision": artifacts.git_revision(),
    }
    artifacts.write_json(folder / f"{task}.json", record)
    checkpoint.unlink(missing_ok=True)
    return record


def _save(path: Path, model: Any, env: ShapedKitchen, progress: Progress, kept: Weights) -> None:
    """Write a checkpoint at the start of an episode, as every check is: episodes have `HORIZON` steps."""
    import torch

    from zest_rl.runtime.learner_state import state_of

    _, key, *numpy = np.random.get_state()  # noqa: NPY002  (stable-baselines3 draws from it)
    told = {
        "progress": asdict(progress),
        "generators": {"kitchen": env.before_reset, "actions": model.action_space.np_random.bit_generator.state},
        "numpy": numpy,
    }
    arrays = {f"model/{name}": array for name, array in state_of(model).items()}
    arrays |= {f"kept/{name}": array for name, array in kept.items()}
    arrays |= {"torch": torch.get_rng_state().numpy(), "numpy": np.asarray(key)}
    write_arrays(path, {**arrays, "told": np.frombuffer(json.dumps(told).encode(), np.uint8)})


def _resume(path: Path, model: Any, env: ShapedKitchen, asked: Progress) -> tuple[Progress, dict[str, FloatArray]]:
    """Restore a new model, its environment and all random generators; return the progress and the weights kept."""
    import torch

    from zest_rl.runtime.learner_state import restore

    advice = "delete it, and the training starts anew"
    arrays = read_arrays(path)
    if arrays is None:
        raise ZestError(f"{path} is damaged; {advice}")

    def part(prefix: str) -> dict[str, Any]:
        return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}

    with reading_record(path, advice):
        told = json.loads(arrays["told"].tobytes())
        progress = from_json(Progress, told["progress"])
        if (progress.seed, progress.n_steps) != (asked.seed, asked.n_steps):
            raise BadInput(
                f"{path} is of a training that was cut short, with --seed {progress.seed} --steps {progress.n_steps}, "
                f"but --seed {asked.seed} --steps {asked.n_steps} is asked for; ask for the same, or {advice}"
            )
        restore(model, part("model/"))
        model.get_env().reset()  # uses up the seed, so that the next one draws from the generator
        env.kitchen.np_random.bit_generator.state = told["generators"]["kitchen"]
        model.action_space.np_random.bit_generator.state = told["generators"]["actions"]
        torch.set_rng_state(torch.from_numpy(arrays["torch"]))
        np.random.set_state(("MT19937", arrays["numpy"], *told["numpy"]))  # noqa: NPY002
    return progress, part("kept/")


def main() -> None:
    """Train one expert and print its record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=list(TASKS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=N_STEPS, help=f"default {N_STEPS}")
    parser.add_argument("--output", type=Path, default=WEIGHTS, help="folder of the weights; default the package's own")
    arguments = parser.parse_args()
    print(json.dumps(train(arguments.task, arguments.seed, arguments.steps, arguments.output), indent=2))


if __name__ == "__main__":
    main()
