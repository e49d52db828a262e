"""Recorded simulator states of a Gymnasium environment → frames, rendered from the environment's own model.

A frame is drawn as the kitchen's are: no shadows, reflections, multisampling or sky. It shows the state exactly where
all that moves is in qpos, or is known to `SCENERY`: targets and furniture that an environment puts elsewhere in each
episode. Only registered environments of the allow-listed packages are made, without their wrappers
(`zest_rl.data.env_specs`).
"""

from __future__ import annotations

import atexit
import functools
import importlib.metadata
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint
from io import StringIO
from pathlib import Path
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import gymnasium
import h5py
import mujoco
import numpy as np
from numpy.typing import NDArray

from zest_rl.data.env_specs import check_env_spec, check_registered
from zest_rl.data.observations import entries
from zest_rl.errors import BadInput, ZestError, nearest
from zest_rl.runtime import artifacts
from zest_rl.simulation.rendering import Canvas
from zest_rl.sources import rebuilt_states
from zest_rl.types import Frame

SIZE = 224
"""Side of the square frames, in pixels."""
Doubles = NDArray[np.float64]
Pose = tuple[tuple[float, float, float], float, float, float]
"""Point that a camera looks at and distance from it in metres, azimuth and elevation in degrees."""
Columns = tuple[tuple[str, int, int | None], ...]
"""Paths within an episode and which of their columns make up qpos, in order: from the first number to before the
second; None: to the end."""

_VERSION = 2  # raise it with any change of this file that changes a pixel: cached embeddings depend on it
_MAZES = "gymnasium_robotics.envs.maze."
_ADROIT = "gymnasium_robotics.envs.adroit_hand."
_FETCH = "gymnasium_robotics.envs.fetch."
_KITCHEN = "gymnasium_robotics.envs.franka_kitchen"
_GYMNASIUM = "gymnasium.envs.mujoco."
_X: Columns = (("infos/x_position", 0, 1),)
_XY: Columns = (*_X, ("infos/y_position", 0, 1))

IN_OBSERVATIONS: Mapping[str, Columns] = {
    f"{_MAZES}point_maze": (("observations/observation", 0, 2),),
    f"{_MAZES}ant_maze": (("observations/achieved_goal", 0, 2), ("observations/observation", 0, 13)),
    f"{_GYMNASIUM}ant_v5": (*_XY, ("observations", 0, 13)),
    f"{_GYMNASIUM}half_cheetah_v5": (*_X, ("observations", 0, 8)),
    f"{_GYMNASIUM}hopper_v5": (*_X, ("observations", 0, 5)),
    f"{_GYMNASIUM}humanoid_v5": (*_XY, ("observations", 0, 22)),
    f"{_GYMNASIUM}humanoidstandup_v5": (*_XY, ("observations", 0, 22)),
    f"{_GYMNASIUM}inverted_pendulum_v5": (("observations", 0, 2),),
    f"{_GYMNASIUM}swimmer_v5": (*_XY, ("observations", 0, 3)),
    f"{_GYMNASIUM}walker2d_v5": (*_X, ("observations", 0, 8)),
    _KITCHEN: (("observations/observation", 0, 9), ("observations/observation", 18, 39)),
}
"""Where qpos stands in what environments observe: entry point → columns. To the bit, but for the kitchen's `NOISE`.
Fetch's and Adroit's observations do not hold it, so their datasets need the recorded state."""

NOISE = ("robot_noise_ratio", "object_noise_ratio")
"""Arguments of FrankaKitchen that blur what it observes: by default by up to 0.001 rad, 0.00005 rad or metres."""


