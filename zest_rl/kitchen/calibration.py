"""The level of an imperfect expert in percent of the perfect one, and calibration of a flaw to a given level.

Calibration changes one field of a `Behaviour` and measures the returns of the dataset's own episodes, never those of a
trained policy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from zest_rl.errors import BadInput, ZestError, nearest
from zest_rl.kitchen.behaviour import Behaviour, returns, run_behaviour
from zest_rl.kitchen.collect_config import LARGEST
from zest_rl.metrics import statistics

REFERENCE_STREAM = 2**31
"""First index of the episodes for reference returns; datasets stay below it."""
TOLERANCE = 0.5
"""Largest deviation of a calibrated dataset from its level, in percent of the expert."""
N_REFERENCE = 100
"""Episodes of the expert for its reference return."""
N_NOTHING = 10
"""Episodes of the robot doing nothing, whose returns hardly differ."""


@dataclass(frozen=True)
class References:
    """The two ends of the normalized return, and the expert's success rate."""

    minimum: float
    """Mean return of the robot doing nothing."""
    expert: float
    """Mean return of the expert without noise."""
    expert_success: float
    n_episodes: int


def measure_references(
    behaviour: Behaviour,
    n_episodes: int = N_REFERENCE,
    *,
    n_workers: int | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> References:
    """Measure expert and do-nothing returns on starts that no dataset uses.

    Raises:
        ZestError: the expert does no better than the robot doing nothing.
    """
    best = behaviour.without_flaws()
    runs = {
        name: run_behaviour(reference, n, first=REFERENCE_STREAM, n_workers=n_workers, on_progress=on_progress)
        for name, reference, n in (
            ("expert", best, n_episodes),
            ("nothing", replace(best, policy="nothing"), N_NOTHING),
        )
    }
    minimum, expert = (float(returns(runs[name]).mean()) for name in ("nothing", "expert"))
    if not expert > minimum:
        raise ZestError(f"the expert of task {behaviour.task!r} returns {expert:.3f}, no more than doing nothing")
    return References(minimum, expert, float(runs["expert"]["gt_success"].any(axis=1).mean()), n_episodes)


def calibrate(
    behaviour: Behaviour,
    flaw: str,
    n_episodes: int,
    references: References,
    target: float,
    *,
    tolerance: float = TOLERANCE,
    n_rounds: int = 12,
    n_workers: int | None = None,
    on_round: Callable[[float, float], None] | None = None,
) -> Behaviour:
    """Find the value of one field of a behaviour at which its episodes' mean normalized return meets `target`.

    The level falls as the value rises. The value doubles until the level is below the target; then it is interpolated
    linearly between the nearest levels on both sides, kept off the ends.

    Args:
        behaviour: its field `flaw` is ignored.
        flaw: a key of `LARGEST`.
        n_episodes: the dataset's size; the episodes are those of the dataset.
        references: the two ends of the scale.
        target: percent of the expert, e.g. 81.19.
        tolerance: stop within this many percent.
        n_rounds: largest number of values to try.
        n_workers: processes, default one per core.
        on_round: called with (value, percent) after each.

    Raises:
        BadInput: `target` is not in (0, 100], or `flaw` cannot be calibrated.
        ZestError: no value within `tolerance` was found.
    """
    if not 0 < target <= 100:
        raise BadInput(f"the level to calibrate to must be in (0, 100] percent of the expert, got {target}")
    if flaw not in LARGEST:
        raise BadInput(f"{flaw!r} cannot be calibrated; {nearest(flaw, LARGEST)}")
    below, above = (0.0, 100.0), None  # (value, level) next to the target
    only_flaw = behaviour.with_value(flaw, 0.0) == behaviour.without_flaws()
    value = 0.3 * LARGEST[flaw] if only_flaw else 0.0  # with no other flaw the level at 0 is the expert's
    for _ in range(n_rounds):
        tried = behaviour.with_value(flaw, round(value, 4))
        episodes = run_behaviour(tried, n_episodes, n_workers=n_workers)
        level = float(statistics.normalized_return(returns(episodes), references.minimum, references.expert).mean())
        if on_round is not None:
            on_round(getattr(tried, flaw), level)
        if abs(level - target) <= tolerance:
            return tried
        if value == (LARGEST[flaw] if level > target else 0.0):
            break  # no further to go
        if level > target:
            below = (value, level)
        else:
            above = (value, level)
        if above is None:
            value = min(2 * value or 0.3 * LARGEST[flaw], LARGEST[flaw])
        else:
            share = (below[1] - target) / (below[1] - above[1]) if below[1] > above[1] else 0.5
            value = below[0] + np.clip(share, 0.1, 0.9) * (above[0] - below[0])
    raise ZestError(
        f"no {flaw} in [0, {LARGEST[flaw]}] brings the dataset to {target} ± {tolerance} % of the expert (the last "
        f"try, {getattr(tried, flaw)}, gave {level:.2f} %); collect more episodes or choose it by hand"
    )
