"""Simulator state → frames, fast and deterministic.

Frames are drawn from a *render-only* copy of the kitchen model: it never steps, so everything that costs time but
shows nothing is left out of it (shadows, reflections, multisampling, the sky, most faces of the robot's meshes, and
the whole robot when it is hidden). The physics model stays untouched; only the joint positions ``qpos`` are taken over.
"""

from __future__ import annotations

import atexit
import dataclasses
import functools
import importlib
import importlib.metadata
import importlib.util
import math
import os
import platform
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import fast_simplification
import mujoco
import numpy as np
from numpy.typing import NDArray

from zest_rl.errors import BadInput, ZestError
from zest_rl.kitchen.tasks import TASKS, Task
from zest_rl.runtime import artifacts

N_QPOS = 30
"""Length of the kitchen's qpos."""
N_ROBOT_QPOS = 9
"""The leading entries of qpos: 7 arm joints and 2 fingers; the rest belongs to objects."""

_MORE_GEOMS = 1000  # tendons and the like, which are drawn but are no geoms of the model
_RENDERER_VERSION = 1  # raise it with any change of this file that changes a pixel: cached embeddings depend on it
_KITCHEN = Path("envs", "assets", "kitchen_franka")
_ROBOT_ROOT = "panda0_link0"
_AZIMUTHS = (60.0, 120.0)  # degrees; 90 looks from the robot's side straight at the kitchen
_DISTANCES = (1.0, 0.7, 1.4)  # metres
_INSTALL_GL = "apt-get install libegl1 libgl1 libosmesa6"


@dataclass(frozen=True)
class Camera:
    """A free camera that looks at a point of the world."""

    lookat: tuple[float, float, float]
    """World point in the middle of the picture, in metres."""
    distance: float
    """From the camera to `lookat`, in metres."""
    azimuth: float
    """In degrees; 90 looks along +y, from the robot at the kitchen."""
    elevation: float
    """In degrees; negative looks down."""

    def __post_init__(self) -> None:
        numbers = (*self.lookat, self.distance, self.azimuth, self.elevation)
        if not all(math.isfinite(number) for number in numbers) or self.distance <= 0:
            raise BadInput(f"a camera needs finite numbers and a distance above 0 m, got {self}")


def ring(task: Task, n_views: int) -> tuple[Camera, ...]:
    """Return views around the part that `task` moves, chosen without any ground truth.

    Azimuths are spread evenly from 60 to 120 degrees (90 when there is one view); distances and elevations cycle.

    Raises:
        BadInput: `n_views` is below 1.
    """
    if n_views < 1:
        raise BadInput(f"the number of views must be at least 1, got {n_views}")
    azimuths = np.linspace(*_AZIMUTHS, n_views) if n_views > 1 else [sum(_AZIMUTHS) / 2]
    return tuple(
        Camera(
            lookat=task.lookat,
            distance=_DISTANCES[i % len(_DISTANCES)],
            azimuth=float(azimuth),
            elevation=task.elevations[i % len(task.elevations)],
        )
        for i, azimuth in enumerate(azimuths)
    )


@dataclass(frozen=True)
class RenderConfig:
    """What frames look like, apart from the cameras."""

    size: int = 224
    """Height and width of a frame, in pixels."""
    robot: bool = False
    """Show the robot. Hidden, as in the paper, a frame depends on the objects alone."""
    mesh_fraction: float = 0.1
    """Share of the robot's visual faces that is kept, in (0, 1]; no effect while the robot is hidden."""

    def __post_init__(self) -> None:
        if self.size < 1:
            raise BadInput(f"size must be at least 1 pixel, got {self.size}; embedders usually want 224")
        if not 0 < self.mesh_fraction <= 1:
            raise BadInput(f"mesh_fraction must be in (0, 1], got {self.mesh_fraction}; 1 keeps every face")

    def fingerprint(self) -> str:
        """Return a sha256 over all that decides a frame except state and cameras: config, code, MuJoCo, assets.

        Raises:
            ZestError: gymnasium-robotics is not installed.
        """
        config = dataclasses.asdict(self)
        versions = {"renderer": _RENDERER_VERSION, "mujoco": mujoco.__version__}
        if self.robot:
            versions["fast-simplification"] = importlib.metadata.version("fast-simplification")
        else:
            del config["mesh_fraction"]
        root = _kitchen_folder()
        assets = {str(p.relative_to(root)): artifacts.hash_file(p) for p in root.rglob("*") if p.is_file()}
        return artifacts.hash_json({"config": config, "versions": versions, "assets": assets})


def relevant_qpos(config: RenderConfig) -> slice:
    """Return the entries of qpos (30,) that a frame depends on; states equal in these have equal frames."""
    return slice(0 if config.robot else N_ROBOT_QPOS, N_QPOS)