@dataclass(frozen=True)
class States:
    """`Frames` rendered from what is recorded of the simulator in a Minari dataset."""

    file: Path
    episodes: tuple[str, ...]
    """Groups of the episodes."""
    env_spec: str
    """Of the environment, as JSON, checked."""
    qpos: Columns
    """Empty: another package rebuilds it (`own_states`)."""
    scenery: tuple[str, ...]
    """Paths of what else is put into the scene."""
    cameras: tuple[str, ...] = ()
    """Of the model; empty: where the environment's own camera stands."""
    pose: Pose | None = None
    """Of that camera; None where it is one of the model."""
    noisy: bool = False
    """Whether the observations that qpos is read from were blurred."""

    @property
    def views(self) -> Sequence[str]:
        """Names of the cameras."""
        return self.cameras or (_DEFAULT_CAMERA,)

    def describe(self) -> dict[str, Any]:
        """Tell what was rendered how."""
        return {
            "kind": "states",
            "views": list(self.views),
            "qpos_from": [list(column) for column in self.qpos] or self._own.value,
            "qpos_is_noisy": self.noisy,
            "scenery_from": list(self.scenery),
            "camera_pose": self.pose,
            "size": SIZE,
            "env_id": json.loads(self.env_spec).get("id"),
        }

    def digest(self, episode: int) -> str:
        """Hash the states, the environment with its versions and its model, and the cameras."""
        versions = [importlib.metadata.version(name) for name in ("mujoco", "gymnasium", "gymnasium-robotics")]
        recorded = self._recorded(episode)
        model = stage_of(self.env_spec, self.cameras).model_sha256
        how = [self.env_spec, versions, model, self.cameras, self.pose, SIZE, _VERSION, sorted(recorded)]
        return artifacts.hash_json([artifacts.hash_arrays(*(recorded[name] for name in sorted(recorded))), how])

    def read(self, episode: int) -> Iterator[Sequence[Frame]]:
        """Render each state."""
        recorded, stage = self._recorded(episode), stage_of(self.env_spec, self.cameras)
        for step in range(len(recorded["qpos"])):
            yield stage.render({name: values[step] for name, values in recorded.items()}, self.pose)

    def _recorded(self, episode: int) -> dict[str, Doubles]:
        """Read qpos (T+1, nq), and by its last name all that is put into the scene (T+1, n)."""
        with h5py.File(self.file, "r") as file:
            group = file[self.episodes[episode]]
            n_rows = len(group["actions"]) + 1
            found = {path.rpartition("/")[2]: _rows(group, path, n_rows) for path in self.scenery}
            if not self.qpos:
                return {**found, "qpos": rebuilt_states.rebuild(self._own, group, n_rows)}
            columns = [_rows(group, path, n_rows)[:, first:end] for path, first, end in self.qpos]
            return {**found, "qpos": np.concatenate(columns, axis=1)}

    @property
    def _own(self) -> EntryPoint:
        entry = rebuilt_states.registered(json.loads(self.env_spec)["id"])
        if entry is None:
            raise ZestError("the package that rebuilds the states is not installed on this machine; install it")
        return entry


_DEFAULT_CAMERA = "the environment's own camera"


def _rows(group: h5py.Group, path: str, n_rows: int) -> Doubles:
    if path not in group:
        raise BadInput(f"{group.name} has no {path!r}, which its frames are rendered from; record it, or give --frames")
    values = np.asarray(group[path][()], dtype=np.float64)
    if len(values) != n_rows:
        raise BadInput(f"{group.name}/{path} must have T + 1 = {n_rows} rows, one per observation, got {len(values)}")
    if not np.isfinite(values).all():
        raise BadInput(f"{group.name}/{path} must be finite, got NaN or infinity; drop the episode")
    return values.reshape(n_rows, -1)


