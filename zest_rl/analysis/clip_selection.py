"""Clips of real video → goal and action selection among their frames, scored by first and last frames of other clips.

A clip shows an action on one object from start to end: its first frame is a start, its last frame a goal, and its last
`GOAL_SHARE` of frames count as reaching the goal of the same object, and as showing the action that all clips share.
That is our reading; Cui et al. 2022 (§5.2) do not say which frames count.
"""

from __future__ import annotations

from collections import Counter
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
"""Share of a clip's frames, the last ones, that reach the goal."""


@dataclass(frozen=True)
class ClipPool:
    """The M candidates of a selection: frames of clips."""

    embeddings: FloatArray
    """(M, D)."""
    starts: FloatArray
    """(M, D) x_0 of each."""
    clip: NDArray[np.intp]
    """(M,) index of the clip that each is of."""
    satisfies: NDArray[np.bool_]
    """(M,) whether it reaches the goal."""

    def scores(self, start: FloatArray, goal: FloatArray, features: Features, similarity: Similarity) -> Values:
        """Score by one start and one goal, (1, D) each: (M,) float64."""
        scores = np.empty(len(self.embeddings))
        for clip in np.unique(self.clip):  # frames of one clip share x_0
            members = np.flatnonzero(self.clip == clip)
            frames = np.concatenate([self.starts[members[:1]], self.embeddings[members]])[:, None]
            scores[members] = score_views(frames, start, goal, features, similarity)[1:]
        return scores


def things_with(clips: Sequence[Clip], n_clips: int) -> list[str]:
    """Return the objects that have at least `n_clips` clips."""
    counts = Counter(clip.thing for clip in clips)
    return [thing for thing, count in counts.items() if count >= n_clips]


def clip_pool(
    clips: Sequence[Clip],
    embeddings: Sequence[FloatArray],
    thing: str,
    *,
    diverse: bool = False,
    any_thing: bool = False,
    same_context: bool = True,
    left_out: int | None = None,
    seed: int = 0,
) -> ClipPool:
    """Return the frames of all clips but the one that specifies the goal.

    Args:
        clips: all of them; at least 2 must remain.
        embeddings: (n, D) per clip.
        thing: the goal's object.
        diverse: take clips of all objects, not of the goal's alone.
        any_thing: the end of a clip of any object counts as reaching the goal, not of the goal's alone.
        same_context: take x_0 from a candidate's own clip, else from another one drawn with `seed`.
        left_out: index of the clip that specifies the goal, if it is one of `clips`.
        seed: of that draw.
    """
    kept = [i for i, clip in enumerate(clips) if i != left_out and (diverse or clip.thing == thing)]
    contexts = np.arange(len(kept)) if same_context else selection.draw_others(len(kept), seed)
    lengths = [len(embeddings[i]) for i in kept]
    reached = [
        (np.arange(n) >= n - max(1, round(GOAL_SHARE * n))) & (any_thing or clips[i].thing == thing)
        for i, n in zip(kept, lengths, strict=True)
    ]
    starts = [embeddings[kept[context]][:1] for context in contexts]
    return ClipPool(
        np.concatenate([embeddings[i][1:] for i in kept]),
        np.concatenate([np.repeat(start, n - 1, axis=0) for start, n in zip(starts, lengths, strict=True)]),
        np.repeat(kept, np.array(lengths) - 1),
        np.concatenate([frames[1:] for frames in reached]),
    )


@dataclass(frozen=True)
class ObjectSelection:
    """How well the goals of one object are selected; means over the clips that specify the goal in turn."""

    top_n_success: Estimate
    relative_variation: Estimate
    goal_frame_ratio: float
    """Share of candidates that reach the goal: the success rate of a random choice."""
    top: int
    """N of the Top-N success rate, lowered where fewer candidates reach the goal."""
    n_goals: int
    n_clips: int
    """Of this object."""

    def as_json(self) -> dict[str, Any]:
        """Return the figures by their names."""
        estimates = {name: getattr(self, name).as_json() for name in ("top_n_success", "relative_variation")}
        return {**vars(self), **estimates}


@dataclass(frozen=True)
class ClipSelection:
    """How well goals or actions are selected in real video, per object."""

    objects: Mapping[str, ObjectSelection]
    left_out: tuple[str, ...]
    """Objects with too few clips."""
    n_clips: int
    embedder_sha256: str

    def mean(self) -> dict[str, float]:
        """Return means over objects, and the ratio of the success rate to that of a random choice."""
        success = float(np.mean([selected.top_n_success.value for selected in self.objects.values()]))
        chance = float(np.mean([selected.goal_frame_ratio for selected in self.objects.values()]))
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
    """Let each clip specify the goal by its first and last frame: do the highest scores find the ends of other clips?

    Args:
        folder: clips, as for `find_clips`.
        goals: folder of other clips that specify the goals; default those of `folder` in turn.
        ask: goals: ends of clips of the goal's object count; actions: of any object (give pool ``all``).
        template: the action, with Something-Something V2.
        pool: candidates of the goal's object alone, or of all objects.
        context: x_0 comes from the candidate's own clip or from another one.
        embedder: URI of the network.
        features: how frames and goals are compared.
        similarity: how frames and goals are compared.
        top: N of the Top-N success rate; lowered where fewer candidates reach the goal.
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
    goal_things = {clip.thing for clip in goal_clips}
    things = [thing for thing in things_with(clips, 3 if within else 2) if thing in goal_things]
    left_out = dict.fromkeys(clip.thing for clip in (*clips, *goal_clips) if clip.thing not in things)
    if not things:
        raise BadInput(
            f"no object has 2 clips in {folder} to choose from and 1 other in {goal_folder} for the goal; "
            f"left out: {', '.join(map(repr, left_out))}"
        )
    clips = _first_of_each(clips, things, max_clips)
    goal_clips = clips if within else _first_of_each(goal_clips, things, max_clips)
    network = load_embedder(embedder, device=device, precision=precision, one_thread=True)
    distinct = clips if within else [*clips, *goal_clips]
    vectors = embed_clips(distinct, network, n_frames, on_progress)
    embeddings, goal_embeddings = vectors[: len(clips)], vectors[-len(goal_clips) :]
    objects = {}
    for thing in things:
        goal_indices = [i for i, clip in enumerate(goal_clips) if clip.thing == thing]
        successes, variations, ratios, tops = [], [], [], []
        for repeat, goal in enumerate(np.random.default_rng(0).permutation(goal_indices)[:n_repeats].tolist()):
            candidates = clip_pool(
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
            scores = candidates.scores(*start_and_goal, features, similarity)
            successes.append(selection.top_up_to(scores, candidates.satisfies, top))
            variations.append(selection.relative_variation(scores, candidates.satisfies))
            ratios.append(selection.goal_frame_ratio(candidates.satisfies))
            tops.append(min(top, int(candidates.satisfies.sum())))
        objects[thing] = ObjectSelection(
            bootstrap([np.array(successes)]),
            bootstrap([np.array(variations)]),
            float(np.mean(ratios)),
            min(tops),
            len(successes),
            sum(clip.thing == thing for clip in clips),
        )
    return ClipSelection(objects, tuple(left_out), len(clips), network.fingerprint)


def _first_of_each(clips: Sequence[Clip], things: Sequence[str], most: int | None) -> list[Clip]:
    """Return the first clips of each object."""
    return [clip for thing in things for clip in [c for c in clips if c.thing == thing][:most]]
