"""States of any MuJoCo environment → frames of what is moved: some bodies hidden, a ring of views round another one.

`SceneViews` is all that these frames depend on besides the state: a scorer keeps it, to score rollouts as it scored the
recorded episodes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Self

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import mujoco
import numpy as np
from numpy.typing import NDArray

from zest_rl.errors import BadInput
from zest_rl.runtime import artifacts
from zest_rl.runtime.gl import cached_in_thread
from zest_rl.runtime.records import from_json
from zest_rl.simulation.bodies import Bodies, robot_bodies
from zest_rl.simulation.framing import ObjectRing, Point, centre, object_geoms, seen_shares
from zest_rl.simulation.rendering import HIDDEN_GROUP, Camera
from zest_rl.simulation.views import on_grid
from zest_rl.sources.recorded_envs import Doubles, State, running_state
from zest_rl.sources.stage import SIZE, Simulation, env_facts, make_simulation
from zest_rl.sources.states import versions
from zest_rl.types import Frame

VERSION = 2
"""Raise it when a pixel changes, here or in simulation/: cached embeddings depend on it."""
_WIDTHS = (7, 4, 1, 1)  # entries of qpos of a free joint, a ball, a slide and a hinge


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
        """Return which share of a body each camera sees: (V,) in [0, 1]; see `framing.seen_shares`."""
        self._place(state, cameras)
        model, data = self.simulation.model, self.simulation.data
        return seen_shares(self._canvas, model, data, object_geoms(model, body))

    def _place(self, state: State, cameras: Sequence[Camera]) -> None:
        self.simulation.put(state)
        model = self.simulation.model
        model.geom_group[:], model.site_group[:] = self._geoms, self._sites
        self._canvas.cameras = tuple(camera.to_mujoco() for camera in cameras)


@cached_in_thread
def shared_simulation(env_spec: str) -> Simulation:
    """Return this thread's environment, whose model is drawn by `SceneStage` alone."""
    return make_simulation(env_spec)


@cached_in_thread
def scene_stage(env_spec: str, hidden: tuple[int, ...]) -> SceneStage:
    """Return this thread's stage of an environment with these bodies hidden; raises as `make_simulation`."""
    simulation = shared_simulation(env_spec)
    mask = np.zeros(simulation.model.nbody, bool)
    mask[list(hidden)] = True
    return SceneStage(simulation, mask)


def as_rendered(
    model: mujoco.MjModel, hidden: Sequence[int], tolerance: float, states: Mapping[str, Doubles]
) -> dict[str, Doubles]:
    """Return states (N, n) with qpos on the grid, the robot at rest, and no mocap bodies where all are hidden."""
    shown = np.ones(model.nq, bool)
    for joint in np.flatnonzero(np.isin(model.jnt_bodyid, hidden)):
        adr = model.jnt_qposadr[joint]
        shown[adr : adr + _WIDTHS[model.jnt_type[joint]]] = False
    on = on_grid(states["qpos"], shown, tolerance)
    placed = {**states, "qpos": np.where(shown, on, model.qpos0)}
    if np.isin(np.flatnonzero(model.body_mocapid >= 0), hidden).all():
        placed = {name: values for name, values in placed.items() if not name.startswith("mocap_")}
    return placed


@dataclass(frozen=True)
class SceneViews:
    """How a state is rendered. A state is one row: `names` side by side, and the point that is looked at."""

    env_spec: str
    """Of the environment whose model is drawn, as JSON, or ``package.module:make``."""
    names: tuple[str, ...]
    """Parts of a state, see `zest_rl.sources.recorded_envs.State`."""
    widths: tuple[int, ...]
    """Numbers in each of them."""
    hidden: tuple[int, ...]
    """Bodies of the robot."""
    body: int
    """That is looked at: the middle of its way, from where it stands in x_0."""
    ring: ObjectRing
    tolerance: float
    """See `zest_rl.simulation.scene.SceneConfig`."""

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """Read what `dataclasses.asdict` returned.

        Raises:
            TypeError: a field is missing, unknown or of another type.
        """
        return from_json(cls, {**values, "ring": from_json(ObjectRing, values["ring"])})

    @property
    def n_drawn(self) -> int:
        """Number of cameras, without those that are left out."""
        return self.ring.n_views - len(self.ring.dropped)

    @property
    def width(self) -> int:
        """Numbers in a row."""
        return sum(self.widths) + 3

    def fingerprint(self) -> str:
        """Hash of everything that a frame depends on besides the state."""
        model = shared_simulation(self.env_spec).model_sha256
        return artifacts.hash_json([versions(), model, asdict(self), SIZE, VERSION])

    def read(self, env: Any, first: Doubles | None) -> Doubles:
        """Return the row of a running environment, (width,); `first` is that of its x_0, None at x_0.

        Raises:
            BadInput: its states are of other parts.
        """
        state = running_state(env, self.names)
        got = {name: len(values) for name, values in state.items()}
        if got != dict(zip(self.names, self.widths, strict=True)):
            expected = ", ".join(f"{name} {width}" for name, width in zip(self.names, self.widths, strict=True))
            raise BadInput(
                f"the scorer looks at states of {env_facts(self.env_spec)['id']} ({expected}), but the environment has "
                f"{', '.join(f'{name} {width}' for name, width in got.items()) or 'none of them'}; evaluate in the "
                "environment of the dataset, or with --rtg schedule"
            )
        if first is not None:
            return np.concatenate([*state.values(), first[-3:]])
        placed = as_rendered(
            self._stage.simulation.model, self.hidden, self.tolerance, {n: v[None] for n, v in state.items()}
        )
        point = self._stage.lookat({name: values[0] for name, values in placed.items()}, self.body)
        return np.concatenate([*state.values(), point])

    def canonical(self, states: Doubles) -> Doubles:
        """Return rows as they are rendered, (N, width); equal rows have equal frames."""
        parts = np.split(states, np.cumsum(self.widths), axis=1)
        named = dict(zip(self.names, parts, strict=False))
        placed = as_rendered(self._stage.simulation.model, self.hidden, self.tolerance, named)
        return np.concatenate([*(placed[name] for name in self.names), parts[-1]], axis=1)

    def render(self, state: Doubles) -> list[Frame]:
        """Draw a row of `canonical`: one (H, W, 3) frame per camera."""
        *parts, point = np.split(state, np.cumsum(self.widths))
        x, y, z = point.tolist()
        return self._stage.render(dict(zip(self.names, parts, strict=True)), self.ring.cameras((x, y, z)))

    @property
    def _stage(self) -> SceneStage:
        return scene_stage(self.env_spec, self.hidden)