def find_states(file: Path, episodes: Sequence[str], env_spec: str | None, cameras: Sequence[str], what: str) -> States:
    """Find what a Minari dataset records of the simulator's state.

    Args:
        file: its HDF5 file.
        episodes: the groups in it.
        env_spec: of its environment, as JSON.
        cameras: of the model; empty: the environment's own.
        what: names the dataset in an error.

    Raises:
        BadInput: no state, several, or one that does not fit the model; no such camera.
        ZestError: the environment cannot be made here.
    """
    if env_spec is None:
        raise BadInput(
            f"{what} shows no frames: there are no pictures to choose, and it names no environment whose recorded "
            "states could be rendered; give --frames FOLDER with a video of each episode"
        )
    spec = json.loads(env_spec)
    own = rebuilt_states.registered(str(spec.get("id")))
    if own is None:
        check_env_spec(env_spec, f"the env_spec of {what}", "give --frames FOLDER with a video of each episode")
    entry_point, kwargs = str(spec["entry_point"]), spec.get("kwargs") or {}
    with h5py.File(file, "r") as opened:
        group = opened[episodes[0]]
        infos = entries(group["infos"], "infos") if "infos" in group else {}
        recorded = [path for path in infos if path.rpartition("/")[2] == "qpos"]
        there = {*infos, *entries(group["observations"], "observations")}
    if len(recorded) > 1 and own is None:
        raise BadInput(f"{what} records several states ({', '.join(recorded)}); remove all but one")
    columns: Columns | None = () if own else ((recorded[0], 0, None),) if recorded else None
    if columns is None:
        columns = next((found for start, found in IN_OBSERVATIONS.items() if entry_point.startswith(start)), None)
        if columns is not None and not kwargs.get("exclude_current_positions_from_observation", True):
            columns = (("observations", 0, sum((end or 0) - first for _, first, end in columns)),)
        if columns is not None and spec.get("additional_wrappers"):
            wrappers = ", ".join(str(wrapper.get("name")) for wrapper in spec["additional_wrappers"])
            raise BadInput(
                f"{what} records no qpos, and wrappers ({wrappers}) may "
                f"have changed the observations of {spec.get('id')}, which hold it otherwise. Record infos/state/qpos, "
                "or give --frames FOLDER with a video of each episode"
            )
    if columns is None:
        raise BadInput(
            f"{what} shows no frames: there are no pictures among its observations, its infos record no qpos, and the "
            f"observations of {spec.get('id')} do not hold it to the bit. Record infos/state/qpos, or give --frames "
            "FOLDER with a video of each episode"
        )
    stage = stage_of(env_spec, tuple(cameras))
    folder = columns[0][0].rpartition("/")[0] if columns else "infos/state"
    scenery = tuple(path.format(folder=folder) for path in stage.scenery)
    missing = [path for path in (*scenery, *(path for path, *_ in columns)) if path not in there]
    if missing:
        raise BadInput(
            f"{what} lacks {', '.join(missing)}, without which frames of {spec.get('id')} would be wrong. Record it, "
            "or give --frames FOLDER with a video of each episode"
        )
    noisy = not recorded and entry_point.startswith(_KITCHEN) and any(kwargs.get(name, 1) for name in NOISE)
    states = States(file, tuple(episodes), env_spec, columns, scenery, tuple(cameras), noisy=noisy)
    start = {name: values[0] for name, values in states._recorded(0).items()}
    if len(start["qpos"]) != stage.model.nq:
        raise BadInput(
            f"{what}: qpos must have {stage.model.nq} columns for {spec.get('id')}, got {len(start['qpos'])}"
        )
    return states if cameras or stage.is_fixed else replace(states, pose=stage.own_pose(start))


# --- the environment as a stage ---------------------------------------------------------------------------------------


class Stage:
    """One environment, and cameras that look at its model."""

    def __init__(self, env: Any, entry_point: str, cameras: tuple[str, ...]) -> None:
        """Open a GL context; see `stage_of`."""
        self.env, self.model, self.data = env, env.model, env.data
        compiled = np.empty(mujoco.mj_sizeModel(self.model), np.uint8)
        mujoco.mj_saveModel(self.model, None, compiled)
        self.model_sha256 = artifacts.hash_arrays(compiled)
        visual = self.model.vis
        visual.global_.offwidth = visual.global_.offheight = SIZE
        visual.quality.shadowsize = visual.quality.offsamples = 0
        self._put, self.scenery = next(
            ((put, needs(env)) for start, (put, needs) in SCENERY.items() if entry_point.startswith(start)), (_pose, ())
        )
        if self._put is _pose and hasattr(env, "_render_callback"):
            raise BadInput(
                f"{entry_point} places targets only while it renders, in a way that is not known here; give --frames "
                "FOLDER with a video of each episode"
            )
        self._renderer = _renderer_of(env)
        self._own = mujoco.MjvCamera()
        fixed = getattr(self._renderer, "camera_id", -1)
        self.is_fixed = fixed >= 0
        """Whether the environment was made with a camera of the model as its own."""
        if self.is_fixed:
            self._own.type, self._own.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, fixed
        views = tuple(_camera(self.model, name) for name in cameras) or (self._own,)
        self._canvas = Canvas(self.model, views, SIZE)
        self._canvas.hide_sky()

    def own_pose(self, recorded: Mapping[str, Doubles]) -> Pose:
        """Return where the camera of ``env.render()`` stands if this state is the first that it shows.

        As Gymnasium's `OffScreenViewer` and `MujocoRenderer` place it: it stays there, whatever moves.
        """
        self._put(self.env, recorded)
        mujoco.mj_fwdPosition(self.model, self.data)
        camera = mujoco.MjvCamera()
        x, y, z = np.median(self.data.geom_xpos, axis=0).tolist()
        settings = getattr(self._renderer, "default_cam_config", None) or {}
        camera.lookat, camera.distance = settings.get("lookat", (x, y, z)), self.model.stat.extent
        for field in ("distance", "azimuth", "elevation"):
            if field in settings:
                setattr(camera, field, settings[field])
        x, y, z = camera.lookat.tolist()
        return (x, y, z), camera.distance, camera.azimuth, camera.elevation

    def render(self, recorded: Mapping[str, Doubles], pose: Pose | None = None) -> list[Frame]:
        """Draw one state: one (H, W, 3) frame per camera; `pose` is of the environment's own."""
        self._put(self.env, recorded)
        mujoco.mj_fwdPosition(self.model, self.data)
        if pose is not None:
            self._own.lookat, self._own.distance, self._own.azimuth, self._own.elevation = pose
        return list(self._canvas.draw(self.data))

    def close(self) -> None:
        """Free the GL context."""
        self._canvas.close()


