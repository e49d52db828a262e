"""Scripts that render with MuJoCo before zest_rl loads a network, each in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from zest_rl.runtime.gl import select_gl_backend

RENDER = """
import mujoco
model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><light/><geom size="1"/></worldbody></mujoco>')
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = mujoco.Renderer(model, 64, 64)
renderer.update_scene(data)
before = renderer.render()
"""
GYMNASIUM = """
import gymnasium, gymnasium_robotics
env = gymnasium.make("PointMaze_UMaze-v3", render_mode="rgb_array")
env.reset(seed=0)
env.render()
"""
SCORE = """
import numpy
import zest_rl
film = numpy.random.default_rng(0).integers(0, 256, (3, 32, 32, 3), numpy.uint8)
print(zest_rl.score(film, goal=film[2]).scores[-1].round(3))
import importlib.util
if importlib.util.find_spec("triton"):  # torch loads it when it compiles
    import triton
"""
AGAIN = """
renderer.update_scene(data)
assert (renderer.render() == before).all()
"""


@pytest.mark.parametrize(
    "script",
    [RENDER + SCORE + AGAIN, f"import zest_rl\n{RENDER}{SCORE}", GYMNASIUM + SCORE],
    ids=["mujoco, zest_rl", "zest_rl, mujoco, a score", "gymnasium_robotics, zest_rl"],
)
def test_a_script_may_render_before_a_network_is_loaded(script: str) -> None:
    select_gl_backend()
    command = [sys.executable, "-X", "faulthandler", "-c", script]
    done = subprocess.run(command, env=os.environ.copy(), capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "1.0\n"), done.stderr
