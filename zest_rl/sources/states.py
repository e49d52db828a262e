"""Recorded simulator states of a Gymnasium environment → frames, rendered from the environment's own model.

A frame is exact if everything that moves is in qpos or listed in `zest_rl.sources.recorded_envs`, such as targets and
furniture that an environment places anew in each episode. Only environments that `zest_rl.data.env_specs` trusts, or
that have a plugin (`zest_rl.sources.state_plugins`), are made.
"""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from zest_rl.data.env_specs import check_env_spec, check_model_files, entry_points, is_maker, without_wrappers
from zest_rl.data.hdf5 import check_rows, open_hdf5, read_array
from zest_rl.data.observations import entries
from zest_rl.errors import BadInput, ZestError
from zest_rl.runtime import artifacts
from zest_rl.simulation.recorder import DATA_FIELDS, MODEL_FIELDS
from zest_rl.sources import state_plugins
from zest_rl.sources.recorded_envs import Columns, Doubles, RecordedEnv
from zest_rl.sources.stage import SIZE, Pose, Simulation, env_facts, stage_of
from zest_rl.types import Frame, check_finite

_VERSION = 2  # raise it when a pixel changes, here or in stage.py: cached embeddings depend on it
DEFAULT_CAMERA = "the environment's own camera"
"""Name of its view."""


@dataclass(frozen=True)
class States:
    """`EpisodeFrames` rendered from the simulator states in a Minari dataset."""

    file: Path
    episodes: tuple[str, ...]
    """Groups of the episodes."""
    env_spec: str
    """Of the environment, as JSON, checked; or ``package.module:make``."""
    qpos: Columns
    """Empty: a plugin rebuilds it (`state_plugins`)."""
    scenery: tuple[str, ...]
    """Paths of everything else in the scene."""
    cameras: tuple[str, ...] = ()
    """Of the model; empty: the environment's default camera."""
    pose: Pose | None = None
    """Of the default camera; None where it is a camera of the model."""
    noisy: bool = False
    """Whether the observations from which qpos is read have noise."""

    @property
    def views(self) -> Sequence[str]:
        """Names of the cameras."""
        return self.cameras or (DEFAULT_CAMERA,)

    def describe(self) -> dict[str, Any]:
        """Where the states come from, and how they are rendered."""
        return {
            "kind": "states",
            "views": list(self.views),
            "qpos_from": [list(column) for column in self.qpos] or self._plugin.value,
            "qpos_is_noisy": self.noisy,
            "scenery_from": list(self.scenery),
            "camera_pose": self.pose,
            "size": SIZE,
            "env_id": env_facts(self.env_spec).get("id"),
        }

    def digest(self, episode: int) -> str:
        """Hash the states, the environment with its versions and its model, and the cameras."""
        recorded = self.read_states(episode)
        model = stage_of(self.env_spec, self.cameras).simulation.model_sha256
        settings = [self.env_spec, versions(), model, self.cameras, self.pose, SIZE, _VERSION, sorted(recorded)]
        return artifacts.hash_json([artifacts.hash_arrays(*(recorded[name] for name in sorted(recorded))), settings])

    def start(self, episode: int) -> dict[str, Doubles]:
        """Read the state of x_0."""
        return {name: values[0] for name, values in self.read_states(episode).items()}

    def read(self, episode: int) -> Iterator[Sequence[Frame]]:
        """Render each state."""
        recorded, stage = self.read_states(episode), stage_of(self.env_spec, self.cameras)
        for step in range(len(recorded["qpos"])):
            yield stage.render({name: values[step] for name, values in recorded.items()}, self.pose)

    def read_states(self, episode: int) -> dict[str, Doubles]:
        """Read ``qpos`` (T+1, nq), and everything else in the scene (T+1, n) by the last part of its path."""
        with open_hdf5(self.file) as file:
            group = file[self.episodes[episode]]
            n_states = len(group["actions"]) + 1
            states = {path.rpartition("/")[2]: _rows(group, path, n_states) for path in self.scenery}
            if not self.qpos:
                return {**states, "qpos": state_plugins.rebuild(self._plugin, group, n_states)}
            columns = [_rows(group, path, n_states)[:, first:end] for path, first, end in self.qpos]
            return {**states, "qpos": np.concatenate(columns, axis=1)}

    @property
    def _plugin(self) -> EntryPoint:
        entry = state_plugins.registered(env_facts(self.env_spec)["id"])
        if entry is None:
            raise ZestError("the package that rebuilds the states is not installed on this machine; install it")
        return entry


def versions() -> list[str]:
    """Return the versions of the packages that make environments and draw them."""
    return [importlib.metadata.version(name) for name in ("mujoco", "gymnasium", "gymnasium-robotics")]


def _rows(group: h5py.Group, path: str, n_states: int) -> Doubles:
    if not isinstance(group.get(path), h5py.Dataset):
        raise BadInput(f"{group.name} has no {path!r}, which its frames are rendered from; record it, or give --frames")
    name = f"{group.name}/{path}"
    check_rows(name, group[path], n_states - 1, 1)
    return check_finite(name, read_array(group[path], np.float64)).reshape(n_states, -1)


