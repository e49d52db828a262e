"""Rendering the kitchen: a render-only model, and cameras around the part that a task moves.

The model is never stepped, so it leaves out everything that costs time but shows nothing (shadows, reflections,
multisampling, the sky, most faces of the robot's meshes, and the whole robot when it is hidden). The physics model
stays untouched; only its joint positions ``qpos`` are copied.
"""

from __future__ import annotations

import atexit
import dataclasses
import functools
import importlib.metadata
import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import mujoco
import numpy as np

from zest_rl.errors import BadInput, ZestError
from zest_rl.kitchen.tasks import RING, TASKS, Task
from zest_rl.runtime import artifacts
from zest_rl.runtime.gl import INSTALL_GL, cached_in_thread, select_gl_backend
from zest_rl.simulation.rendering import Camera, StateRenderer
from zest_rl.simulation.scene import Scene, compile_for_drawing, decimate
from zest_rl.simulation.views import ring

N_QPOS = 30
"""Length of the kitchen's qpos."""
N_ROBOT_QPOS = 9
"""The leading entries of qpos: 7 arm joints and 2 fingers; the rest belongs to objects."""
MAX_SIZE = 4096
"""Pixels of a side of the largest frame."""

_RENDERER_VERSION = 1  # raise it when a pixel changes, here or in simulation/: cached embeddings depend on it
_KITCHEN = Path("envs", "assets", "kitchen_franka")
_ROBOT_ROOT = "panda0_link0"
_DISTANCES = (1.0, 0.7, 1.4)  # metres
FRAMING = 2
"""Version of the tasks' cameras; raise it when they change, and keep those of before."""
_FRAMING_1: dict[str, dict[str, Any]] = {"knob2": {"lookat": (-0.22, 0.5, 2.12), "seen_from": RING}}


@dataclass(frozen=True)
class RenderConfig:
    """Everything that a frame depends on besides state and cameras."""

    size: int = 224
    """Height and width of a frame, in pixels."""
    robot: bool = False
    """Show the robot. Hidden, as in the paper, a frame depends on the objects alone."""
    mesh_fraction: float = 0.1
    """Share of the robot's visual faces that is kept, in (0, 1]; no effect while the robot is hidden."""

    def __post_init__(self) -> None:
        if not 1 <= self.size <= MAX_SIZE:
            raise BadInput(f"size must be 1 to {MAX_SIZE} pixels, got {self.size}; embedders usually want 224")
        if not 0 < self.mesh_fraction <= 1:
            raise BadInput(f"mesh_fraction must be in (0, 1], got {self.mesh_fraction}; 1 keeps every face")

    def fingerprint(self) -> str:
        """Hash everything that a frame depends on except state and cameras: config, code, MuJoCo, assets.

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


def task_cameras(task: Task, n_views: int, framing: int = FRAMING) -> tuple[Camera, ...]:
    """Return a ring of views around the part that `task` moves, without those from which the scene hides it.

    Args:
        task: what is looked at.
        n_views: of the whole ring, which spans `RING`.
        framing: version of the cameras. 1 saw `knob2` from all sides, between its knob and the hidden burner.

    Raises:
        BadInput: `n_views` is below 1, or there is no such framing.
    """
    if framing not in range(1, FRAMING + 1):
        raise BadInput(f"the framing of the kitchen's views must be 1 to {FRAMING}, got {framing}; update zest-rl")
    if framing == 1:
        task = dataclasses.replace(task, **_FRAMING_1.get(task.name, {}))
    around = functools.partial(ring, task.lookat, distances=_DISTANCES, elevations=task.elevations)
    first, last = task.seen_from
    seen = tuple(view for view in around(n_views, azimuths=RING) if first <= view.azimuth <= last)
    return seen or around(1, azimuths=task.seen_from)


def open_renderer(config: RenderConfig, cameras: tuple[Camera, ...]) -> StateRenderer:
    """Build the render-only model and a renderer of it; close it after use.

    Raises:
        BadInput: there is no camera.
        ZestError: no GL backend works, or gymnasium-robotics is not installed.
    """
    return StateRenderer(Scene(_render_model(config), N_QPOS, relevant_qpos(config)), cameras, config.size)


@cached_in_thread
def shared_renderer(config: RenderConfig, cameras: tuple[Camera, ...]) -> StateRenderer:
    """Return this thread's renderer, open until the process ends; building one takes 0.5 s, or 2 s with the robot."""
    renderer = open_renderer(config, cameras)
    atexit.register(renderer.close)  # left open, or closed after the GL library, it prints errors at exit
    return renderer


def gl_backend() -> str:
    """Return the name of the GL backend after rendering one frame with it.

    Raises:
        ZestError: none works.
    """
    with open_renderer(RenderConfig(size=64), task_cameras(TASKS["micro"], 1)) as renderer:
        frame = renderer.render(np.zeros(N_QPOS))
    if frame.min() == frame.max():
        raise ZestError(f"the GL backend {select_gl_backend()!r} renders blank frames; {INSTALL_GL}")
    return select_gl_backend()


def _kitchen_folder() -> Path:
    package = importlib.util.find_spec("gymnasium_robotics")  # finds the package without running its code
    if package is None or package.origin is None:
        raise ZestError(
            "the kitchen's model comes with gymnasium-robotics, which is not installed; pip install zest-rl"
        )
    return Path(package.origin).parent / _KITCHEN


def _render_model(config: RenderConfig) -> mujoco.MjModel:
    """Compile the kitchen without anything that cannot be seen."""
    folder = _kitchen_folder()
    spec = mujoco.MjSpec.from_file(str(folder / "kitchen_assets" / "kitchen_env_model.xml"))
    if config.robot:
        for mesh in spec.meshes if config.mesh_fraction < 1 else ():
            if mesh.file.startswith("visual/"):  # 94 % of all faces; the kitchen's own meshes are small and stay exact
                decimate(mesh, folder / "franka_assets" / "meshes" / mesh.file, config.mesh_fraction)
    else:
        for element in (*spec.actuators, *spec.keys, spec.body(_ROBOT_ROOT).parent):
            spec.delete(element)
        for mesh in spec.meshes:
            if mesh.file.startswith(("visual/", "collision/")):
                spec.delete(mesh)
    spec.delete(spec.texture("skybox"))  # black with random specks; without it the background is plain black
    return compile_for_drawing(spec, config.size)
