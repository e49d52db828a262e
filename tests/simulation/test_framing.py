"""Rings of views round an object that a scene may hide."""

from __future__ import annotations

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import mujoco
import numpy as np
import pytest

from zest_rl.simulation.framing import ObjectRing, azimuth_of, extent

RING = ObjectRing(azimuth=90.0, radius=0.5, n_views=4)


def test_a_ring_spreads_to_either_side_of_the_robot_as_far_away_as_the_object_is_large() -> None:
    cameras = RING.cameras((1.0, 2.0, 3.0))
    assert [camera.azimuth for camera in cameras] == [60, 80, 100, 120]
    assert [camera.elevation for camera in cameras] == [-15, -20, -30, -15]
    assert {camera.lookat for camera in cameras} == {(1.0, 2.0, 3.0)}
    aside = ObjectRing(90.0, 0.5, 4, offset=(0.0, -0.5, 0.1)).cameras((1.0, 2.0, 3.0))
    assert {camera.lookat for camera in aside} == {(1.0, 1.5, 3.1)}
    far = ObjectRing(90.0, 1.0, 4).cameras((0.0, 0.0, 0.0))
    assert [camera.distance for camera in far] == [2 * camera.distance for camera in cameras]


def test_views_from_which_the_scene_hides_the_object_are_left_out() -> None:
    ring = RING.that_sees(lambda ring: np.array([1.0, 0.9, 0.3, 0.6]))
    assert (ring.lift, ring.dropped) == (0.0, (2,))
    assert [camera.azimuth for camera in ring.cameras((0.0, 0.0, 0.0))] == [60, 80, 120]


def test_a_ring_is_lifted_until_half_of_its_views_see_the_object() -> None:
    seen = {0.0: [0.1, 0.1, 0.1, 0.8], 15.0: [0.2, 0.7, 0.1, 0.9], 30.0: [1.0, 1.0, 1.0, 1.0]}
    ring = RING.that_sees(lambda ring: np.array(seen[ring.lift]))
    assert (ring.lift, ring.dropped) == (15.0, (0, 2))
    assert {camera.elevation for camera in ring.cameras((0.0, 0.0, 0.0))} == {-35, -30}


def test_where_no_view_sees_the_object_none_is_left_out() -> None:
    assert RING.that_sees(lambda ring: np.zeros(4)) == RING


def test_the_box_round_an_object_holds_its_geoms_however_they_are_turned() -> None:
    geoms = '<geom type="box" size=".3 .1 .2" euler="0 0 90"/><geom type="sphere" size=".1" pos="0 0 1"/>'
    xml = f'<mujoco><worldbody><body name="it" pos="1 0 0">{geoms}</body></worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(extent(model, data, model.body("it").id), [[0.9, -0.3, -0.2], [1.1, 0.3, 1.1]])


@pytest.mark.parametrize(("ways", "azimuth"), [([(0, 1)], 90), ([(1, 1), (1, -1)], 0), ([(0, 0)], 90)])
def test_the_azimuth_leads_from_the_robot_to_the_object(ways: list[tuple[int, int]], azimuth: float) -> None:
    assert azimuth_of([np.array(way, float) for way in ways]) == pytest.approx(azimuth)
