"""The environment of a run's dataset, made as it was recorded: which one, how long, and what it tells.

Its code is that of a trusted package under its registered id, with wrappers that read and write no files; or a function
that the user names (`zest_rl.simulation.makers`).
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import gymnasium
import mujoco
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from zest_rl.data.env_specs import (
    WRAPPERS,
    check_env_spec,
    check_model_files,
    check_registered,
    is_maker,
    without_wrappers,
)
from zest_rl.data.observations import at_path, by_path, flatten, numeric_paths, observed
from zest_rl.data.provenance import DatasetRecord
from zest_rl.errors import BadInput, Notice, ZestError, nearest
from zest_rl.kitchen.env import ENV_ID, env_spec
from zest_rl.kitchen.videos import FPS
from zest_rl.runtime import artifacts
from zest_rl.runtime.records import from_json
from zest_rl.simulation.makers import check_named, make_named, named_by_user, source_sha256
from zest_rl.simulation.recorder import DATA_FIELDS, MODEL_FIELDS, SUCCESS_KEYS
from zest_rl.sources import state_plugins
from zest_rl.sources.recorded_envs import recorded_env, running_state
from zest_rl.sources.stage import env_facts, model_sha256
from zest_rl.sources.states import versions
from zest_rl.types import FloatArray

MAX_HORIZON = 10_000
"""Steps of an episode."""
_MOST_PROBED = 1000  # steps in which success is looked for
_INSTEAD = "give --env package.module:make, a function that makes it"
_STEPS_PER_SECOND = 25.0


@dataclass(frozen=True)
class RunEnvironment:
    """Everything about the environment of an evaluation; jobs carry it to worker processes."""

    made_by: str
    """EnvSpec as JSON, checked; or ``package.module:make``, named by the user."""
    horizon: int
    """Steps after which an episode that did not end is cut."""
    success_key: str | None
    """Of success in ``info``, with ``/`` between the keys of nested dictionaries; None: nothing tells it."""
    state: tuple[str, ...] = ()
    """Parts of the simulator's state that are kept, to draw videos; see `zest_rl.sources.recorded_envs.State`."""
    fps: float = _STEPS_PER_SECOND
    """Steps per second of a video."""
    observed: tuple[str, ...] = ("",)
    """Paths of the observations that a policy is given, as `zest_rl.data.observations.numbers` chooses them."""
    code_sha256: str = ""
    """Of its packages' versions, its model and the files that make it: one that was changed is evaluated again."""

    @property
    def is_kitchen(self) -> bool:
        """Whether it is zest/Kitchen-v1, whose episodes all last until the horizon."""
        return self.success_key == "gt/success" and not is_maker(self.made_by)

    @property
    def name(self) -> str:
        """Id of the environment, or the function that makes it."""
        return ENV_ID if self.is_kitchen else _name(self.made_by)

    def make(self) -> gymnasium.Env[Any, Any]:
        """Make one; raises as `_make`."""
        return _make(self.made_by, self.horizon)

    def flatten(self, observations: Sequence[Any]) -> FloatArray:
        """Return the observations of N environments as a policy is given them: (N, obs_dim) float32."""
        arrays = observed(observations)
        return flatten({path: arrays[path] for path in self.observed})

    def tell(self, env: gymnasium.Env[Any, Any], reward: float | None, info: Mapping[str, Any]) -> dict[str, Any]:
        """Return one time step of the traces: gt_reward (float32), gt_success (bool) where it is told, and the parts of
        the state (n,).

        `reward` is None at the reset, at which only the kitchen tells one.
        """
        if reward is None:
            reward = (at_path(info, "gt/reward") or 0.0) if self.is_kitchen else 0.0
        told: dict[str, Any] = {"gt_reward": np.float32(reward)}
        if self.success_key is not None:
            value = at_path(info, self.success_key)
            told["gt_success"] = value is not None and bool(np.asarray(value).any())
        return told | running_state(env.unwrapped, self.state)


KITCHEN = RunEnvironment("", 1, "gt/success", ("qpos",), FPS)
"""What a kept evaluation in zest/Kitchen-v1 says of it: there is nothing to choose."""


def act_in(env: gymnasium.Env[Any, Any], actions: FloatArray) -> Any:
    """Return actions (…, act_dim) of a policy in the form and the bounds of the environment's space."""
    space = env.action_space
    assert isinstance(space, gymnasium.spaces.Box)
    shaped = actions.reshape(*actions.shape[:-1], *space.shape)
    return np.minimum(np.maximum(shaped, space.low), space.high).astype(space.dtype)