class Canvas:
    """Draws a model from fixed cameras, without shadows and reflections; use it from the thread that made it."""

    def __init__(self, model: mujoco.MjModel, cameras: tuple[mujoco.MjvCamera, ...], size: int) -> None:
        """Open a GL context for square frames of `size` pixels.

        Raises:
            ZestError: no GL backend works.
        """
        self._model, self._cameras = model, cameras
        self._rect = mujoco.MjrRect(0, 0, size, size)
        self._option, self._perturb = mujoco.MjvOption(), mujoco.MjvPerturb()
        self._scene = mujoco.MjvScene(model, maxgeom=2 * model.ngeom + model.nsite + _MORE_GEOMS)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._gl, self._context = _open_gl(model, size)

    def hide_sky(self) -> None:
        """Leave the background black; a model's sky may hold random specks."""
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = False

    def draw(self, data: mujoco.MjData) -> NDArray[np.uint8]:
        """Draw one state, whose positions in the world are computed: (V, H, W, 3) uint8 RGB."""
        self._gl.make_current()
        frames = np.empty((len(self._cameras), self._rect.height, self._rect.width, 3), np.uint8)
        for frame, camera in zip(frames, self._cameras, strict=True):
            mujoco.mjv_updateScene(
                self._model, data, self._option, self._perturb, camera, mujoco.mjtCatBit.mjCAT_ALL, self._scene
            )
            mujoco.mjr_render(self._rect, self._scene, self._context)
            mujoco.mjr_readPixels(frame, None, self._rect, self._context)
        return np.ascontiguousarray(frames[:, ::-1])  # GL counts rows from the bottom

    def close(self) -> None:
        """Free the GL context."""
        self._gl.make_current()
        self._context.free()
        self._gl.free()


