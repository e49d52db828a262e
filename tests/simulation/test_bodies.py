"""Robot and object of real environments and of small models, found by rule."""

from __future__ import annotations

from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import gymnasium
import gymnasium_robotics  # noqa: F401  # registers its environments
import mujoco
import numpy as np
import pytest

from zest_rl.errors import BadInput, Notice
from zest_rl.simulation.bodies import Bodies, body_name, joint_travel, moved_body, robot_bodies

TWO_BLOCKS = """
<mujoco>
  <worldbody>
    <body name="room">
      <geom type="box" size="2 2 .01"/>
      <body name="pedestal">
        <geom type="box" size=".1 .1 .2"/>
        <body name="arm"><joint name="turn" axis="0 0 1"/><geom size=".05"/>
          <body name="finger"><joint name="bend"/><geom size=".02"/></body>
        </body>
      </body>
      <body name="drawer" pos="1 0 0"><joint name="pull" type="slide" axis="1 0 0"/><geom size=".1"/></body>
      <body name="dial" pos="0 1 0"><joint name="dial" axis="0 1 0"/><geom size=".2"/></body>
    </body>
  </worldbody>
  <actuator>{actuator}</actuator>
</mujoco>
"""


def model_of(env_id: str) -> mujoco.MjModel:
    env: Any = gymnasium.make(env_id)
    return env.unwrapped.model


@pytest.fixture(scope="module")
def blocks() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(TWO_BLOCKS.format(actuator='<motor joint="turn"/>'))


def names(model: mujoco.MjModel, bodies: Bodies) -> set[str]:
    return {body_name(model, int(body)) for body in np.flatnonzero(bodies)}


@pytest.mark.parametrize(
    ("env_id", "left"),
    [
        ("AdroitHandDoor-v1", {"world", "table", "frame", "door", "latch"}),
        ("FetchPush-v4", {"world", "floor0", "table0", "object0"}),
        ("PointMaze_UMaze-v3", {"world"}),
        ("HalfCheetah-v5", {"world"}),
    ],
)
def test_what_is_driven_is_the_robot_with_its_mounts(env_id: str, left: set[str]) -> None:
    model = model_of(env_id)
    assert names(model, ~robot_bodies(model)) == left


def test_a_mount_is_the_robots_as_far_as_nothing_else_that_moves_hangs_on_it(blocks: mujoco.MjModel) -> None:
    assert names(blocks, robot_bodies(blocks)) == {"pedestal", "arm", "finger"}


def test_a_tendon_and_a_site_drive_what_they_act_on() -> None:
    text = TWO_BLOCKS.replace('<geom size=".02"/>', '<geom size=".02"/><site name="tip"/>')
    tendon = '<tendon><fixed name="pulley"><joint joint="bend" coef="1"/></fixed></tendon>'
    by_tendon = text.replace("</worldbody>", f"</worldbody>{tendon}").format(actuator='<motor tendon="pulley"/>')
    for xml in (by_tendon, text.format(actuator='<adhesion body="arm" ctrlrange="0 1"/>')):
        model = mujoco.MjModel.from_xml_string(xml)
        assert names(model, robot_bodies(model)) == {"pedestal", "arm", "finger"}


def test_without_anything_driven_there_is_no_robot() -> None:
    model = mujoco.MjModel.from_xml_string(TWO_BLOCKS.format(actuator=""))
    assert not robot_bodies(model).any()


def at_rest(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data


def test_an_angle_counts_by_the_reach_of_what_it_turns(blocks: mujoco.MjModel) -> None:
    qpos = np.zeros((3, 4))
    qpos[1] = [0.0, 0.0, 0.1, -0.5]  # turn, bend, pull, dial
    travel = joint_travel(blocks, at_rest(blocks), qpos)
    np.testing.assert_allclose(travel, [0, 0, 0.1, 0.5 * 0.2])


def test_the_farthest_is_looked_at_and_the_robot_never_is(blocks: mujoco.MjModel) -> None:
    body = moved_body(blocks, np.array([9.0, 9.0, 0.2, 0.1]), robot_bodies(blocks))
    assert body_name(blocks, body) == "drawer"


def test_a_free_and_a_ball_joint_move_by_where_they_get() -> None:
    xml = """<mujoco><worldbody>
      <body name="block"><freejoint/><geom size=".1"/></body>
      <body name="ball" pos="1 0 0"><joint type="ball"/><geom size=".1"/></body>
    </worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    qpos = np.stack([model.qpos0, model.qpos0])
    qpos[1, :3] += [0.3, 0, 0.4]
    qpos[1, 7:] = [np.cos(0.5), np.sin(0.5), 0, 0]  # by one rad
    np.testing.assert_allclose(joint_travel(model, at_rest(model), qpos), [0.5, 0.1])


@pytest.mark.parametrize(
    ("travel", "message"),
    [
        ([1, 1, 0.2, 0.19], r"drawer and dial move alike \(drawer 0.200 m, dial 0.190 m\); name .*--look-at BODY"),
        ([1, 1, 0, 0], r"nothing moves by 0.001 m \(drawer 0.000 m, dial 0.000 m\); name what to look at"),
    ],
)
def test_what_cannot_be_told_is_asked(blocks: mujoco.MjModel, travel: list[float], message: str) -> None:
    with pytest.raises(BadInput, match=message):
        moved_body(blocks, np.array(travel), robot_bodies(blocks))


def test_an_only_object_that_never_moves_is_told(blocks: mujoco.MjModel) -> None:
    others = robot_bodies(blocks)
    others[blocks.body("dial").id] = True
    with pytest.warns(
        Notice, match=r"drawer is looked at, the only object, but no recorded episode moves it by 0.001 m"
    ):
        assert body_name(blocks, moved_body(blocks, np.zeros(4), others)) == "drawer"


def test_without_an_unactuated_joint_there_is_no_object() -> None:
    model = model_of("HalfCheetah-v5")
    with pytest.raises(BadInput, match=r"all joints of the model belong to the robot; keep the robot in view"):
        moved_body(model, np.ones(model.njnt), robot_bodies(model))
