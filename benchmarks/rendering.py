"""CPU time per 224x224 kitchen frame: `zest_rl.kitchen.scene` against ``env.render()`` of gymnasium-robotics.

Both draw on the same machine, in the same process, with the same GL backend. The clock is the processor time of all
threads of the process, because software GL may spread a frame over several cores.
"""

from __future__ import annotations

import time

import gymnasium
import gymnasium_robotics
import numpy as np
from numpy.typing import NDArray

from zest_rl.kitchen.scene import N_QPOS, RenderConfig, open_renderer, task_cameras
from zest_rl.kitchen.tasks import TASKS
from zest_rl.runtime.gl import select_gl_backend

SIZE = 224
REQUIRED_RATIO = 100.0
N_PEER_FRAMES = 5
N_STATES = 8


def peer_ms() -> tuple[float, NDArray[np.float64]]:
    """Return cpu-ms per frame of ``env.render()``, and the (N_STATES, 30) states of a random rollout."""
    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make("FrankaKitchen-v1", render_mode="rgb_array", width=SIZE, height=SIZE, disable_env_checker=True)
    env.reset(seed=0)
    env.action_space.seed(0)
    env.render()  # the first frame pays for the GL context
    states, seconds = [], 0.0
    for step in range(N_STATES):
        env.step(env.action_space.sample())
        states.append(env.unwrapped.data.qpos.copy())
        if step < N_PEER_FRAMES:
            start = time.process_time()
            env.render()
            seconds += time.process_time() - start
    env.close()
    return 1e3 * seconds / N_PEER_FRAMES, np.stack(states)


def ours_ms(config: RenderConfig, states: NDArray[np.float64]) -> float:
    """Return cpu-ms per frame over all tasks' cameras: 24 views of each state (S, 30), with the objects moving."""
    cameras = tuple(camera for task in TASKS.values() for camera in task_cameras(task, 4))
    with open_renderer(config, cameras) as renderer:
        renderer.render(np.zeros(N_QPOS))
        start = time.process_time()
        for state in states:
            renderer.render(state)
        seconds = time.process_time() - start
    return 1e3 * seconds / (len(states) * len(cameras))


def run() -> dict[str, object]:
    """Return cpu-ms per frame of both renderers, their ratios, and whether the required ratio is met."""
    backend = select_gl_backend()
    peer, states = peer_ms()
    states[:, 22] = np.linspace(0, TASKS["micro"].goal, len(states))  # the microwave opens
    hidden = ours_ms(RenderConfig(size=SIZE), states)
    shown = ours_ms(RenderConfig(size=SIZE, robot=True), states)
    return {
        "gl_backend": backend,
        "env_render_cpu_ms": round(peer, 1),
        "robot_hidden_cpu_ms": round(hidden, 2),
        "robot_shown_cpu_ms": round(shown, 2),
        "robot_hidden_ratio": round(peer / hidden, 1),
        "robot_shown_ratio": round(peer / shown, 1),
        "required_ratio": REQUIRED_RATIO,
        "passed": peer / hidden >= REQUIRED_RATIO,
    }
