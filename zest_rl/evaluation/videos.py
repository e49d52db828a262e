"""Evaluated episodes → videos for people, with the robot in view; no score uses them."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from zest_rl.errors import Notice, ZestError
from zest_rl.evaluation.environments import RunEnvironment
from zest_rl.evaluation.rollout import Traces
from zest_rl.kitchen.videos import KitchenOverview
from zest_rl.simulation.makers import check_named
from zest_rl.simulation.videos import Overview, Trajectory, Video
from zest_rl.sources.stage import Stage, stage_of
from zest_rl.sources.states import check_env
from zest_rl.types import Frame


@dataclass(frozen=True)
class EnvironmentOverview:
    """The `zest_rl.simulation.videos.Overview` of any MuJoCo environment: its own camera, where it is at the start."""

    made_by: str
    """See `RunEnvironment`."""
    fps: float

    def frames(self, states: Trajectory) -> Iterator[Frame]:
        """Draw the states of an episode, by their parts."""
        stage, n_states = stage_of(self.made_by, ()), len(states["qpos"])
        steps = [{name: part[step] for name, part in states.items()} for step in range(n_states)]
        pose = None if stage.is_fixed else stage.default_pose(steps[0])
        for step in steps:
            yield stage.render(step, pose)[0]


def episode_video(
    environment: RunEnvironment, traces: Traces, index: int, path: Path, beside: Traces | None = None
) -> Video | None:
    """Return the video of an episode, which need not be written yet.

    Args:
        environment: of the evaluation.
        traces: of the evaluation.
        index: of the episode.
        path: of the video.
        beside: traces of another evaluation, whose episode is shown on the right.

    Returns:
        None where the environment cannot be drawn; a `Notice` says why.
    """
    overview: Overview = KitchenOverview()
    if not environment.is_kitchen:
        if not _can_draw(environment.made_by, environment.name, bool(environment.state)):
            return None
        overview = EnvironmentOverview(environment.made_by, environment.fps)
    shown = [each for each in (traces, beside) if each is not None]
    n_steps = max((int(each["n_steps"][index]) for each in shown if "n_steps" in each), default=None)
    end = None if n_steps is None else n_steps + 1
    states = [{name: each[name][index, :end] for name in environment.state} for each in shown]
    return Video(states[0], path, overview, *states[1:])


@functools.cache
def _can_draw(made_by: str, name: str, has_state: bool) -> bool:
    try:
        if not has_state:
            raise ZestError("it has no MuJoCo model")
        check_named(made_by, "the evaluation")
        check_env(made_by, "the evaluation")
        _: Stage = stage_of(made_by, ())
    except ZestError as error:
        warnings.warn(f"no videos of {name} are drawn: {error}", Notice, stacklevel=3)
        return False
    return True
