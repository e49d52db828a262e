"""Clips of real video → candidates of goal and action selection, scored by the first and last frame of other clips.

A clip shows one object that is acted on from its start to its end: its first frame is a start, its last one a goal, and
its last `GOAL_SHARE` of frames count as reaching the goal of the same object, and as showing the action that all clips
share. That reading is ours; Cui et al. 2022 (§5.2) do not say which frames do.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from zest_rl.analysis.clips import OPENING, Clip, embed_clips, find_clips
from zest_rl.embedders import DEFAULT_EMBEDDER, Precision, load_embedder
from zest_rl.errors import BadInput
from zest_rl.metrics import selection
from zest_rl.metrics.statistics import Estimate, Values, bootstrap
from zest_rl.rewards.scores import Features, Similarity, score_views
from zest_rl.types import FloatArray

GOAL_SHARE = 0.2
"""Of a clip's frames, the last ones."""


@dataclass(frozen=True)
class ClipFrames:
    """Frames of clips, as candidates of a selection."""

    embeddings: FloatArray
    """(M, D)."""
    starts: FloatArray
    """(M, D) x_0 of each."""
    clip: NDArray[np.intp]
    """(M,) which clip each is of."""
    satisfies: NDArray[np.bool_]
    """(M,) which reach the goal."""

    def scores(self, start: FloatArray, goal: FloatArray, features: Features, similarity: Similarity) -> Values:
        """Score by one start and one goal, (1, D) each: (M,) float64."""
        scores = np.empty(len(self.embeddings))
        for clip in np.unique(self.clip):  # frames of one clip share x_0
            members = np.flatnonzero(self.clip == clip)
            frames = np.concatenate([self.starts[members[:1]], self.embeddings[members]])[:, None]
            scores[members] = score_views(frames, start, goal, features, similarity)[1:]
        return scores


def enough(clips: Sequence[Clip], least: int) -> list[str]:
    """Return the objects that have at least so many clips."""
    things = dict.fromkeys(clip.thing for clip in clips)
    return [thing for thing in things if sum(clip.thing == thing for clip in clips) >= least]


def candidates(
    clips: Sequence[Clip],
    embeddings: Sequence[FloatArray],
    thing: str,
    *,
    diverse: bool = False,
    any_thing: bool = False,
    same_context: bool = True,
    left_out: int | None = None,
    seed: int = 0,
) -> ClipFrames:
    """Take the frames of clips, but for the clip that specifies the goal.

    Args:
        clips: all of them; at least 2 are to remain.
        embeddings: (n, D) of each.
        thing: the goal's object.
        diverse: candidates of all objects, not of the goal's alone.
        any_thing: the end of a clip of any object reaches the goal, as its action does, not of the goal's alone.
        same_context: x_0 of a candidate's own clip, else of another candidate clip drawn with `seed`.
        left_out: the clip that specifies the goal, when it is one of these.
        seed: of that draw.
    """
    pool = [i for i, clip in enumerate(clips) if i != left_out and (diverse or clip.thing == thing)]
    contexts = np.arange(len(pool)) if same_context else selection.draw_others(len(pool), seed)
    lengths = [len(embeddings[i]) for i in pool]
    reached = [
        (np.arange(n) >= n - max(1, round(GOAL_SHARE * n))) & (any_thing or clips[i].thing == thing)
        for i, n in zip(pool, lengths, strict=True)
    ]
    starts = [embeddings[pool[context]][:1] for context in contexts]
    return ClipFrames(
        np.concatenate([embeddings[i][1:] for i in pool]),
        np.concatenate([np.repeat(start, n - 1, axis=0) for start, n in zip(starts, lengths, strict=True)]),
        np.repeat(pool, np.array(lengths) - 1),
        np.concatenate([frames[1:] for frames in reached]),
    )


@dataclass(frozen=True)
class ObjectSelection:
    """How well goals of one object are found; means over the clips that specified the goal in turn."""

    top_n_success: Estimate
    relative_variation: Estimate
    goal_frame_ratio: float
    """Share of the candidates that are right: what picking at random finds."""
    top: int
    """N of the Top-N success rate, where fewer candidates are right than were asked for."""
    n_goals: int
    n_clips: int
    """Of this object."""

    def as_json(self) -> dict[str, Any]:
        """Return the figures by their names."""
        estimates = {name: getattr(self, name).as_json() for name in ("top_n_success", "relative_variation")}
        return {**vars(self), **estimates}