@functools.cache
def stage_of(env_spec: str, cameras: tuple[str, ...]) -> Stage:
    """Return this process's stage, open until the process ends.

    Raises:
        BadInput: not an EnvSpec, not a registered environment, or one without a MuJoCo model or such a camera.
        ZestError: the environment cannot be made with the packages here, or no GL backend works.
    """
    try:
        spec = gymnasium.envs.registration.EnvSpec.from_json(env_spec)
    except (ValueError, KeyError, TypeError) as error:
        raise BadInput(f"the dataset's env_spec is not the JSON of a Gymnasium EnvSpec: {error!r}") from error
    own = rebuilt_states.registered(spec.id)
    if own is not None and spec.id not in gymnasium.registry:
        rebuilt_states.load(own)  # its module registers the environment
    check_registered(spec)
    spec.additional_wrappers = ()  # what they change is not shown, and they are code
    try:
        with redirect_stderr(StringIO()):  # on import gymnasium_robotics prints news of its other environments
            env: Any = gymnasium.make(spec, disable_env_checker=True).unwrapped
    except Exception as error:  # whatever an environment raises
        raise ZestError(
            f"{spec.id} cannot be made here ({type(error).__name__}: {error}); install what it needs, or give --frames "
            "FOLDER with a video of each episode"
        ) from error
    if not isinstance(getattr(env, "model", None), mujoco.MjModel):
        raise BadInput(f"{spec.id} has no MuJoCo model to render; give --frames FOLDER with a video of each episode")
    stage = Stage(env, str(spec.entry_point), cameras)
    atexit.register(stage.close)
    return stage


def _renderer_of(env: Any) -> Any:
    """Return Gymnasium's renderer of an environment, or of the one that it is built on; None: it has none."""
    inner = (getattr(env, part, None) for part in ("point_env", "ant_env", "robot_env"))
    return next((found for one in (env, *inner) if (found := getattr(one, "mujoco_renderer", None)) is not None), None)


def _camera(model: mujoco.MjModel, name: str) -> mujoco.MjvCamera:
    """Return a camera of the model."""
    camera, names = mujoco.MjvCamera(), [model.camera(i).name for i in range(model.ncam)]
    if name not in names:
        raise BadInput(f"the model has no camera {name!r}; {nearest(name, names)}")
    camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, names.index(name)
    return camera


def _pose(env: Any, recorded: Mapping[str, Doubles]) -> None:
    env.data.qpos[:] = recorded["qpos"]


def _pose_hand(env: Any, recorded: Mapping[str, Doubles]) -> None:
    state = {name: recorded[name] for name in env._state_space.spaces if name != "qvel"}
    env.set_env_state({**state, "qvel": np.zeros(env.model.nv)})


def _pose_maze(env: Any, recorded: Mapping[str, Doubles]) -> None:
    _pose(env, recorded)
    env.goal = recorded["desired_goal"]
    env.update_target_site_pos()


def _pose_fetch(env: Any, recorded: Mapping[str, Doubles]) -> None:
    _pose(env, recorded)
    mujoco.mj_forward(env.model, env.data)
    env._utils.reset_mocap2body_xpos(env.model, env.data)  # faint lines that lead the gripper
    env.goal = recorded["desired_goal"]
    env._render_callback()  # what it does before each frame of its own: the target goes where the goal is


def _goal_paths(env: Any) -> tuple[str, ...]:
    return ("observations/desired_goal",)


def _hand_paths(env: Any) -> tuple[str, ...]:
    return tuple(f"{{folder}}/{name}" for name in env._state_space.spaces if name not in ("qpos", "qvel"))


Put = Callable[[Any, Mapping[str, Doubles]], None]
SCENERY: Mapping[str, tuple[Put, Callable[[Any], tuple[str, ...]]]] = {
    _ADROIT: (_pose_hand, _hand_paths),
    _FETCH: (_pose_fetch, _goal_paths),
    _MAZES: (_pose_maze, _goal_paths),
}
"""Entry point → how a recorded state is put into the environment, and the paths of what that takes besides qpos;
``{folder}`` is the group that qpos is recorded in."""
