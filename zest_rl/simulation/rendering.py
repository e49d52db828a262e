"""Simulator state → frames of any MuJoCo model, fast and deterministic."""

from __future__ import annotations

import math
from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import mujoco
import numpy as np
from numpy.typing import NDArray

from zest_rl.errors import BadInput
from zest_rl.runtime.gl import open_gl
from zest_rl.simulation.scene import Scene

HIDDEN_GROUP = mujoco.mjNGROUP - 1
"""Of geoms and sites that are not drawn; MuJoCo's default draws the groups 0 to 2."""
_MORE_GEOMS = 1000  # tendons and the like, which are drawn but are no geoms of the model
_ROUNDING = 1.01  # of radii


@dataclass(frozen=True)
class Camera:
    """A free camera that looks at a point of the world."""

    lookat: tuple[float, float, float]
    """World point in the middle of the picture, in metres."""
    distance: float
    """From the camera to `lookat`, in metres."""
    azimuth: float
    """In degrees; 90 looks along +y."""
    elevation: float
    """In degrees; negative looks down."""

    def __post_init__(self) -> None:
        numbers = (*self.lookat, self.distance, self.azimuth, self.elevation)
        if not all(math.isfinite(number) for number in numbers) or self.distance <= 0:
            raise BadInput(f"a camera needs finite numbers and a distance above 0 m, got {self}")

    def to_mujoco(self) -> mujoco.MjvCamera:
        """Return the camera as a MuJoCo object."""
        free = mujoco.MjvCamera()
        free.type = mujoco.mjtCamera.mjCAMERA_FREE
        free.lookat[:] = self.lookat
        free.distance, free.azimuth, free.elevation = self.distance, self.azimuth, self.elevation
        return free


