"""Models in which a robot and an object cannot be told, or that cannot be made: each has its own error."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import numpy as np
import pytest
from rollouts import Run

from zest_rl.errors import BadInput, ZestError
from zest_rl.simulation.makers import make_named
from zest_rl.simulation.recorder import Recorder
from zest_rl.sources import open_source

MODULE = """
import gymnasium, mujoco, numpy as np

class Blocks(gymnasium.Env):
    observation_space = action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    def __init__(self, xml):
        self.model = mujoco.MjModel.from_xml_string(xml)
        self.data = mujoco.MjData(self.model)
    def reset(self, *, seed=None, options=None):
        mujoco.mj_resetData(self.model, self.data)
        return np.zeros(1, np.float32), {}
    def step(self, action):
        self.data.qpos[:] += action[0]
        return np.zeros(1, np.float32), 0.0, False, False, {}

def block(name, inside=""):
    return f'<body name="{name}"><joint name="{name}" type="slide"/><geom size=".1"/>{inside}</body>'

def model(world, rest=""):
    return Blocks(f"<mujoco><worldbody>{world}</worldbody>{rest}</mujoco>")

ARM = '<actuator><motor joint="arm"/></actuator>'
def pushing(): return model(block("arm") + block("box"), ARM)
def undriven(): return model(block("arm") + block("box"))
def alike(): return model(block("arm") + block("box") + block("ball"), ARM)
def alone(): return model(block("arm"), ARM)
def taller(): return model(block("arm") + block("box") + '<body name="shelf"><geom size=".2"/></body>', ARM)
def frame(): return model(block("arm") + block("box") + '<body name="frame"/>', ARM)
def meshless(): return model(block("box"), '<asset><mesh name="m" file="gone.stl"/></asset>')
def pole(): return gymnasium.make("CartPole-v1")
def sized(size): return pushing()
def nothing(): return None
value = 3
"""


@pytest.fixture
def blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A module of environments, by the name that a user gives."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "blocks.py").write_text(MODULE, encoding="utf-8")
    sys.modules.pop("blocks", None)
    return "blocks"


def record(make: str, *, moves_bodies: bool = False) -> str:
    env = Recorder(make_named(f"blocks:{make}"))
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.array([0.1], np.float32))
    if moves_bodies:
        env._bare.model.body_pos[:] += 0.1
        env.step(np.array([0.1], np.float32))
    env.write(f"blocks/{make}-v0")
    return f"blocks/{make}-v0"


@pytest.mark.parametrize(
    ("make", "options", "message"),
    [
        ("undriven", {}, "found by what drives it, but blocks:undriven has no actuated joint"),
        ("alone", {}, "the object is the body of an unactuated joint, but all joints of the model belong to the robot"),
        ("alike", {}, r"box and ball move alike \(box 0.300 m, ball 0.300 m\); name what to look at with --look-at"),
        ("frame", {"look_at": "frame"}, "--look-at: 'frame' has no geoms, so there is nothing to see"),
    ],
)
def test_a_scene_that_cannot_be_told_is_refused(blocks: str, make: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(BadInput, match=message):
        open_source(record(make), env=f"{blocks}:{make}", **options)


@pytest.mark.parametrize(
    ("make", "kind", "message"),
    [
        ("pole", BadInput, "blocks:pole has no MuJoCo model to render; give --frames FOLDER"),
        ("meshless", ZestError, r"blocks:meshless cannot be made here .*gone\.stl"),
        ("sized", BadInput, r"sized\(size\) must be called without arguments"),
        ("nothing", BadInput, "--env blocks:nothing must return a gymnasium.Env, got NoneType; return the environment"),
        ("value", BadInput, r"blocks \(.*blocks\.py\) has no function 'value'"),
        ("taller", BadInput, "body_pos must hold 12 numbers for blocks:taller, got 9; install the version"),
    ],
)
def test_an_environment_that_cannot_be_made_or_is_another_one_is_refused(
    blocks: str, make: str, kind: type[Exception], message: str
) -> None:
    dataset = record("pushing", moves_bodies=True)
    with pytest.raises(kind, match=message):
        open_source(dataset, env=f"{blocks}:{make}")


def test_a_function_that_makes_an_environment_is_refused_where_none_is_made(pictured: str) -> None:
    with pytest.raises(BadInput, match="--env makes the environment of a Minari dataset's recorded states"):
        open_source(pictured, frames=["observations/cameras/top"], env="blocks:pushing")


def test_models_that_are_told_are_seen_by_the_command(blocks: str, goal: Path, zest: Run) -> None:
    words = ("relabel", record("pushing"), "--env", "blocks:pushing", "--goal", goal, "--views", 2)
    preview = zest(*words, "--preview", "look.png")
    assert Path(preview["preview"]).stat().st_size > 1000
    assert sorted(preview["next"].split()) == sorted(["zest", *map(str, words)])
