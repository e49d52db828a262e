"""Recorded simulator states of any MuJoCo environment → frames of what is moved: no robot, a ring of views round it.

What is hidden and what is looked at follows from the model and the recorded states (`zest_rl.simulation.bodies`), or
from names that the user gives.
"""

from __future__ import annotations

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
from zest_rl.simulation.framing import ObjectRing, azimuth_of, centre, extent, object_geoms, robot_side
from zest_rl.simulation.rendering import Camera
from zest_rl.simulation.scene import SceneConfig
from zest_rl.sources.recorded_envs import Doubles, State
from zest_rl.sources.scene_views import VERSION, SceneStage, SceneViews, as_rendered, scene_stage, shared_simulation
from zest_rl.sources.stage import SIZE, Simulation, env_facts
from zest_rl.sources.states import States, check_env, recorded_states, versions
from zest_rl.types import Frame

_EPISODES, _STEPS, _STARTS = 50, 20, 8  # of a dataset, of which it is seen what moves, and what hides it
_EXTENT = 0.9  # quantile over episodes: what one throws off the table does not move the cameras away


@dataclass(frozen=True)
class SceneStates:
    """`EpisodeFrames` rendered from recorded simulator states; of equal states in a row only the first."""

    states: States
    hidden: tuple[int, ...]
    """Bodies of the robot."""
    body: int
    """That is looked at: the middle of its way, from where it stands in x_0 of each episode."""
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
        settings = [self.states.env_spec, versions(), model, seen, VERSION, sorted(recorded)]
        return artifacts.hash_json([artifacts.hash_arrays(*(recorded[name] for name in sorted(recorded))), settings])

    def read(self, episode: int) -> Iterator[Sequence[Frame]]:
        """Render each state that differs from the one before; the frames of one that does not are the same object."""
        rows, cameras = self._placed(episode)
        frames = list[Frame]()
        for before, row in zip([{}, *rows], rows, strict=False):
            if not before or any((row[name] != before[name]).any() for name in row):
                frames = self._stage.render(row, cameras)
            yield frames

    def at(self, episode: int, step: int, view: int | None = None) -> Sequence[Frame]:
        """Render one state."""
        rows, cameras = self._placed(episode)
        return self._stage.render(rows[step], cameras if view is None else cameras[view : view + 1])

    def _placed(self, episode: int) -> tuple[Sequence[State], tuple[Camera, ...]]:
        """Return the states of an episode, and the cameras that look at where the body stands in the first."""
        recorded = self._canonical(episode)
        rows = [{name: values[step] for name, values in recorded.items()} for step in range(len(recorded["qpos"]))]
        return rows, self.ring.cameras(self._stage.lookat(rows[0], self.body))

    def _canonical(self, episode: int) -> dict[str, Doubles]:
        """Read states as they are rendered."""
        return as_rendered(self._stage.simulation.model, self.hidden, self.tolerance, self.states.read_states(episode))

    def state_views(self) -> SceneViews:
        """Return how any state of the environment is rendered, recorded or not."""
        recorded = {name: values.shape[1] for name, values in self._canonical(0).items()}
        names = sorted(recorded)
        widths = tuple(recorded[name] for name in names)
        return SceneViews(self.states.env_spec, tuple(names), widths, self.hidden, self.body, self.ring, self.tolerance)

    @property
    def _stage(self) -> SceneStage:
        return scene_stage(self.states.env_spec, self.hidden)


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
    simulation = shared_simulation(checked)
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
    if not len(object_geoms(model, body)):
        raise BadInput(f"--look-at: {config.look_at!r} has no geoms, so there is nothing to see; name a body that has")
    return body


def _ring(
    simulation: Simulation, robot: Bodies, samples: Sequence[Sequence[State]], body: int, n_views: int
) -> ObjectRing:
    """Return the views from the robot's side: of the box round the object and its way, as far away as that is large."""
    model, data = simulation.model, simulation.data
    ways, boxes = [], []
    for sample in samples:
        simulation.put(sample[0])
        middle = centre(model, data, body)
        ways.append(robot_side(model, data, robot, middle))
        corners = []
        for state in sample:
            simulation.put(state)
            corners.append(extent(model, data, body) - middle)
        boxes.append([np.min(corners, axis=0)[0], np.max(corners, axis=0)[1]])
    low, high = (np.quantile(boxes, share, axis=0)[side] for side, share in enumerate((1 - _EXTENT, _EXTENT)))
    x, y, z = ((low + high) / 2).tolist()
    return ObjectRing(azimuth_of(ways), float(np.linalg.norm(high - low) / 2), n_views, (x, y, z))
