"""One episode that reaches several goals, one after another → its similarity to each of them over time.

Cui et al. 2022, appendix "multi-step tasks": every sub-goal has a start and a goal picture of its own, and the change
since the first frame of the *whole* episode is compared with each. Episodes are real video, or experts that do several
kitchen tasks (`zest_rl.kitchen.task_sequence`).
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
from zest_rl.analysis.episode_view import N_FRAMES, EpisodeView
from zest_rl.data.images import read_image
from zest_rl.data.video import evenly_spaced, read_frames
from zest_rl.embedders import Embedder
from zest_rl.errors import BadInput
from zest_rl.kitchen.task_sequence import Performance
from zest_rl.rewards.goals import TEXT, GoalSpec, embed_goal, read_folder, read_text
from zest_rl.rewards.scores import Features, Similarity, score_views
from zest_rl.rewards.state_scorer import StateScorer
from zest_rl.types import FloatArray, Frame


@dataclass(frozen=True)
class SubGoalScores:
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

    def as_json(self) -> dict[str, Any]:
        """Return when it rises, is highest and is reached, and the scores to four decimals."""
        scores = [round(float(score), 4) for score in self.scores]
        return {
            "rises_at": self.rises_at, "highest_at": self.highest_at, "done_at": self.done_at, "scores": scores,
        }  # fmt: skip


def rise_in_order(sub_goals: Sequence[SubGoalScores]) -> bool:
    """Whether all scores rise, one after another in the order of the sub-goals."""
    rises = [sub_goal.rises_at for sub_goal in sub_goals]
    known = [step for step in rises if step is not None]
    return len(known) == len(rises) and all(earlier < later for earlier, later in pairwise(known))


def score_performance(
    performance: Performance,
    build_scorer: Callable[[str], StateScorer],
    on_done: Callable[[], object] = lambda: None,
) -> list[SubGoalScores]:
    """Score all states by the goal of each task, seen from that task's views.

    Args:
        performance: what was done.
        build_scorer: task → its scorer.
        on_done: called after each task.
    """
    sub_goals = []
    for task, done_at in performance.done_at.items():
        view = EpisodeView(build_scorer(task), performance.states)
        sub_goals.append(SubGoalScores(task, view.scores, tuple(view.frames), view.steps, done_at))
        on_done()
    return sub_goals


def read_sub_goal(spec: str, first: Frame) -> GoalSpec:
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


def score_video(
    path: Path, specs: Sequence[str], embedder: Embedder, n_frames: int, features: Features, similarity: Similarity
) -> list[SubGoalScores]:
    """Score the frames of a video by each sub-goal.

    Args:
        path: a video, or a folder of pictures in the order of their names.
        specs: of `read_sub_goal`, all different.
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
    goals = [read_sub_goal(spec, frames[0]) for spec in specs]
    pairs = [embed_goal(goal, embedder) for goal in goals]
    (embeddings,) = embed_clips([Clip(path, "")], embedder, n_frames)
    steps = evenly_spaced(len(frames), N_FRAMES)
    shown = tuple(frames[step] for step in steps)
    stems = [spec if spec.startswith(TEXT) else Path(spec).stem for spec in specs]
    names = stems if len(set(stems)) == len(stems) else specs
    return [
        SubGoalScores(name, score_views(embeddings[:, None], starts, ends, features, similarity), shown, steps)
        for name, (starts, ends) in zip(names, pairs, strict=True)
    ]
