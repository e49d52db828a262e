"""Recorded simulator states of any MuJoCo environment → frames of what is moved: no robot, a ring of views round it.

What is hidden and what is looked at follows from the model and the recorded states (`zest_rl.simulation.bodies`), or
from names that the user gives.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import mujoco
import numpy as np
from numpy.typing import NDArray

from zest_rl.errors import BadInput
from zest_rl.runtime import artifacts
from zest_rl.simulation.bodies import (
    Bodies,
    bodies_named,
    body_name,
    joint_travel,
    moved_body,
    robot_bodies,
    subtree,
)
from zest_rl.simulation.framing import (
    HIDDEN_GROUP,
    ObjectRing,
    Point,
    azimuth_of,
    centre,
    object_geoms,
    radius,
    robot_side,
)
from zest_rl.simulation.rendering import Camera
from zest_rl.simulation.scene import SceneConfig
from zest_rl.simulation.views import on_grid
from zest_rl.sources.recorded_envs import Doubles, State
from zest_rl.sources.stage import SIZE, Simulation, env_facts, make_simulation
from zest_rl.sources.states import States, check_env, recorded_states, versions
from zest_rl.types import Frame

_VERSION = 1  # raise it when a pixel changes, here or in simulation/: cached embeddings depend on it
_EPISODES, _STEPS, _STARTS = 50, 20, 8  # of a dataset, of which it is seen what moves, and what hides it
_EXTENT = 0.9  # quantile over episodes: what one throws off the table does not move the cameras away


class SceneStage:
    """A simulation in which some bodies are hidden, drawn without marks, shadows and sky."""

    def __init__(self, simulation: Simulation, hidden: Bodies) -> None:
        """Open a GL context; see `scene_stage`."""
        self.simulation, model = simulation, simulation.model
        groups, marks = simulation.groups, robot_bodies(model) & ~hidden  # marks on a robot in view are part of it
        self._geoms = np.where(hidden[model.geom_bodyid], HIDDEN_GROUP, groups.geoms)
        self._sites = np.where(marks[model.site_bodyid], groups.sites, HIDDEN_GROUP)
        self._canvas = simulation.open_canvas(())
        self._canvas.hide_tendons()

    def lookat(self, state: State, body: int) -> Point:
        """Return the middle of a body as it stands in a state, in metres."""
        self.simulation.put(state)
        return centre(self.simulation.model, self.simulation.data, body)

    def render(self, state: State, cameras: Sequence[Camera]) -> list[Frame]:
        """Draw one state: one (H, W, 3) frame per camera."""
        self._place(state, cameras)
        return list(self._canvas.draw(self.simulation.data))

    def seen_shares(self, state: State, cameras: Sequence[Camera], body: int) -> NDArray[np.float64]:
        """Return which share of a body each camera sees, of what it would see of the body alone: (V,) in [0, 1].

        1 where the body is out of sight for other reasons.
        """
        self._place(state, cameras)
        model, geoms = self.simulation.model, object_geoms(self.simulation.model, body)
        in_scene = np.isin(self._canvas.segments(self.simulation.data), geoms).sum(axis=(1, 2))
        model.geom_group[np.setdiff1d(np.arange(model.ngeom), geoms)] = HIDDEN_GROUP
        alone = np.isin(self._canvas.segments(self.simulation.data), geoms).sum(axis=(1, 2))
        return np.where(alone > 0, in_scene / np.maximum(alone, 1), 1.0)

    def _place(self, state: State, cameras: Sequence[Camera]) -> None:
        self.simulation.put(state)
        model = self.simulation.model
        model.geom_group[:], model.site_group[:] = self._geoms, self._sites
        self._canvas.cameras = tuple(camera.to_mujoco() for camera in cameras)


@functools.cache
def _simulation(env_spec: str) -> Simulation:
    """Return this process's environment, whose model is drawn by `SceneStage` alone."""
    return make_simulation(env_spec)


@functools.cache
def scene_stage(env_spec: str, hidden: tuple[int, ...]) -> SceneStage:
    """Return this process's stage of an environment with these bodies hidden; raises as `make_simulation`."""
    simulation = _simulation(env_spec)
    mask = np.zeros(simulation.model.nbody, bool)
    mask[list(hidden)] = True
    return SceneStage(simulation, mask)


