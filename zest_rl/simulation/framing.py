"""Where to look from: a ring of views round an object, from the side on which the robot works, sized by the object."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import mujoco
import numpy as np
from numpy.typing import NDArray

from zest_rl.simulation.bodies import Bodies, subtree
from zest_rl.simulation.rendering import HIDDEN_GROUP, Camera, Canvas
from zest_rl.simulation.views import ring

Point = tuple[float, float, float]
_DRAWN_GROUPS = 3
_SPREAD = 30.0  # degrees to either side
_ELEVATIONS = (-15.0, -20.0, -30.0)  # degrees
_DISTANCES = (2.6, 1.8, 3.6)
"""In units of the ring's radius: that of the kitchen's doors is 0.385 m (median), which 1, 0.7 and 1.4 m suit."""
_SEEN = 0.5  # of the object; a view that sees less shows the scene rather than the object
_LIFTS = (0.0, 15.0, 30.0, 45.0)  # degrees by which a ring is lifted until half of its views see the object


@dataclass(frozen=True)
class ObjectRing:
    """Views round an object, without those from which it is hidden."""

    azimuth: float
    """In degrees, of the view from behind the robot; 90 looks along +y."""
    radius: float
    """Half of the diagonal of the box round the object and the way that it goes, in metres."""
    n_views: int
    offset: Point = (0.0, 0.0, 0.0)
    """From the middle of the object in x_0 to the middle of that box, in metres."""
    lift: float = 0.0
    """Degrees by which the cameras look down more steeply."""
    dropped: tuple[int, ...] = ()
    """Indices of the views that are not drawn."""

    def cameras(self, lookat: Point) -> tuple[Camera, ...]:
        """Return the cameras for an object whose middle is at a point in x_0."""
        (x, y, z), (dx, dy, dz) = lookat, self.offset
        views = ring(
            (x + dx, y + dy, z + dz),
            self.n_views,
            azimuths=(self.azimuth - _SPREAD, self.azimuth + _SPREAD),
            distances=[self.radius * share for share in _DISTANCES],
            elevations=[elevation - self.lift for elevation in _ELEVATIONS],
        )
        return tuple(view for index, view in enumerate(views) if index not in self.dropped)

    def that_sees(self, seen_shares: Callable[[ObjectRing], NDArray[np.float64]]) -> ObjectRing:
        """Return the ring without the views from which the scene hides the object, lifted where these are the most.

        Args:
            seen_shares: ring → (V,) the share of the object that each view sees, in [0, 1].
        """
        lifted = [replace(self, lift=lift) for lift in _LIFTS]
        shares = list[NDArray[np.float64]]()
        while len(shares) < len(lifted) and not (shares and (shares[-1] >= _SEEN).mean() >= 0.5):
            shares.append(seen_shares(lifted[len(shares)]))
        best = int(np.argmax([share.mean() for share in shares]))
        return replace(lifted[best], dropped=hidden_views(shares[best]))


def hidden_views(shares: NDArray[np.float64]) -> tuple[int, ...]:
    """Return the views from which the scene hides an object: that see less than half of what the best view sees.

    Args:
        shares: (V,) the share of the object that each view sees, of what it would see of the object alone.
    """
    return tuple(np.flatnonzero(shares < _SEEN * shares.max()).tolist())


def seen_shares(
    canvas: Canvas, model: mujoco.MjModel, data: mujoco.MjData, geoms: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Return which share of some geoms each camera sees, of what it would see of them alone: (V,) in [0, 1].

    1 where they are out of sight for other reasons. Afterwards the model's other geoms are hidden (`HIDDEN_GROUP`).
    """
    in_scene = np.isin(canvas.segments(data), geoms).sum(axis=(1, 2))
    model.geom_group[np.setdiff1d(np.arange(model.ngeom), geoms)] = HIDDEN_GROUP
    alone = np.isin(canvas.segments(data), geoms).sum(axis=(1, 2))
    return np.where(alone > 0, in_scene / np.maximum(alone, 1), 1.0)


def drawn_geoms(model: mujoco.MjModel, bodies: Bodies) -> NDArray[np.intp]:
    """Return the geoms of some bodies that are drawn, or all of them if none is."""
    geoms = np.flatnonzero(bodies[model.geom_bodyid])
    shown = geoms[(model.geom_group[geoms] < _DRAWN_GROUPS) & (model.geom_rgba[geoms, 3] > 0)]
    return shown if len(shown) else geoms


def object_geoms(model: mujoco.MjModel, body: int) -> NDArray[np.intp]:
    """Return the drawn geoms of a body and of everything below it."""
    return drawn_geoms(model, subtree(model, [body]))


def extent(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> NDArray[np.float64]:
    """Return the box round an object as it stands in `data`: (2, 3), its lowest and its highest corner in metres."""
    geoms = object_geoms(model, body)
    if len(geoms) == 0:
        return np.stack([data.xpos[body]] * 2)
    turned = data.geom_xmat[geoms].reshape(-1, 3, 3)
    middles, halves = np.split(model.geom_aabb[geoms], 2, axis=1)
    at = data.geom_xpos[geoms] + np.einsum("gij,gj->gi", turned, middles)
    halves = np.where(model.geom_rbound[geoms, None] > 0, halves, 0.0)  # planes have no end
    around = np.einsum("gij,gj->gi", np.abs(turned), halves)
    return np.stack([(at - around).min(axis=0), (at + around).max(axis=0)])


def centre(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> Point:
    """Return the middle of an object as it stands in `data`, in metres."""
    x, y, z = extent(model, data, body).mean(axis=0).tolist()
    return x, y, z


def robot_side(model: mujoco.MjModel, data: mujoco.MjData, robot: Bodies, lookat: Point) -> NDArray[np.float64]:
    """Return the horizontal way (2,) from a robot's centre of mass to a point, in metres."""
    mass = model.body_mass[robot]
    if mass.sum() == 0:
        return np.zeros(2)
    return np.asarray(lookat[:2] - (mass @ data.xipos[robot, :2]) / mass.sum())


def azimuth_of(ways: Sequence[NDArray[np.float64]]) -> float:
    """Return the azimuth in degrees of the mean of some horizontal ways; 90 if there is none."""
    x, y = np.mean(ways, axis=0).tolist()
    return math.degrees(math.atan2(y, x)) if math.hypot(x, y) > 1e-6 else 90.0
