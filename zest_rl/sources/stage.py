"""An environment of another package as a renderer of recorded states: its model, and cameras that look at it.

Frames are drawn like the kitchen's: without shadows, reflections, multisampling or sky. Only registered environments
are made, and those of functions that the user names; without their wrappers.
"""

from __future__ import annotations

import atexit
import functools
import json
from collections.abc import Callable
from contextlib import redirect_stderr
from dataclasses import dataclass
from io import StringIO
from typing import Any

import zest_rl.runtime.load_order  # isort: skip
import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

import zest_rl.kitchen.env  # noqa: F401  # registers its environment, and those of gymnasium-robotics
from zest_rl.data.env_specs import check_registered, is_maker, without_wrappers
from zest_rl.errors import BadInput, ZestError, nearest
from zest_rl.runtime import artifacts
from zest_rl.runtime.gl import cached_in_thread
from zest_rl.simulation.makers import make_named
from zest_rl.simulation.recorder import DATA_FIELDS, MODEL_FIELDS
from zest_rl.simulation.rendering import Canvas
from zest_rl.sources import state_plugins
from zest_rl.sources.recorded_envs import State, recorded_env
from zest_rl.types import Frame

SIZE = 224
"""Side of the square frames, in pixels."""
Pose = tuple[tuple[float, float, float], float, float, float]
"""Point that a camera looks at and distance from it in metres, azimuth and elevation in degrees."""


@dataclass(frozen=True, eq=False)
class Groups:
    """To which of MuJoCo's groups the parts of a model belong, of which it draws 0 to 2."""

    geoms: NDArray[np.int32]
    """(ngeom,)."""
    sites: NDArray[np.int32]
    """(nsite,)."""


def model_sha256(model: mujoco.MjModel) -> str:
    """Hash a model as it is compiled, meshes and textures included."""
    compiled = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, compiled)
    return artifacts.hash_arrays(compiled)


class Simulation:
    """An environment in which recorded states are restored."""

    def __init__(self, env: Any, entry_point: str) -> None:
        """Take an environment without its wrappers; see `make_simulation`."""
        self.env, self.model, self.data = env, env.model, env.data
        self.model_sha256 = model_sha256(self.model)
        self.groups = Groups(self.model.geom_group.copy(), self.model.site_group.copy())
        """As the environment made them."""
        self._made = [
            (getattr(owner, name), getattr(owner, name).copy())
            for owner, names in ((self.model, MODEL_FIELDS), (self.data, DATA_FIELDS))
            for name in names
        ]
        self.entry_point, self.recorded = entry_point, recorded_env(entry_point, env)

    def put(self, state: State) -> None:
        """Restore a recorded state, and compute positions in the world; what it lacks is as the environment made it."""
        for values, made in self._made:
            values[...] = made
        self.recorded.put_state(self.env, state)
        mujoco.mj_fwdPosition(self.model, self.data)

    def open_canvas(self, cameras: tuple[mujoco.MjvCamera, ...]) -> Canvas:
        """Open a GL context, without what costs time and shows nothing; it stays open until the process ends."""
        visual = self.model.vis
        visual.global_.offwidth = visual.global_.offheight = SIZE
        visual.quality.shadowsize = visual.quality.offsamples = 0
        canvas = Canvas(self.model, cameras, SIZE)
        canvas.hide_sky()
        atexit.register(canvas.close)
        return canvas