def find_environment(
    meta: Mapping[str, Any], *, env: str | None = None, horizon: int | None = None, success_key: str | None = None
) -> RunEnvironment:
    """Find the environment of a run, make it once, and compare it with what the run was trained on.

    Args:
        meta: the run's ``meta.json``.
        env: ``package.module:make``, which the user names; None: that of the dataset.
        horizon: steps of an episode; None: those of the dataset's longest, or as registered where these are unknown.
        success_key: of success in ``info``; None: the first of `SUCCESS_KEYS` that is there.

    Raises:
        BadInput: there is no environment, its code is not trusted, it is not there, it observes or acts otherwise than
            in training, or there is no such key.
        ZestError: it cannot be made here.
    """
    if horizon is not None and not 1 <= horizon <= MAX_HORIZON:
        raise BadInput(f"--horizon must be 1 to {MAX_HORIZON} steps, got {horizon}; leave it out for the dataset's own")
    dataset = DatasetRecord.of_run(meta)
    if env is None and dataset.env.get("id") == ENV_ID:
        spec = kitchen_spec(dataset.env_spec or "")
        cut = replace(spec, max_episode_steps=horizon or spec.max_episode_steps)
        assert cut.max_episode_steps is not None
        return replace(KITCHEN, made_by=cut.to_json(), horizon=cut.max_episode_steps)
    made_by = named_by_user(env) if env is not None else _named_by_data(dataset)
    return _probed(made_by, meta, horizon, success_key)


def is_evaluable(meta: Mapping[str, Any]) -> bool:
    """Whether the dataset of a run names an environment in which its policy may be evaluated; `meta`: ``meta.json``."""
    try:
        _named_by_data(DatasetRecord.of_run(meta))
    except ZestError:
        return False
    return True


def _named_by_data(dataset: DatasetRecord) -> str:
    """Return what a dataset names as its environment, once it is safe to make it."""
    what = f"dataset {dataset.id}"
    if dataset.maker is not None:  # the user chose it rather than what was recorded
        check_named(dataset.maker, what)
        return dataset.maker
    if dataset.env_spec is None:
        raise BadInput(f"{what} names no environment in which a policy could be evaluated; {_INSTEAD}")
    text, spec = dataset.env_spec, dataset.env
    plugin = state_plugins.registered(str(spec.get("id")))
    instead = f"{_INSTEAD}, wrappers included"
    if plugin is None:
        check_env_spec(text, f"the environment of {what}", instead)
    else:
        state_plugins.load(plugin)  # its module registers the environment
    for wrapper in spec.get("additional_wrappers") or ():
        if wrapper["entry_point"] not in WRAPPERS:
            raise BadInput(
                f"{what} was recorded with the wrapper {wrapper.get('name')} ({wrapper['entry_point']}), which is not "
                f"made because a file says so; {instead}"
            )
    check_registered(_parsed(text), f"install the version of its package that it was recorded with, or {_INSTEAD}")
    check_model_files(spec)
    return text


def _parsed(text: str) -> EnvSpec:
    try:
        return EnvSpec.from_json(text)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise BadInput(f"the environment of the run is not the JSON of a Gymnasium EnvSpec: {error!r}") from error


def _name(made_by: str) -> str:
    return made_by if is_maker(made_by) else _parsed(without_wrappers(made_by)).id


def _make(made_by: str, horizon: int | None) -> gymnasium.Env[Any, Any]:
    """Make an environment; one that is made by its id ends its episodes at the horizon. Raises as `make_named`."""
    if is_maker(made_by):
        return make_named(made_by)
    spec = _parsed(made_by)
    kwargs = {key: value for key, value in spec.kwargs.items() if key != "render_mode"}  # no windows
    spec = replace(spec, kwargs=kwargs, max_episode_steps=horizon or spec.max_episode_steps)
    try:
        return gymnasium.make(spec, disable_env_checker=True)
    except Exception as error:  # whatever an environment raises
        raise ZestError(
            f"{spec.id} cannot be made here ({type(error).__name__}: {error}); install what it needs in the version "
            f"that it was recorded with, or {_INSTEAD}"
        ) from error