@dataclass(frozen=True)
class SceneStates:
    """`EpisodeFrames` rendered from recorded simulator states; of equal states in a row only the first."""

    states: States
    hidden: tuple[int, ...]
    """Bodies of the robot."""
    body: int
    """That is looked at, where it stands in x_0 of each episode."""
    ring: ObjectRing
    tolerance: float
    """See `SceneConfig`."""
    liveliest: int
    """Of the episodes that were looked at, the one in which the body moves most."""

    @property
    def views(self) -> Sequence[str]:
        """Pose of each camera."""
        cameras = self.ring.cameras((0.0, 0.0, 0.0))
        return [f"azimuth {c.azimuth:.0f}°, elevation {c.elevation:g}°, {c.distance:.2f} m" for c in cameras]

    def describe(self) -> dict[str, Any]:
        """Where the states come from, what is hidden and what is looked at."""
        model, hidden = self._stage.simulation.model, set(self.hidden)
        roots = [body_name(model, body) for body in self.hidden if model.body_parentid[body] not in hidden]
        facts = self.states.describe()
        del facts["camera_pose"]
        scene = {"robot": roots, "look_at": body_name(model, self.body), "ring": asdict(self.ring)}
        found = {"tolerance": self.tolerance, "liveliest": self.liveliest}
        return {**facts, "kind": "scene", "views": list(self.views), **scene, **found}

    def digest(self, episode: int) -> str:
        """Hash the states as they are rendered, the environment with its versions and its model, and the views."""
        recorded, model = self._canonical(episode), self._stage.simulation.model_sha256
        seen = [self.hidden, self.body, asdict(self.ring), SIZE]
        settings = [self.states.env_spec, versions(), model, seen, _VERSION, sorted(recorded)]
        return artifacts.hash_json([artifacts.hash_arrays(*(recorded[name] for name in sorted(recorded))), settings])

    def read(self, episode: int) -> Iterator[Sequence[Frame]]:
        """Render each state that differs from the one before; the frames of one that does not are the same object."""
        rows, cameras = self._placed(episode)
        frames = list[Frame]()
        for before, row in zip([{}, *rows], rows, strict=False):
            if not before or any((row[name] != before[name]).any() for name in row):
                frames = self._stage.render(row, cameras)
            yield frames

    def ends(self, episode: int) -> tuple[Sequence[Frame], Sequence[Frame]]:
        """Render x_0 and x_T."""
        rows, cameras = self._placed(episode)
        return self._stage.render(rows[0], cameras), self._stage.render(rows[-1], cameras)

    def _placed(self, episode: int) -> tuple[Sequence[State], tuple[Camera, ...]]:
        """Return the states of an episode, and the cameras that look at where the body stands in the first."""
        recorded = self._canonical(episode)
        rows = [{name: values[step] for name, values in recorded.items()} for step in range(len(recorded["qpos"]))]
        return rows, self.ring.cameras(self._stage.lookat(rows[0], self.body))

    def _canonical(self, episode: int) -> dict[str, Doubles]:
        """Read states with qpos on the grid, and the robot at rest."""
        recorded, model = self.states.read_states(episode), self._stage.simulation.model
        shown = np.ones(model.nq, bool)
        for joint in np.flatnonzero(np.isin(model.jnt_bodyid, self.hidden)):
            adr = model.jnt_qposadr[joint]
            shown[adr : adr + _WIDTHS[model.jnt_type[joint]]] = False
        on = on_grid(recorded["qpos"], shown, self.tolerance)
        recorded["qpos"] = np.where(shown, on, model.qpos0)
        if np.isin(np.flatnonzero(model.body_mocapid >= 0), self.hidden).all():
            recorded = {name: values for name, values in recorded.items() if not name.startswith("mocap_")}
        return recorded

    @property
    def _stage(self) -> SceneStage:
        return scene_stage(self.states.env_spec, self.hidden)


_WIDTHS = (7, 4, 1, 1)  # entries of qpos of a free joint, a ball, a slide and a hinge