class Stage:
    """One environment, and cameras that look at its model."""

    def __init__(self, simulation: Simulation, cameras: tuple[str, ...]) -> None:
        """Open a GL context; see `stage_of`."""
        self.simulation = simulation
        env, model = simulation.env, simulation.model
        if simulation.recorded.put is None and hasattr(env, "_render_callback"):
            raise BadInput(
                f"{simulation.entry_point} places targets only while it renders, in a way that is not known here; give "
                "--frames FOLDER with a video of each episode"
            )
        self._renderer = _renderer_of(env)
        self._default = mujoco.MjvCamera()
        fixed = getattr(self._renderer, "camera_id", -1)
        self.is_fixed = fixed >= 0
        """Whether the environment was made with a camera of the model as its default."""
        if self.is_fixed:
            self._default.type, self._default.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, fixed
        self._canvas = simulation.open_canvas(tuple(_camera(model, name) for name in cameras) or (self._default,))

    def default_pose(self, state: State) -> Pose:
        """Return the pose of the camera of ``env.render()`` when this state is the first one rendered.

        As in Gymnasium's `OffScreenViewer` and `MujocoRenderer`; the camera does not follow what moves.
        """
        self.simulation.put(state)
        camera, model = mujoco.MjvCamera(), self.simulation.model
        x, y, z = np.median(self.simulation.data.geom_xpos, axis=0).tolist()
        settings = getattr(self._renderer, "default_cam_config", None) or {}
        camera.lookat, camera.distance = settings.get("lookat", (x, y, z)), model.stat.extent
        for field in ("distance", "azimuth", "elevation"):
            if field in settings:
                setattr(camera, field, settings[field])
        x, y, z = camera.lookat.tolist()
        return (x, y, z), camera.distance, camera.azimuth, camera.elevation

    def render(self, state: State, pose: Pose | None = None) -> list[Frame]:
        """Draw one state: one (H, W, 3) frame per camera; `pose` is that of the default camera."""
        self.simulation.put(state)
        if pose is not None:
            self._default.lookat, self._default.distance, self._default.azimuth, self._default.elevation = pose
        return list(self._canvas.draw(self.simulation.data))


@cached_in_thread
def stage_of(env_spec: str, cameras: tuple[str, ...]) -> Stage:
    """Return this thread's stage, open until the thread ends.

    Raises:
        BadInput: as `make_simulation`, or there is no such camera.
        ZestError: as `make_simulation`, or no GL backend works.
    """
    return Stage(make_simulation(env_spec), cameras)


def env_facts(env_spec: str) -> dict[str, Any]:
    """Return an EnvSpec (JSON) as a dictionary; of ``package.module:make`` it has that as id and entry point."""
    facts: dict[str, Any] = {"id": env_spec, "entry_point": env_spec} if is_maker(env_spec) else json.loads(env_spec)
    return facts


def make_simulation(env_spec: str) -> Simulation:
    """Make the environment of a dataset.

    Args:
        env_spec: an EnvSpec as JSON; or ``package.module:make``, a function without arguments that the user names.

    Raises:
        BadInput: neither, not a registered environment, or one without a MuJoCo model.
        ZestError: the environment cannot be made with the packages here.
    """
    if is_maker(env_spec):
        return Simulation(_bare(lambda: make_named(env_spec), env_spec), env_spec)
    try:
        spec = gymnasium.envs.registration.EnvSpec.from_json(without_wrappers(env_spec))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise BadInput(f"the dataset's env_spec is not the JSON of a Gymnasium EnvSpec: {error!r}") from error
    plugin = state_plugins.registered(spec.id)
    if plugin is not None and spec.id not in gymnasium.registry:
        state_plugins.load(plugin)  # its module registers the environment
    check_registered(
        spec,
        "install the version of its package that it was recorded with, or give --frames FOLDER with a video of each "
        "episode",
    )
    env = _bare(functools.partial(gymnasium.make, spec, disable_env_checker=True), spec.id)
    return Simulation(env, str(spec.entry_point))


def _bare(make: Callable[[], Any], name: str) -> Any:
    """Make an environment, and return it without its wrappers."""
    try:
        with redirect_stderr(StringIO()):  # on import gymnasium_robotics prints news of its other environments
            env: Any = make().unwrapped
    except ZestError:
        raise
    except Exception as error:  # whatever an environment raises
        raise ZestError(
            f"{name} cannot be made here ({type(error).__name__}: {error}); install what it needs, or give --frames "
            "FOLDER with a video of each episode"
        ) from error
    if not isinstance(getattr(env, "model", None), mujoco.MjModel):
        raise BadInput(f"{name} has no MuJoCo model to render; give --frames FOLDER with a video of each episode")
    return env


def _renderer_of(env: Any) -> Any:
    """Return Gymnasium's renderer of an environment or of the one inside it; None without any."""
    inner = (getattr(env, part, None) for part in ("point_env", "ant_env", "robot_env"))
    renderers = (getattr(part, "mujoco_renderer", None) for part in (env, *inner))
    return next((renderer for renderer in renderers if renderer is not None), None)


def _camera(model: mujoco.MjModel, name: str) -> mujoco.MjvCamera:
    """Return a camera of the model."""
    camera, names = mujoco.MjvCamera(), [model.camera(i).name for i in range(model.ncam)]
    if name not in names:
        raise BadInput(f"the model has no camera {name!r}; {nearest(name, names)}")
    camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, names.index(name)
    return camera