def find_states(file: Path, episodes: Sequence[str], env_spec: str | None, cameras: Sequence[str], what: str) -> States:
    """Find the simulator states that a Minari dataset records, and the cameras that look at them.

    Args:
        file: its HDF5 file.
        episodes: the groups in it.
        env_spec: of its environment, as JSON.
        cameras: of the model; empty: the environment's default.
        what: names the dataset in an error.

    Raises:
        BadInput: as `recorded_states`, or there is no such camera.
        ZestError: the environment cannot be made here.
    """
    checked = check_env(env_spec, what)
    stage = stage_of(checked, tuple(cameras))
    states = recorded_states(file, episodes, checked, stage.simulation, what)
    states = replace(states, cameras=tuple(cameras))
    return states if cameras or stage.is_fixed else replace(states, pose=stage.default_pose(states.start(0)))


def check_env(env_spec: str | None, what: str) -> str:
    """Return the EnvSpec (JSON) of a dataset, or what the user named instead, if its environment may be made.

    Raises:
        BadInput: there is none, it would run code that is not trusted, or it names a model that is no file.
    """
    if env_spec is None:
        raise BadInput(
            f"{what} shows no frames: there are no pictures to choose, and it names no environment whose recorded "
            "states could be rendered; give --env package.module:make, a function that makes it, or --frames FOLDER "
            "with a video of each episode"
        )
    if is_maker(env_spec):
        return env_spec
    entry_points(env_spec, f"the env_spec of {what}")
    spec = json.loads(env_spec)
    if state_plugins.registered(str(spec.get("id"))) is None:
        code = without_wrappers(env_spec)
        check_env_spec(code, f"the env_spec of {what}", "give --frames FOLDER with a video of each episode")
    check_model_files(spec)
    return env_spec


def recorded_states(
    file: Path, episodes: Sequence[str], env_spec: str, simulation: Simulation, what: str, *, marks: bool = True
) -> States:
    """Find the simulator states that a Minari dataset records.

    Args:
        file: its HDF5 file.
        episodes: the groups in it.
        env_spec: of its environment, as JSON, checked.
        simulation: that environment.
        what: names the dataset in an error.
        marks: whether frames show marks of goals, so that these must be recorded, too.

    Raises:
        BadInput: no state, several, or one that does not fit the model.
    """
    spec, row, env = env_facts(env_spec), simulation.recorded, simulation.env
    plugin = state_plugins.registered(str(spec.get("id")))
    with open_hdf5(file) as opened:
        group = opened[episodes[0]]
        infos = entries(group["infos"], "infos") if "infos" in group else {}
        recorded = [path for path in infos if path.rpartition("/")[2] == "qpos"]
        paths = {*infos, *entries(group["observations"], "observations")}
    if plugin is not None:
        columns: Columns = ()
    elif len(recorded) > 1:
        raise BadInput(f"{what} records several states ({', '.join(recorded)}); remove all but one")
    else:
        columns = ((recorded[0], 0, None),) if recorded else _observed_qpos(row, spec, what)
    folder = columns[0][0].rpartition("/")[0] if columns else "infos/state"
    scenery = [path.format(folder=folder) for path in row.scenery(env)] if marks or row.moves_bodies else []
    fields = [path for name in (*MODEL_FIELDS, *DATA_FIELDS[1:]) if (path := f"{folder}/{name}") in paths]
    missing = [path for path in (*scenery, *(path for path, *_ in columns)) if path not in paths]
    if missing and any(path.endswith(MODEL_FIELDS) for path in fields):
        scenery = []  # they hold the same
    elif missing:
        raise BadInput(
            f"{what} lacks {', '.join(missing)}, without which frames of {spec.get('id')} would be wrong. Record it, "
            "or give --frames FOLDER with a video of each episode"
        )
    noisy = not recorded and any((spec.get("kwargs") or {}).get(name, 1) for name in row.noise)
    states = States(file, tuple(episodes), env_spec, columns, (*scenery, *fields), noisy=noisy)
    if (width := len(states.start(0)["qpos"])) != simulation.model.nq:
        raise BadInput(f"{what}: qpos must have {simulation.model.nq} columns for {spec.get('id')}, got {width}")
    for owner, names in ((simulation.model, MODEL_FIELDS), (simulation.data, DATA_FIELDS)):
        for name in {*names} & {path.rpartition("/")[2] for path in fields}:
            expected, got = getattr(owner, name).size, len(states.start(0)[name])
            if got != expected:
                raise BadInput(
                    f"{what}: {name} must hold {expected} numbers for {spec.get('id')}, got {got}; install the version "
                    "of its package that it was recorded with"
                )
    return states


def _observed_qpos(row: RecordedEnv, spec: Mapping[str, Any], what: str) -> Columns:
    """Return the columns of the observations that hold qpos, where the infos do not."""
    columns = row.observed_qpos(spec.get("kwargs") or {})
    if columns is None:
        raise BadInput(
            f"{what} shows no frames: there are no pictures among its observations, its infos record no qpos, and the "
            f"observations of {spec.get('id')} do not hold it to the bit. Record infos/state/qpos, or give --frames "
            "FOLDER with a video of each episode"
        )
    if spec.get("additional_wrappers"):
        wrappers = ", ".join(str(wrapper.get("name")) for wrapper in spec["additional_wrappers"])
        raise BadInput(
            f"{what} records no qpos, and wrappers ({wrappers}) may have changed the observations of "
            f"{spec.get('id')}, which hold it otherwise. Record infos/state/qpos, or give --frames FOLDER with a video "
            "of each episode"
        )
    return columns
