"""One episode that reaches several goals, one after another → its similarity to each of them over time.

Cui et al. 2022, appendix "multi-step tasks": each sub-goal has its own start and goal picture, and the change since
the first frame of the *whole* episode is compared with each. Episodes are real videos, or experts that do several
kitchen tasks in turn (`zest_rl.kitchen.task_sequence`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zest_rl.analysis.clips import Clip, embed_clips
from zest_rl.analysis.episode_view import N_FRAMES, KitchenView
from zest_rl.analysis.reward_figures import FLAT
from zest_rl.data.images import read_image
from zest_rl.data.video import evenly_spaced, read_frames
from zest_rl.embedders import DEFAULT_EMBEDDER, Precision, load_embedder
from zest_rl.errors import BadInput
from zest_rl.kitchen.task_sequence import perform
from zest_rl.kitchen.views import Views
from zest_rl.rewards.goals import SAME_SCENE, TEXT, GoalSpec, embed_goal, read_folder, read_text
from zest_rl.rewards.scorer import ScorerConfig
from zest_rl.rewards.scores import Features, Similarity, score_views
from zest_rl.rewards.state_scorer import StateScorer
from zest_rl.runtime.files import user_path
from zest_rl.types import FloatArray, Frame

SMOOTH, MIN_FRAMES = 0.5, 10
"""Correlation of a score and the next one above which a curve is no noise; of fewer frames, that cannot be told."""


@dataclass(frozen=True)
class SubGoalScores:
    """The similarity of one episode to one of its sub-goals."""

    name: str
    scores: FloatArray
    """(T+1,) float32, one per frame."""
    frames: tuple[Frame, ...]
    """n frames (H, W, 3), those at `steps`."""
    steps: NDArray[np.intp]
    """(n,) evenly spaced over the episode."""
    done_at: int | None = None
    """Step at which the sub-goal is reached by ground truth; None for real video."""

    @property
    def highest_at(self) -> int:
        """Step of the highest score."""
        return int(np.argmax(self.scores))

    @property
    def has_signal(self) -> bool:
        """Whether the scores after the first are more than one value or noise.

        Of noise, a score tells nothing of the next one.
        """
        centred = self.scores[1:].astype(np.float64)
        centred -= centred.mean()
        if np.abs(centred).max() <= FLAT * np.abs(self.scores).max():
            return False
        correlation = (centred[1:] * centred[:-1]).sum() / (centred**2).sum()
        return len(centred) < MIN_FRAMES or bool(correlation > SMOOTH)

    @property
    def rises_at(self) -> int | None:
        """First step at which the score is half-way from its first to its highest value.

        None if it never rises, or there is no signal.
        """
        half = (self.scores[0] + self.scores.max()) / 2
        return int(np.argmax(self.scores >= half)) if self.has_signal and self.highest_at > 0 else None

    @property
    def rises(self) -> str:
        """When it rises, in words."""
        if not self.has_signal:
            return "no signal"
        return "never rises" if self.rises_at is None else f"rises at step {self.rises_at}"

    def as_json(self) -> dict[str, Any]:
        """Return whether it has a signal, the steps of rise, maximum and success, and the scores to four decimals."""
        scores = [round(float(score), 4) for score in self.scores]
        steps = {"rises_at": self.rises_at, "highest_at": self.highest_at, "done_at": self.done_at}
        return {"signal": self.has_signal, **steps, "scores": scores}


def rise_in_order(sub_goals: Sequence[SubGoalScores]) -> bool:
    """Whether all scores rise, one after another in the order of the sub-goals."""
    rises = [sub_goal.rises_at for sub_goal in sub_goals]
    known = [step for step in rises if step is not None]
    return len(known) == len(rises) and all(earlier < later for earlier, later in pairwise(known))


def follow_kitchen(
    tasks: Sequence[str],
    *,
    goal: str = SAME_SCENE,
    embedder: str = DEFAULT_EMBEDDER,
    features: Features = "delta",
    similarity: Similarity = "cos",
    precision: Precision = "auto",
    device: str = "auto",
    views: int = Views.n_views,
    tolerance: float = Views.tolerance,
    seed: int = 0,
    n_workers: int | None = None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[SubGoalScores]:
    """Let experts do kitchen tasks in turn, and score all states by each task's goal, seen from that task's views.

    Args:
        tasks: in the order in which they are done.
        goal: goal spec, for every task.
        embedder: URI of the network.
        features: see `zest_rl.rewards.scores`.
        similarity: see `zest_rl.rewards.scores`.
        precision: of the embedder.
        device: where the embedder runs.
        views: cameras around the object of each task.
        tolerance: rad or m; states that differ by less are embedded once.
        seed: of the arm's start.
        n_workers: processes that embed, default one per core.
        on_progress: called with (tasks scored, tasks in all).

    Raises:
        BadInput: a task or the goal does not exist.
        ZestError: an expert did not succeed.
    """
    performance = perform(tasks, seed)
    config = ScorerConfig(goal, embedder, features, similarity, precision)
    sub_goals = []
    for task, done_at in performance.done_at.items():
        cameras = Views(task, views, tolerance=tolerance)
        scorer = StateScorer.build(config, cameras, performance.states[0], device=device, n_workers=n_workers)
        view = KitchenView(scorer, performance.states)
        sub_goals.append(SubGoalScores(task, view.scores, tuple(view.frames), view.steps, done_at))
        on_progress(len(sub_goals), len(tasks))
    return sub_goals


def read_sub_goal(spec: str, first: Frame) -> GoalSpec:
    """Read the spec of one sub-goal of a video.

    Args:
        spec: a picture of the goal alone, a folder with ``init/`` and ``goal/``, or ``text:START -> GOAL``.
        first: (H, W, 3) first frame of the video, which is the start if `spec` is a picture.

    Raises:
        BadInput: `spec` is none of the three, or cannot be read.
    """
    path = user_path(spec)
    if spec.startswith(TEXT):
        return read_text(spec)
    if path.is_file():
        return GoalSpec(spec, (first,), (read_image(path),))
    if path.is_dir():
        return read_folder(path, spec)
    raise BadInput(
        f"unknown sub-goal {spec!r}: it is neither a picture, a folder with init/ and goal/, nor 'text:START -> GOAL'"
    )


def follow_video(
    clip: Path,
    goals: Sequence[str],
    *,
    embedder: str = DEFAULT_EMBEDDER,
    features: Features = "delta",
    similarity: Similarity = "cos",
    precision: Precision = "auto",
    device: str = "auto",
    n_frames: int = 100,
) -> list[SubGoalScores]:
    """Score the frames of a video by each sub-goal.

    Args:
        clip: a video, or a folder of pictures in the order of their names.
        goals: specs of `read_sub_goal`, all different.
        embedder: URI of the network.
        features: see `zest_rl.rewards.scores`.
        similarity: see `zest_rl.rewards.scores`.
        precision: of the embedder.
        device: where the embedder runs.
        n_frames: frames to score, evenly spaced.

    Raises:
        BadInput: there is no sub-goal or a duplicate, the video or a sub-goal cannot be read, or a goal is a sentence
            and the embedder takes pictures only.
    """
    network = load_embedder(embedder, device=device, precision=precision, one_thread=True)
    if not goals or len(set(goals)) < len(goals):
        raise BadInput(f"a video needs 1 or more sub-goals, each once, got {', '.join(goals) or 'none'}")
    frames = read_frames(clip, n_frames)
    specs = [read_sub_goal(goal, frames[0]) for goal in goals]
    pairs = [embed_goal(spec, network) for spec in specs]
    (embeddings,) = embed_clips([Clip(clip, "")], network, n_frames)
    steps = evenly_spaced(len(frames), N_FRAMES)
    strip = tuple(frames[step] for step in steps)
    stems = [goal if goal.startswith(TEXT) else Path(goal).stem for goal in goals]
    names = stems if len(set(stems)) == len(stems) else goals
    return [
        SubGoalScores(name, score_views(embeddings[:, None], starts, ends, features, similarity), strip, steps)
        for name, (starts, ends) in zip(names, pairs, strict=True)
    ]
