"""A Gymnasium wrapper that records what frames can be rendered from later, and writes a Minari dataset.

The state of the simulator is recorded rather than pictures: a scene may then be looked at from anywhere, without the
robot. What an environment changes of its model is recorded, too, such as where it puts a door.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any, SupportsFloat

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from zest_rl.data.observations import by_path
from zest_rl.data.writer import write_episodes
from zest_rl.errors import BadInput, Notice

MODEL_FIELDS = ("body_pos", "body_quat", "geom_pos", "geom_quat", "geom_size", "geom_rgba", "mat_rgba")
"""Of a model, what an environment may change at its reset, so that frames depend on it."""
DATA_FIELDS = ("qpos", "mocap_pos", "mocap_quat")
"""Of the simulator's data, what frames depend on."""
SUCCESS_KEYS = ("success", "is_success")
"""What environments call success in ``info``; the first that is there counts."""


class Recorder(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Records the episodes of a MuJoCo environment. Wrap before the first reset; an episode ends at the next reset.

    Alignment: `zest_rl.types`. ``infos/state`` gets qpos, qvel, the mocap bodies, and of the model what differs from
    when it was wrapped; ``infos/success`` what the environment calls success.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], success_key: str | None = None) -> None:
        """Wrap an environment.

        Args:
            env: a MuJoCo environment.
            success_key: entry of ``info`` that tells success, with ``/`` between keys of dictionaries in it; None: the
                first of `SUCCESS_KEYS` that is there.

        Raises:
            BadInput: it has no MuJoCo model.
        """
        super().__init__(env)
        self._success_key = success_key
        bare: Any = env.unwrapped
        self._bare = bare
        if not isinstance(getattr(bare, "model", None), mujoco.MjModel):
            raise BadInput(
                f"a recorder needs an environment with a MuJoCo model (env.unwrapped.model), got {self._bare}; record "
                "its pictures instead, and give them with --frames"
            )
        self._compiled = {name: getattr(bare.model, name).copy() for name in MODEL_FIELDS}
        self._episodes = list[_Episode]()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; one without steps is dropped."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._episodes = [*self.recorded, _Episode(seed)]
        self._add(observation, info)
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Act and record."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        episode = self._episodes[-1]
        episode.actions.append(np.array(action))
        episode.rewards.append(float(reward))
        episode.terminated = bool(terminated)
        self._add(observation, info)
        return observation, reward, terminated, truncated, info

    def _add(self, observation: Any, info: dict[str, Any]) -> None:
        model, data, episode = self._bare.model, self._bare.data, self._episodes[-1]
        state = {name: getattr(data, name).ravel().copy() for name in ("qvel", *DATA_FIELDS)}
        for name, compiled in self._compiled.items():
            if not np.array_equal(now := getattr(model, name), compiled):
                state[name] = now.ravel().copy()
        episode.observations.append(_copied(observation))
        episode.states.append(state)
        keys = SUCCESS_KEYS if self._success_key is None else (self._success_key,)
        succeeded = next((told for key in keys if (told := by_path(info).get(key)) is not None), None)
        episode.successes.append(None if succeeded is None else bool(np.any(succeeded)))

    @property
    def recorded(self) -> list[_Episode]:
        """The episodes with at least one step."""
        return [episode for episode in self._episodes if episode.actions]

    def write(
        self,
        dataset_id: str,
        description: str = "",
        *,
        ref_min_score: float | None = None,
        ref_max_score: float | None = None,
    ) -> Path:
        """Write all episodes as a new Minari dataset, and return its folder.

        Args:
            dataset_id: ``namespace/name-vN``.
            description: one paragraph for readers.
            ref_min_score: return that counts as 0 %, such as that of doing nothing.
            ref_max_score: return that counts as 100 %, such as an expert's; give both or none.

        Raises:
            BadInput: nothing was recorded, no ``info`` had the success_key, the id is not ``namespace/name-vN``, or a
                dataset of this id exists.
            ZestError: the disk is full or read-only; nothing is left behind.
        """
        episodes = self.recorded
        if not episodes:
            raise BadInput("a dataset must have at least 1 episode with a step, got none; act in the environment first")
        told = [success for episode in episodes for success in episode.successes if success is not None]
        if self._success_key is not None and not told:
            raise BadInput(
                f"success is read from info by the key {self._success_key!r}, but no info of {len(episodes)} episodes "
                "has it; write the keys of dictionaries in it as outer/inner"
            )
        if (env_spec := _storable(self.env.spec)) is None:
            warnings.warn(
                f"{dataset_id} cannot name its environment, which has no spec that a file can hold; where frames are "
                "rendered from it, give a function that makes it: --env package.module:make",
                Notice,
                stacklevel=2,
            )
        names = sorted({name for episode in episodes for state in episode.states for name in state})
        rest = {name: values.ravel() for name, values in self._compiled.items()}
        return write_episodes(
            dataset_id,
            [episode.arrays(names, rest) for episode in episodes],
            observation_space=self.env.observation_space,
            action_space=self.env.action_space,
            env_spec=env_spec,
            description=description or f"Recorded in {self.env.spec.id if self.env.spec else self._bare}.",
            ref_min_score=ref_min_score,
            ref_max_score=ref_max_score,
        )


class _Episode:
    """What was recorded of an episode so far."""

    def __init__(self, seed: int | None) -> None:
        self.seed, self.terminated = seed, False
        self.observations, self.actions, self.rewards = list[Any](), list[NDArray[Any]](), list[float]()
        self.states, self.successes = list[dict[str, NDArray[np.float64]]](), list[bool | None]()

    def arrays(self, names: list[str], rest: dict[str, NDArray[np.float64]]) -> dict[str, Any]:
        """Return the arguments of a Minari EpisodeBuffer; a state without one of `names` has that of `rest`."""
        state = {name: np.stack([s[name] if name in s else rest[name] for s in self.states]) for name in names}
        infos: dict[str, Any] = {"state": {name: values for name, values in state.items() if values.size}}
        if any(success is not None for success in self.successes):
            infos["success"] = np.array([bool(success) for success in self.successes])
        last = np.arange(len(self.actions)) == len(self.actions) - 1
        return {
            "observations": _stacked(self.observations),
            "actions": np.stack(self.actions),
            "rewards": np.array(self.rewards, np.float32),
            "terminations": last & self.terminated,
            "truncations": last & (not self.terminated),
            "infos": infos,
        } | ({} if self.seed is None else {"seed": self.seed})


def _copied(observation: Any) -> Any:
    if isinstance(observation, dict):
        return {name: _copied(part) for name, part in observation.items()}
    return np.array(observation)


def _stacked(rows: list[Any]) -> Any:
    if isinstance(rows[0], dict):
        return {name: _stacked([row[name] for row in rows]) for name in rows[0]}
    return np.stack(rows)


def _storable(spec: gymnasium.envs.registration.EnvSpec | None) -> str | None:
    """Return a spec as JSON; None where it has functions or wrappers that no file can make again."""
    if spec is None or callable(spec.entry_point) or any(w.kwargs is None for w in spec.additional_wrappers):
        return None
    try:
        return spec.to_json()
    except (TypeError, ValueError):
        return None