def _probed(made_by: str, meta: Mapping[str, Any], horizon: int | None, success_key: str | None) -> RunEnvironment:
    """Make an environment, take one step, and see what it tells."""
    env = _make(made_by, horizon)
    name, bare = _name(made_by), env.unwrapped
    model: Any = getattr(bare, "model", None)
    has_model = isinstance(model, mujoco.MjModel)
    try:
        if not isinstance(env.action_space, gymnasium.spaces.Box):
            raise BadInput(f"a policy here acts by continuous actions (Box), but {name} takes {env.action_space}")
        compiled = _model_fields(bare)
        env.action_space.seed(0)
        first, _ = env.reset(seed=0)
        after_reset, model_hash = _model_fields(bare), model_sha256(model) if has_model else None
        paths = numeric_paths([first])
        _check_spaces(name, first, paths, env.action_space, meta)
        own_horizon = None if env.spec is None else env.spec.max_episode_steps
        steps = horizon or meta.get("max_steps") or own_horizon
        if type(steps) is not int or not 1 <= steps <= MAX_HORIZON:
            raise BadInput(f"{name} must have a horizon of 1 to {MAX_HORIZON} steps, got {steps}; give --horizon N")
        key = _success_key(env, name, min(steps, _MOST_PROBED), success_key)
    except ZestError:
        raise
    except Exception as error:  # whatever an environment raises
        raise ZestError(
            f"{name} fails in its first episode ({type(error).__name__}: {error}); mend it, or {_INSTEAD}"
        ) from error
    finally:
        env.close()
    scenery = recorded_env(str(env_facts(made_by).get("entry_point")), bare).scenery(bare)
    changed = [field for field, values in compiled.items() if not np.array_equal(values, after_reset[field])]
    placed = [path.rpartition("/")[2] for path in scenery] or changed
    fields = ("qpos", *placed, *DATA_FIELDS[1:])
    state = tuple(part for part, values in running_state(bare, list(dict.fromkeys(fields))).items() if values.size)
    fps = env.metadata.get("render_fps")
    return RunEnvironment(
        made_by,
        steps,
        key,
        state if has_model else (),
        float(fps) if isinstance(fps, int | float) and 0 < fps <= 1000 else _STEPS_PER_SECOND,
        paths,
        artifacts.hash_json([versions(), model_hash, source_sha256(made_by) if is_maker(made_by) else None]),
    )


def _model_fields(env: Any) -> dict[str, NDArray[np.float64]]:
    return running_state(env, MODEL_FIELDS)


def _success_key(env: gymnasium.Env[Any, Any], name: str, n_steps: int, given: str | None) -> str | None:
    """Return the key of success in ``info``, which some tell at the end alone: look through an episode at random."""
    wanted, keys = (given,) if given is not None else SUCCESS_KEYS, dict[str, None]()
    for _ in range(n_steps):
        *_, terminated, truncated, info = env.step(env.action_space.sample())
        told = by_path(info)
        keys |= dict.fromkeys(told)
        found = next((key for key in wanted if told.get(key) is not None), None)
        if found is not None:
            return found
        if terminated or truncated:
            break
    if given is not None:
        raise BadInput(
            f"--success-key: in an episode of {name} at random, info has no {given!r}; {nearest(given, keys)}"
        )
    warnings.warn(
        f"info of {name} tells no success (it has {', '.join(keys) or 'nothing'}); name it with --success-key",
        Notice,
        stacklevel=2,
    )
    return None


def _check_spaces(
    name: str, first: Any, paths: Sequence[str], actions: gymnasium.spaces.Box, meta: Mapping[str, Any]
) -> None:
    """Refuse an environment that does not observe and act as in training."""
    arrays = observed([first])
    widths = {path: arrays[path].size for path in paths}
    counted = {"observations": (sum(widths.values()), "obs_dim"), "actions": (int(np.prod(actions.shape)), "act_dim")}
    for what, (n_now, key) in counted.items():
        if n_now != meta[key]:
            parts = ", ".join(f"{path} {width}" for path, width in widths.items() if path and what == "observations")
            raise BadInput(
                f"{what} of {name} are not those of the training: the policy has {meta[key]} numbers, the environment "
                f"{n_now}{f' ({parts})' if parts else ''}; install the version that the dataset was recorded with, or "
                "give --env package.module:make, a function that makes the environment as it was, wrappers included"
            )


@dataclass(frozen=True)
class _Arguments:
    """Of `KitchenEnv`."""

    task: str = "micro"
    init_noise: float = 0.05


def kitchen_spec(text: str) -> EnvSpec:
    """Read the EnvSpec of a run, which may come from somebody else: task, noise and horizon are all it may choose.

    Raises:
        BadInput: it chooses anything else, or a horizon out of range.
    """
    check_env_spec(text, "the environment of the run", "evaluate a run on a dataset of the kitchen")
    spec = _parsed(text)
    horizon = spec.max_episode_steps
    if type(horizon) is not int or not 1 <= horizon <= MAX_HORIZON:
        raise BadInput(
            f"evaluation needs {ENV_ID} with a horizon of 1 to {MAX_HORIZON} steps, got {spec.id} with "
            f"max_episode_steps {horizon}; train on a dataset of `zest collect`"
        )
    check_registered(spec)
    try:
        arguments = from_json(_Arguments, spec.kwargs)
    except (TypeError, ValueError, OverflowError) as error:
        raise BadInput(
            f"the environment of the run takes a task and an init_noise, got {spec.kwargs!r:.200} ({error}); train on "
            "a dataset of `zest collect`"
        ) from error
    if spec.additional_wrappers:
        raise BadInput(
            f"the environment of the run is evaluated without wrappers, got {spec.additional_wrappers!r:.200}; train "
            "on a dataset that was recorded without"
        )
    return replace(env_spec(**asdict(arguments)), max_episode_steps=horizon)
