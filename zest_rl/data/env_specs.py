"""Whether the environment that a file names may be made: a Gymnasium EnvSpec (JSON) names code to run.

A spec from elsewhere is made only if `check_env_spec` and `check_registered` both let it pass: its code is of a known
package, and it is what that package registers under this id.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from zest_rl.errors import BadInput

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec

TRUSTED_ENTRY_POINTS = ("gymnasium.", "gymnasium_robotics.", "zest_rl.")


def entry_points(env_spec: str, what: str) -> list[str]:
    """Return the code that an EnvSpec (JSON) would run: of its environment, and of wrappers.

    Raises:
        BadInput: not an EnvSpec; `what` names it in the message.
    """
    try:
        spec = json.loads(env_spec)
        return [str(part["entry_point"]) for part in (spec, *spec.get("additional_wrappers", ()))]
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise BadInput(f"{what} is not the JSON of a Gymnasium EnvSpec: {error!r}") from error


def check_env_spec(env_spec: str, what: str, instead: str) -> None:
    """Refuse an EnvSpec (JSON) that would run code of an unknown package: of its environment or a wrapper.

    Raises:
        BadInput: such an entry point, or not an EnvSpec; `what` names it in the message, `instead` ends it.
    """
    for entry_point in entry_points(env_spec, what):
        if not entry_point.startswith(TRUSTED_ENTRY_POINTS):
            raise BadInput(
                f"{what} would run code of {entry_point!r}; only {', '.join(p + '*' for p in TRUSTED_ENTRY_POINTS)} "
                f"are trusted; {instead}"
            )


def check_registered(spec: EnvSpec) -> None:
    """Refuse a spec from elsewhere whose entry point is not the registered one: it could call any function.

    Raises:
        BadInput: such an entry point, or an id that is not registered here.
    """
    import gymnasium

    known = gymnasium.registry.get(spec.id)
    if known is None or spec.entry_point != known.entry_point:
        raise BadInput(
            f"{spec.id} would run code of {spec.entry_point!r}, but "
            + ("is not registered here" if known is None else f"is registered as {known.entry_point!r}")
            + "; install the version of its package that it was recorded with"
        )