def find_scene(
    file: Path, episodes: Sequence[str], env_spec: str | None, config: SceneConfig, what: str
) -> SceneStates:
    """Find the simulator states that a Minari dataset records, what of them is the robot, and what is to be seen.

    Args:
        file: its HDF5 file.
        episodes: the groups in it.
        env_spec: of its environment, as JSON.
        config: what is given by name.
        what: names the dataset in an error.

    Raises:
        BadInput: as `recorded_states`; or there is no robot, no object, or no body of a given name.
        ZestError: the environment cannot be made here.
    """
    checked = check_env(env_spec, what)
    simulation = _simulation(checked)
    states = recorded_states(file, episodes, checked, simulation, what, marks=False)
    model = simulation.model
    robot = subtree(model, bodies_named(model, config.robot, "--robot")) if config.robot else robot_bodies(model)
    if not (robot.any() or config.show_robot):
        raise BadInput(
            f"the robot is found by what drives it, but {env_facts(checked)['id']} has no actuated joint, and no "
            "body that is welded to a mocap body; name the robot's bodies with --robot BODY …, or hide nothing "
            "(--show-robot)"
        )
    hidden = () if config.show_robot else tuple(np.flatnonzero(robot).tolist())
    chosen = _spread(len(episodes), _EPISODES)
    samples = [_sample(states.read_states(episode)) for episode in chosen]
    travel = np.stack([_travel(simulation, sample) for sample in samples])
    body = _looked_at(model, config, robot, travel.mean(axis=0))
    joints = np.isin(model.jnt_bodyid, np.flatnonzero(subtree(model, [body])))
    liveliest = chosen[int(travel[:, joints].max(axis=1, initial=0).argmax())]
    stage = scene_stage(checked, hidden)
    starts = [samples[i][0] for i in _spread(len(samples), _STARTS)]

    def seen_shares(ring: ObjectRing) -> NDArray[np.float64]:
        shares = [stage.seen_shares(start, ring.cameras(stage.lookat(start, body)), body) for start in starts]
        return np.asarray(np.mean(shares, axis=0))

    ring = _ring(simulation, robot, samples, body, config.n_views).that_sees(seen_shares)
    return SceneStates(states, hidden, body, ring, config.tolerance, liveliest)


def _spread(n: int, most: int) -> list[int]:
    """Return at most `most` of n indices, evenly spread."""
    return sorted(set(np.linspace(0, n - 1, min(n, most)).astype(int).tolist()))


def _sample(recorded: Mapping[str, Doubles]) -> list[State]:
    """Return some states of an episode, that of x_0 first."""
    return [
        {name: values[step] for name, values in recorded.items()} for step in _spread(len(recorded["qpos"]), _STEPS)
    ]


def _travel(simulation: Simulation, sample: Sequence[State]) -> NDArray[np.float64]:
    simulation.put(sample[0])
    return joint_travel(simulation.model, simulation.data, np.stack([state["qpos"] for state in sample]))


def _looked_at(model: mujoco.MjModel, config: SceneConfig, robot: Bodies, travel: NDArray[np.float64]) -> int:
    """Return the body that the user names, else the one that moves most."""
    if config.look_at is None:
        only_robot = config.show_robot and robot[model.jnt_bodyid].all()
        return moved_body(model, travel, np.zeros_like(robot) if only_robot else robot)
    (body,) = bodies_named(model, [config.look_at], "--look-at")
    if robot[body] and not config.show_robot:
        raise BadInput(
            f"--look-at: {config.look_at!r} belongs to the robot, which is hidden; keep it in view with --show-robot, "
            "or name the bodies that are the robot with --robot BODY …"
        )
    return body


def _ring(
    simulation: Simulation, robot: Bodies, samples: Sequence[Sequence[State]], body: int, n_views: int
) -> ObjectRing:
    """Return the views from the robot's side, as far away as the object and its way are large."""
    model, data = simulation.model, simulation.data
    ways, radii = [], []
    for sample in samples:
        simulation.put(sample[0])
        lookat = centre(model, data, body)
        ways.append(robot_side(model, data, robot, lookat))
        farthest = 0.0
        for state in sample:
            simulation.put(state)
            farthest = max(farthest, radius(model, data, body, lookat))
        radii.append(farthest)
    return ObjectRing(azimuth_of(ways), float(np.quantile(radii, _EXTENT)), n_views)