@dataclass(frozen=True)
class ClipSelection:
    """What goals and actions are found in real video."""

    objects: Mapping[str, ObjectSelection]
    left_out: tuple[str, ...]
    """Objects that have too few clips."""
    n_clips: int
    embedder_sha256: str

    def mean(self) -> dict[str, float]:
        """Return the means over objects, and how many times better than random the highest scores are."""
        success = float(np.mean([judged.top_n_success.value for judged in self.objects.values()]))
        chance = float(np.mean([judged.goal_frame_ratio for judged in self.objects.values()]))
        return {"top_n_success": success, "goal_frame_ratio": chance, "times_random": success / chance}


def select_clips(
    folder: Path,
    *,
    goals: Path | None = None,
    ask: Literal["goals", "actions"] = "goals",
    template: str = OPENING,
    pool: Literal["single", "all"] = "single",
    context: Literal["same", "different"] = "same",
    embedder: str = DEFAULT_EMBEDDER,
    features: Features = "delta",
    similarity: Similarity = "cos",
    top: int = selection.TOP_N,
    n_frames: int = 24,
    n_repeats: int = 10,
    max_clips: int | None = None,
    precision: Precision = "auto",
    device: str = "auto",
    on_progress: Callable[[int, int], None] | None = None,
) -> ClipSelection:
    """Let clip after clip specify the goal by its first and last frame: do the highest scores find the end of a clip?

    Args:
        folder: clips, as for `find_clips`.
        goals: folder of other clips, which specify the goals; default those of `folder` in turn.
        ask: goals: is the clip of the goal's object? actions: of any, as all do the same; takes the pool of all.
        template: with Something-Something V2: the action.
        pool: candidates of the goal's object alone, or of all objects.
        context: x_0 of a candidate: of its own clip, or of another one.
        embedder: URI of the network.
        features: how frames and goals are compared.
        similarity: how frames and goals are compared.
        top: N of the Top-N success rate; fewer where fewer candidates are right.
        n_frames: of each clip, evenly spaced.
        n_repeats: clips per object that specify the goal in turn.
        max_clips: per object, default all.
        precision: of the embedder.
        device: of the embedder.
        on_progress: called with (clips embedded, clips in all).

    Raises:
        BadInput: there are no clips, or no object has enough of them.
    """
    goal_folder = goals or folder
    within = goal_folder.resolve() == folder.resolve()
    clips = find_clips(folder, template)
    goal_clips = clips if within else find_clips(goal_folder, template)
    specified = {clip.thing for clip in goal_clips}
    things = [thing for thing in enough(clips, 3 if within else 2) if thing in specified]
    if not things:
        raise BadInput(f"no object has 2 clips in {folder} to choose from and 1 other in {goal_folder} for the goal")
    left_out = dict.fromkeys(clip.thing for clip in (*clips, *goal_clips) if clip.thing not in things)
    clips = _first_of_each(clips, things, max_clips)
    goal_clips = clips if within else _first_of_each(goal_clips, things, max_clips)
    network = load_embedder(embedder, device=device, precision=precision)
    distinct = clips if within else [*clips, *goal_clips]
    numbers = itertools.count(1)

    def on_done() -> None:
        if on_progress is not None:
            on_progress(next(numbers), len(distinct))

    vectors = embed_clips(distinct, network, n_frames, on_done)
    embeddings, goal_embeddings = vectors[: len(clips)], vectors[-len(goal_clips) :]
    objects = {}
    for thing in things:
        goal_indices = [i for i, clip in enumerate(goal_clips) if clip.thing == thing]
        tops, variations, ratios, picked = [], [], [], []
        for repeat, goal in enumerate(np.random.default_rng(0).permutation(goal_indices)[:n_repeats].tolist()):
            frames = candidates(
                clips,
                embeddings,
                thing,
                diverse=pool == "all",
                any_thing=ask == "actions",
                same_context=context == "same",
                left_out=goal if within else None,
                seed=repeat,
            )
            start_and_goal = goal_embeddings[goal][:1], goal_embeddings[goal][-1:]
            scores = frames.scores(*start_and_goal, features, similarity)
            tops.append(selection.top_up_to(scores, frames.satisfies, top))
            variations.append(selection.relative_variation(scores, frames.satisfies))
            ratios.append(selection.goal_frame_ratio(frames.satisfies))
            picked.append(min(top, int(frames.satisfies.sum())))
        objects[thing] = ObjectSelection(
            bootstrap([np.array(tops)]),
            bootstrap([np.array(variations)]),
            float(np.mean(ratios)),
            min(picked),
            len(tops),
            sum(clip.thing == thing for clip in clips),
        )
    return ClipSelection(objects, tuple(left_out), len(clips), network.fingerprint)


def _first_of_each(clips: Sequence[Clip], things: Sequence[str], most: int | None) -> list[Clip]:
    """Return the first clips of each object."""
    return [clip for thing in things for clip in [c for c in clips if c.thing == thing][:most]]
