"""One episode that reaches several goals, one after another → its similarity to each of them over time.

Cui et al. 2022, appendix "multi-step tasks": every sub-goal has a start and a goal picture of its own, and the change
since the first frame of the *whole* episode is compared with each. Episodes are real video, or experts that do several
kitchen tasks without a reset in between.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from zest_rl.analysis.clip_selection import Clip, embed_clips
from zest_rl.analysis.episode_view import N_FRAMES, Look
from zest_rl.data.images import read_image
from zest_rl.data.video import evenly_spaced, read_frames
from zest_rl.embedders import Embedder
from zest_rl.errors import BadInput, ZestError
from zest_rl.kitchen.collect import env_spec
from zest_rl.kitchen.env import HORIZON, KitchenEnv
from zest_rl.kitchen.experts import make_expert
from zest_rl.report import Curve, Report, Strip
from zest_rl.rewards.goals import TEXT, GoalSpec, embed_goal, read_folder, read_text
from zest_rl.rewards.scorer import Scorer
from zest_rl.rewards.scores import Features, Similarity, score_views
from zest_rl.types import FloatArray, Frame


@dataclass(frozen=True)
class Performance:
    """Several tasks, done one after another."""

    states: NDArray[np.float64]
    """(T+1, nq) simulator positions."""
    done_at: dict[str, int]
    """Task → step at which the ground truth has it reached."""


def perform(tasks: Sequence[str], seed: int) -> Performance:
    """Let the experts do `tasks` in this order; each starts where the one before it succeeded.

    Args:
        tasks: names in ``zest_rl.kitchen.tasks.TASKS``, at least 2, all different.
        seed: of the arm's start.

    Raises:
        BadInput: too few tasks, one twice, or one that does not exist.
        ZestError: an expert did not succeed within `HORIZON` steps from where it had to start.
    """
    if len(tasks) < 2 or len(set(tasks)) < len(tasks):
        raise BadInput(f"an episode of several steps needs 2 or more different tasks, got {', '.join(tasks) or 'none'}")
    states: list[NDArray[np.float64]] = []
    done_at: dict[str, int] = {}
    before: mujoco.MjData | None = None
    for task in tasks:
        env = gymnasium.make(env_spec(task))
        env.reset(seed=seed)
        kitchen = env.unwrapped
        assert isinstance(kitchen, KitchenEnv)
        if before is None:
            states.append(kitchen.data.qpos.copy())
        else:
            kitchen.data.qpos[:], kitchen.data.qvel[:] = before.qpos, before.qvel
            mujoco.mj_forward(kitchen.model, kitchen.data)
        expert = make_expert(task, env)
        for _ in range(HORIZON):
            info = env.step(expert.act())[-1]
            states.append(kitchen.data.qpos.copy())
            if info["gt"]["success"]:
                break
        else:
            raise ZestError(
                f"the expert of {task!r} did not succeed within {HORIZON} steps after "
                f"{', '.join(done_at) or 'the start'}; try another order or another --seed"
            )
        done_at[task] = len(states) - 1
        before = kitchen.data
        env.close()
    return Performance(np.stack(states), done_at)


@dataclass(frozen=True)
class Followed:
    """The similarity of one episode to one of its sub-goals."""

    name: str
    scores: FloatArray
    """(T+1,) float32, of each frame."""
    frames: tuple[Frame, ...]
    """What the score sees at `steps`."""
    steps: NDArray[np.intp]
    """(n,) evenly spaced over the episode."""
    done_at: int | None = None
    """Step at which the ground truth has the sub-goal reached; None for real video."""

    @property
    def highest_at(self) -> int:
        """Step of the highest score."""
        return int(np.argmax(self.scores))

    @property
    def rises_at(self) -> int | None:
        """First step at which the score is half-way from its first to its highest value; None when it never rises."""
        half = (self.scores[0] + self.scores.max()) / 2
        return int(np.argmax(self.scores >= half)) if self.highest_at > 0 else None


def rise_in_order(followed: Sequence[Followed]) -> bool:
    """Whether all scores rise, one after another in the order of the sub-goals."""
    rises = [one.rises_at for one in followed]
    known = [step for step in rises if step is not None]
    return len(known) == len(rises) and all(earlier < later for earlier, later in pairwise(known))


def follow_performance(
    performance: Performance,
    build_scorer: Callable[[str], Scorer],
    on_done: Callable[[], object] = lambda: None,
) -> list[Followed]:
    """Score all states by the goal of each task, seen from that task's views.

    Args:
        performance: what was done.
        build_scorer: task → its scorer.
        on_done: called after each task.
    """
    followed = []
    for task, done_at in performance.done_at.items():
        look = Look(build_scorer(task), performance.states)
        followed.append(Followed(task, look.scores, tuple(look.frames), look.steps, done_at))
        on_done()
    return followed


def read_subgoal(spec: str, first: Frame) -> GoalSpec:
    """Read what specifies one sub-goal of a video.

    Args:
        spec: a picture of the goal alone, a folder with ``init/`` and ``goal/``, or ``text:START -> GOAL``.
        first: (H, W, 3) first frame of the video, the start that goes with a picture alone.

    Raises:
        BadInput: none of the three, or it cannot be read.
    """
    path = Path(spec).expanduser()
    if spec.startswith(TEXT):
        return read_text(spec)
    if path.is_file():
        return GoalSpec(spec, (first,), (read_image(path),))
    if path.is_dir():
        return read_folder(path, spec)
    raise BadInput(
        f"unknown sub-goal {spec!r}: it is neither a picture, a folder with init/ and goal/, nor 'text:START -> GOAL'"
    )


def follow_clip(
    path: Path, specs: Sequence[str], embedder: Embedder, n_frames: int, features: Features, similarity: Similarity
) -> list[Followed]:
    """Score the frames of a video by each sub-goal.

    Args:
        path: a video, or a folder of pictures in the order of their names.
        specs: of `read_subgoal`, all different.
        embedder: the network.
        n_frames: how many frames are looked at, evenly spaced.
        features: see `zest_rl.rewards.scores`.
        similarity: see `zest_rl.rewards.scores`.

    Raises:
        BadInput: there is no sub-goal or one twice, the video or a sub-goal cannot be read, or a sentence meets an
            embedder of pictures.
    """
    if not specs or len(set(specs)) < len(specs):
        raise BadInput(f"a video needs 1 or more sub-goals, each once, got {', '.join(specs) or 'none'}")
    frames = read_frames(path, n_frames)
    goals = [read_subgoal(spec, frames[0]) for spec in specs]
    pairs = [embed_goal(goal, embedder) for goal in goals]
    (embeddings,) = embed_clips([Clip(path, "")], embedder, n_frames)
    steps = evenly_spaced(len(frames), N_FRAMES)
    shown = tuple(frames[step] for step in steps)
    stems = [spec if spec.startswith(TEXT) else Path(spec).stem for spec in specs]
    names = stems if len(set(stems)) == len(stems) else specs
    return [
        Followed(name, score_views(embeddings[:, None], starts, ends, features, similarity), shown, steps)
        for name, (starts, ends) in zip(names, pairs, strict=True)
    ]


def follow_report(title: str, followed: Sequence[Followed], details: dict[str, object]) -> Report:
    """Build the page: all curves in one chart, and a strip of frames per sub-goal."""
    steps = np.arange(len(followed[0].scores), dtype=np.float32)
    order = "rise one after another, in the order of" if rise_in_order(followed) else "do not rise in the order of"
    return Report(
        title=title,
        summary_sentence=f"The scores {order} the sub-goals: "
        + ", ".join(
            f"{one.name} {'never' if one.rises_at is None else f'at step {one.rises_at}'}"
            + ("" if one.done_at is None else f" (done at {one.done_at})")
            for one in followed
        )
        + ".",
        strips=tuple(
            Strip(
                one.name,
                one.frames,
                tuple(map(int, one.steps)),
                (one.scores[one.steps] - one.scores.min()) / (np.ptp(one.scores) or 1.0),
            )
            for one in followed
        ),
        sub_goals=tuple(Curve(one.name, "similarity to the sub-goal", steps, one.scores) for one in followed),
        details=details,
    )