def in_sight(camera: mujoco.MjvGLCamera, centres: NDArray[np.float64], radii: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which spheres, (N, 3) centres and (N,) radii in metres, a camera of square frames may see: (N,).

    Those that lie outside one of the four planes from the eye through the frame's edges are out of sight.
    """
    if camera.orthographic:
        return np.ones(len(radii), np.bool_)
    forward, up, near = np.float64(camera.forward), np.float64(camera.up), camera.frustum_near
    right, middle = np.cross(forward, up), camera.frustum_center
    half_width = camera.frustum_width or (camera.frustum_top - camera.frustum_bottom) / 2
    inward = np.stack(
        (
            near * right - (middle - half_width) * forward,
            (middle + half_width) * forward - near * right,
            near * up - camera.frustum_bottom * forward,
            camera.frustum_top * forward - near * up,
        )
    )
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    inside: NDArray[np.bool_] = ((centres - camera.pos) @ inward.T >= -_ROUNDING * radii[:, None]).all(axis=1)
    return inside


def _radii(model: mujoco.MjModel) -> NDArray[np.float64]:
    """Return the radii of spheres around the geoms, infinite of planes: (ngeom,).

    MuJoCo computes its own when a model is compiled; an environment may have enlarged a geom since.
    """
    is_capsule = model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE
    now = np.where(is_capsule, model.geom_size.sum(axis=1), np.linalg.norm(model.geom_size, axis=1))
    return np.where(model.geom_rbound == 0, np.inf, np.maximum(model.geom_rbound, now))


class Canvas:
    """Draws a model from fixed cameras, without shadows and reflections; use it from the thread that made it."""

    def __init__(self, model: mujoco.MjModel, cameras: tuple[mujoco.MjvCamera, ...], size: int) -> None:
        """Open a GL context for square frames of `size` pixels.

        Raises:
            ZestError: no GL backend works.
        """
        self.cameras = cameras
        """May be exchanged between frames."""
        self._model = model
        self._rect = mujoco.MjrRect(0, 0, size, size)
        self._option, self._perturb = mujoco.MjvOption(), mujoco.MjvPerturb()
        self._scene = mujoco.MjvScene(model, maxgeom=2 * model.ngeom + model.nsite + _MORE_GEOMS)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._gl, self._context = open_gl(model, size)

    def hide_sky(self) -> None:
        """Leave the background black; a model's sky may hold random specks."""
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = False

    def hide_tendons(self) -> None:
        """Leave out tendons, which drive robots."""
        self._option.tendongroup[:] = 0

    def segments(self, data: mujoco.MjData) -> NDArray[np.int32]:
        """Return which geom each pixel shows, (V, H, W) int32; −1 for what is no geom."""
        flags = self._scene.flags
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = True
        try:
            with closing(self._draw(data)) as drawn:
                return np.stack([self._shown(colours) for colours in drawn])
        finally:
            flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = False

    def _shown(self, colours: NDArray[np.uint8]) -> NDArray[np.int32]:
        """Return which geom of the scene that was just drawn each of its pixels shows: (H, W, 3) → (H, W)."""
        drawn = self._scene.geoms[: self._scene.ngeom]
        geoms = np.full(len(drawn) + 1, -1, np.int32)
        for geom in drawn:
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.segid >= 0:
                geoms[geom.segid + 1] = geom.objid
        return geoms[colours.astype(np.int32) @ np.array([1, 256, 65536], np.int32)]

    def draw(self, data: mujoco.MjData) -> NDArray[np.uint8]:
        """Draw one state after its kinematics are computed: (V, H, W, 3) uint8 RGB."""
        return np.stack(list(self._draw(data)))

    def _draw(self, data: mujoco.MjData) -> Generator[NDArray[np.uint8]]:
        """Draw one state from one camera after the other: (H, W, 3) each.

        Geoms out of sight are left out, for GL would take as long for them as for what can be seen.
        """
        self._gl.make_current()
        model, scene = self._model, self._scene
        groups, radii = model.geom_group.copy(), _radii(model)
        try:
            for camera in self.cameras:
                mujoco.mjv_updateCamera(model, data, camera, scene)
                eye = mujoco.mjv_averageCamera(*scene.camera)  # of a stereo pair, as it is drawn
                seen = in_sight(eye, data.geom_xpos, radii)
                model.geom_group[:] = np.where(seen, groups, HIDDEN_GROUP)
                mujoco.mjv_updateScene(
                    model, data, self._option, self._perturb, camera, mujoco.mjtCatBit.mjCAT_ALL, scene
                )
                mujoco.mjr_render(self._rect, scene, self._context)
                frame = np.empty((self._rect.height, self._rect.width, 3), np.uint8)
                mujoco.mjr_readPixels(frame, None, self._rect, self._context)
                yield frame[::-1]  # GL counts rows from the bottom
        finally:
            model.geom_group[:] = groups

    def close(self) -> None:
        """Free the GL context."""
        self._gl.make_current()
        self._context.free()
        self._gl.free()


class StateRenderer:
    """Draws states of a scene from fixed cameras. A context manager; use it from the thread and process that made it.

    Equal states give bitwise equal frames, in any instance and process with the same GL library.
    """

    scene: Scene
    """The scene that is drawn."""

    def __init__(self, scene: Scene, cameras: tuple[Camera, ...], size: int) -> None:
        """Open a GL context for square frames of `size` pixels.

        Raises:
            BadInput: there is no camera.
            ZestError: no GL backend works.
        """
        if not cameras:
            raise BadInput("a renderer needs at least 1 camera, got none; use a ring of views")
        self.scene = scene
        self._data = mujoco.MjData(scene.model)
        self._canvas = Canvas(scene.model, tuple(camera.to_mujoco() for camera in cameras), size)

    def render(self, qpos: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Draw one state.

        Args:
            qpos: (n_qpos,) float64, joint positions of the simulated model in rad or m.

        Returns:
            (V, H, W, 3) uint8 RGB, one frame per camera, in their order.

        Raises:
            BadInput: `qpos` has another shape or holds NaN or infinity.
        """
        if qpos.shape != (self.scene.n_qpos,):
            raise BadInput(f"qpos must have shape ({self.scene.n_qpos},), one state of the model, got {qpos.shape}")
        if not np.isfinite(qpos).all():
            bad = np.flatnonzero(~np.isfinite(qpos)).tolist()
            raise BadInput(f"qpos must be finite, got NaN or infinity at entries {bad}; drop the broken episode")
        self._data.qpos[:] = qpos[self.scene.visible]
        mujoco.mj_kinematics(self.scene.model, self._data)
        mujoco.mj_camlight(self.scene.model, self._data)
        return self._canvas.draw(self._data)

    def close(self) -> None:
        """Free the GL context; the renderer cannot draw any more."""
        self._canvas.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
