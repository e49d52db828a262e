"""Checks of a Gymnasium EnvSpec (JSON) that a file holds: building its environment runs the code that it names.

It is built only if it passes both `check_env_spec` (its code belongs to a trusted package) and `check_registered` (that
package registers the same code under this id).
"""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from zest_rl.errors import BadInput, Notice
from zest_rl.runtime.files import check_file, user_path

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec

WRAPPERS = frozenset(
    f"gymnasium.wrappers.{name}"
    for name in (
        "common:RecordEpisodeStatistics",
        "stateful_action:RepeatAction",
        "stateful_action:StickyAction",
        "stateful_observation:DelayObservation",
        "stateful_observation:FrameStackObservation",
        "stateful_observation:TimeAwareObservation",
        "transform_action:ClipAction",
        "transform_action:RescaleAction",
        "transform_observation:DtypeObservation",
        "transform_observation:FilterObservation",
        "transform_observation:FlattenObservation",
        "transform_observation:RescaleObservation",
        "transform_observation:ReshapeObservation",
        "transform_reward:ClipReward",
    )
)
"""What may be made round an environment because a file says so: they read and write no files."""
TRUSTED_ENTRY_POINTS = ("gymnasium.", "gymnasium_robotics.", "zest_rl.")


def is_maker(env: str) -> bool:
    """Whether it is ``package.module:make``, a function that makes an environment; only the user may name one."""
    return re.fullmatch(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*", env) is not None


def entry_points(env_spec: str, what: str) -> list[str]:
    """Return the entry points that an EnvSpec (JSON) would run: the environment's, and those of its wrappers.

    Raises:
        BadInput: not an EnvSpec; `what` names it in the message.
    """
    try:
        spec = json.loads(env_spec)
        return [str(part["entry_point"]) for part in (spec, *(spec.get("additional_wrappers") or ()))]
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise BadInput(f"{what} is not the JSON of a Gymnasium EnvSpec: {error!r}") from error


def check_env_spec(env_spec: str, what: str, instead: str) -> None:
    """Refuse an EnvSpec (JSON) whose environment or wrappers would run code of a package that is not trusted.

    Raises:
        BadInput: such an entry point, or not an EnvSpec; `what` names it in the message, `instead` ends it.
    """
    for entry_point in entry_points(env_spec, what):
        if not entry_point.startswith(TRUSTED_ENTRY_POINTS):
            raise BadInput(
                f"{what} would run code of {entry_point!r}; only {', '.join(p + '*' for p in TRUSTED_ENTRY_POINTS)} "
                f"are trusted; {instead}"
            )


def check_registered(
    spec: EnvSpec, instead: str = "install the version of its package that it was recorded with"
) -> None:
    """Refuse a spec whose entry point is not the registered one: it could call any function.

    Raises:
        BadInput: such an entry point, or an id that is not registered here.
    """
    import gymnasium

    registered = gymnasium.registry.get(spec.id)
    if registered is None:
        name = spec.id.rpartition("-v")[0]
        versions = sorted(other for other in gymnasium.registry if other.rpartition("-v")[0] == name)
        raise BadInput(
            f"{spec.id} is not registered by the packages that are installed here"
            + (f", which have {', '.join(versions)}" if versions else "")
            + f"; {instead}"
        )
    if spec.entry_point != registered.entry_point:
        raise BadInput(
            f"{spec.id} would run code of {spec.entry_point!r}, but is registered as {registered.entry_point!r}; "
            f"{instead}"
        )


def check_model_files(spec: Mapping[str, Any]) -> None:
    """Refuse files outside its package that an environment would load and that are none; a `Notice` names the others.

    Raises:
        BadInput: a device, a pipe, an empty or a missing file.
    """
    kwargs = spec.get("kwargs")
    for value in kwargs.values() if isinstance(kwargs, dict) else ():
        if isinstance(value, str) and (value.startswith(("/", ".", "~")) or ".." in Path(value).parts):
            check_file(user_path(value))
            warnings.warn(f"{spec.get('id')} is made from {value}, which the dataset names", Notice, stacklevel=2)


def without_wrappers(env_spec: str) -> str:
    """Return an EnvSpec (JSON) without its wrappers, which change nothing that is rendered, and would run code."""
    return json.dumps({**json.loads(env_spec), "additional_wrappers": []})