class StateRenderer:
    """Draws kitchen states from fixed cameras. A context manager; use it from the thread and process that made it.

    Equal states give bitwise equal frames, in any instance and process with the same GL library.
    """

    def __init__(self, config: RenderConfig, cameras: tuple[Camera, ...]) -> None:
        """Build the render-only model and a GL context.

        Raises:
            BadInput: there is no camera.
            ZestError: no GL backend works, or gymnasium-robotics is not installed.
        """
        if not cameras:
            raise BadInput("a renderer needs at least 1 camera, got none; use ring(task, n_views)")
        self._relevant = relevant_qpos(config)
        self._model = _render_model(config)
        self._data = mujoco.MjData(self._model)
        self._canvas = Canvas(self._model, tuple(_mujoco_camera(camera) for camera in cameras), config.size)

    def render(self, qpos: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Draw one state.

        Args:
            qpos: (30,) float64, joint positions of the kitchen in rad or m.

        Returns:
            (V, H, W, 3) uint8 RGB, one frame per camera, in their order.

        Raises:
            BadInput: `qpos` has another shape or holds NaN or infinity.
        """
        if qpos.shape != (N_QPOS,):
            raise BadInput(f"qpos must have shape ({N_QPOS},), one kitchen state, got {qpos.shape}")
        if not np.isfinite(qpos).all():
            bad = np.flatnonzero(~np.isfinite(qpos)).tolist()
            raise BadInput(f"qpos must be finite, got NaN or infinity at entries {bad}; drop the broken episode")
        self._data.qpos[:] = qpos[self._relevant]
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        return self._canvas.draw(self._data)

    def with_joint(self, qpos: NDArray[np.float64], joint: str, position: float) -> NDArray[np.float64]:
        """Return a copy of a state (30,) with one of the objects' joints moved to `position` (rad or m).

        What the model couples to the joint moves along: a burner rises, and so turns red, with its knob.
        """
        model, first = self._model, self._relevant.start
        mover = model.joint(joint).id
        moved = qpos.copy()
        moved[first + model.jnt_qposadr[mover]] = position
        coupled = (model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & (model.eq_obj1id == mover)
        for equality in np.flatnonzero(coupled):  # mover = offset + slope · follower, both from their rest positions
            offset, slope = model.eq_data[equality, :2]
            address = model.jnt_qposadr[model.eq_obj2id[equality]]
            rest = model.qpos0[model.jnt_qposadr[mover]]
            moved[first + address] = model.qpos0[address] + (position - rest - offset) / slope
        return moved

    def close(self) -> None:
        """Free the GL context; the renderer cannot draw any more."""
        self._canvas.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@functools.cache
def shared_renderer(config: RenderConfig, cameras: tuple[Camera, ...]) -> StateRenderer:
    """Return this process's renderer, open until the process ends: to build one takes half a second, or with the
    robot's meshes two.
    """
    renderer = StateRenderer(config, cameras)
    atexit.register(renderer.close)  # left open, or closed after the GL library, it complains when the process ends
    return renderer


def _mujoco_camera(camera: Camera) -> mujoco.MjvCamera:
    free = mujoco.MjvCamera()
    free.type = mujoco.mjtCamera.mjCAMERA_FREE
    free.lookat[:] = camera.lookat
    free.distance, free.azimuth, free.elevation = camera.distance, camera.azimuth, camera.elevation
    return free


# --- the render-only model --------------------------------------------------------------------------------------------


def _kitchen_folder() -> Path:
    package = importlib.util.find_spec("gymnasium_robotics")  # finds the package without running its code
    if package is None or package.origin is None:
        raise ZestError(
            "the kitchen's model comes with gymnasium-robotics, which is not installed; pip install zest-rl"
        )
    return Path(package.origin).parent / _KITCHEN


def _render_model(config: RenderConfig) -> mujoco.MjModel:
    """Compile the kitchen with what cannot be seen left out."""
    folder = _kitchen_folder()
    spec = mujoco.MjSpec.from_file(str(folder / "kitchen_assets" / "kitchen_env_model.xml"))
    if config.robot:
        for mesh in spec.meshes if config.mesh_fraction < 1 else ():
            if mesh.file.startswith("visual/"):  # 94 % of all faces; the kitchen's own meshes are small and stay exact
                _decimate(mesh, folder / "franka_assets" / "meshes" / mesh.file, config.mesh_fraction)
    else:
        for element in (*spec.actuators, *spec.keys, spec.body(_ROBOT_ROOT).parent):
            spec.delete(element)
        for mesh in spec.meshes:
            if mesh.file.startswith(("visual/", "collision/")):
                spec.delete(mesh)
    spec.delete(spec.texture("skybox"))  # black with random specks; without it the background is plain black
    visual = spec.visual
    visual.global_.offwidth = visual.global_.offheight = config.size
    visual.quality.shadowsize = visual.quality.offsamples = 0
    visual.quality.numslices = 12
    return spec.compile()


def _decimate(mesh: Any, stl: Path, fraction: float) -> None:
    """Replace a mesh's file by about `fraction` of its faces."""
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    corners = np.frombuffer(stl.read_bytes(), record, offset=84)["corners"]  # binary STL: 80 bytes title, uint32 count
    vertices, faces = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    vertices, faces = fast_simplification.simplify(vertices, faces.reshape(-1, 3), target_reduction=1 - fraction)
    mesh.file = ""
    mesh.uservert, mesh.userface = vertices.ravel(), faces.ravel()


# --- GL ---------------------------------------------------------------------------------------------------------------


def select_gl_backend() -> str:
    """Return the GL backend for this process: the user's ``MUJOCO_GL``, else EGL, else OSMesa.

    A choice is kept in ``MUJOCO_GL``, so that child processes and other renderers agree. It is tried out in a process
    of its own, because PyOpenGL cannot change its backend after a failed attempt.

    Raises:
        ZestError: neither EGL nor OSMesa works.
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    if chosen:
        return chosen
    if platform.system() != "Linux":
        return "native"
    probe = "import sys, importlib; importlib.import_module('mujoco.' + sys.argv[1]).GLContext(8, 8).make_current()"
    for backend in ("egl", "osmesa"):
        environ = os.environ | {"MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
        if subprocess.run([sys.executable, "-c", probe, backend], env=environ, capture_output=True).returncode == 0:
            os.environ["MUJOCO_GL"] = os.environ["PYOPENGL_PLATFORM"] = backend
            return backend
    raise ZestError(f"no frame can be rendered: neither EGL nor OSMesa works here; {_INSTALL_GL}")


def gl_backend() -> str:
    """Return the name of the GL backend that works, seen by rendering one frame.

    Raises:
        ZestError: none works.
    """
    with StateRenderer(RenderConfig(size=64), ring(TASKS["micro"], 1)) as renderer:
        frame = renderer.render(np.zeros(N_QPOS))
    if frame.min() == frame.max():
        raise ZestError(f"the GL backend {select_gl_backend()!r} renders blank frames; {_INSTALL_GL}")
    return select_gl_backend()


def _open_gl(model: mujoco.MjModel, size: int) -> tuple[Any, mujoco.MjrContext]:
    """Return a GL context, current in this thread, and MuJoCo's drawing context in it."""
    backend = select_gl_backend()
    try:
        module = f"mujoco.{backend}" if backend in ("egl", "osmesa") else "mujoco.gl_context"
        gl = importlib.import_module(module).GLContext(size, size)
        gl.make_current()
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50)
    except Exception as error:  # each backend and driver raises another type
        raise ZestError(
            f"the GL backend {backend!r} does not work: {error}; {_INSTALL_GL}, or unset MUJOCO_GL"
        ) from error
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    return gl, context
