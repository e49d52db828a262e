"""Real video: clips as files or as folders of pictures, and folders laid out as Something-Something V2.

A clip shows one object that is acted on from its start to its end: its first frame is a start, its last one a goal, and
its last `GOAL_SHARE` of frames count as reaching the goal of the same object, and as showing the action that all clips
share. That reading is ours; Cui et al. 2022 (§5.2) do not say which frames do.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from zest_rl.data.video import VIDEO_SUFFIXES, read_frames
from zest_rl.embedders import Embedder
from zest_rl.errors import BadInput, nearest
from zest_rl.metrics.selection import others
from zest_rl.metrics.statistics import Values
from zest_rl.rewards.scores import Features, Similarity, score_views
from zest_rl.runtime import artifacts
from zest_rl.runtime.arrays import read_arrays, write_arrays
from zest_rl.runtime.parallel import one_thread
from zest_rl.types import FloatArray

OPENING = "Opening [something]"
OBJECTS = ("door", "drawer", "box", "fridge", "laptop", "washing machine", "oven")
"""The seven objects of the paper."""
CALLED = {
    "box": "box(es)?",
    "fridge": "(fridge|refrigerator)s?",
    "laptop": "laptops?( computers?)?",
    "oven": "(?<!microwave )ovens?",
}
"""What labels call an object, where it is not its name alone or with an s."""
GOAL_SHARE = 0.2
VIDEOS = "20bn-something-something-v2"
LABELS = tuple(
    f"{folder}{prefix}{part}.json"
    for folder in ("", "labels/")
    for prefix in ("something-something-v2-", "")
    for part in ("train", "validation")
)
"""Where the labels of its releases stand."""


@dataclass(frozen=True)
class Clip:
    """One video of one object."""

    path: Path
    """A video file, or a folder of pictures in the order of their names."""
    thing: str
    """What is acted on."""


def find_clips(root: Path, template: str = OPENING) -> list[Clip]:
    """Find the clips in a folder of either layout: `something_something` or `folder_of_clips`.

    Args:
        root: the folder.
        template: the action; in a folder by object all clips are of it.

    Raises:
        BadInput: there is none.
    """
    return something_something(root, template=template) if (root / VIDEOS).exists() else folder_of_clips(root)


def something_something(root: Path, things: Sequence[str] = OBJECTS, template: str = OPENING) -> list[Clip]:
    """Find the clips of one action on some objects in a folder laid out as Something-Something V2.

    The folder holds ``20bn-something-something-v2/ID.webm`` and one of `LABELS`, lists of ``{"id", "template",
    "placeholders"}``. A clip is of what its first placeholder ends with: "a kitchen drawer" is a drawer, "the fridge
    door" a fridge.

    Raises:
        BadInput: the layout is another one, or no clip is found.
    """
    files = [root / name for name in LABELS if (root / name).is_file()]
    if not files or not (root / VIDEOS).is_dir():
        raise BadInput(f"{root} must hold {VIDEOS}/ and {LABELS[0]} (or {LABELS[-2]}), as Something-Something V2 does")
    clips, templates = [], set()
    for file in files:
        try:
            entries = json.loads(file.read_text(encoding="utf-8"))
            for entry in entries:
                templates.add(entry["template"])
                if entry["template"] == template:
                    thing = _named(str(entry["placeholders"][0]).lower().strip(), things)
                    path = root / VIDEOS / f"{entry['id']}.webm"
                    if thing is not None and path.is_file():
                        clips.append(Clip(path, thing))
        except (ValueError, KeyError, TypeError, IndexError) as error:
            raise BadInput(f"{file} is not a list of labels ({error!r}); download it again") from error
    if template not in templates:
        raise BadInput(f"no clip is of {template!r}; {nearest(template, templates)}")
    if not clips:
        raise BadInput(f"{root} has no video of {template!r} with {', '.join(things)}")
    return clips


def _named(words: str, things: Sequence[str]) -> str | None:
    """Return which thing a label names, if any."""

    def ends(text: str) -> str | None:
        called = {thing: CALLED.get(thing, f"{re.escape(thing)}s?") for thing in things}
        return next((thing for thing, name in called.items() if re.search(rf"\b({name})$", text)), None)

    return ends(re.sub(r"\s+doors?$", "", words)) or ends(words)


def folder_of_clips(root: Path) -> list[Clip]:
    """Find clips that are sorted by object: ``ROOT/OBJECT/CLIP.mp4``, or ``ROOT/OBJECT/CLIP/`` with pictures.

    Raises:
        BadInput: there is none.
    """
    clips = [
        Clip(path, thing.name)
        for thing in _visible(root)
        if thing.is_dir()
        for path in _visible(thing)
        if path.is_dir() or path.suffix.lower() in VIDEO_SUFFIXES
    ]
    if not clips:
        raise BadInput(
            f"{root} must hold a folder per object with videos, or folders of pictures, in it, or {VIDEOS}/ and labels "
            "as Something-Something V2 does"
        )
    return clips


def _visible(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if not path.name.startswith(".")) if folder.is_dir() else []


def embed_clips(
    clips: Sequence[Clip], embedder: Embedder, n_frames: int, on_done: Callable[[], object] = lambda: None
) -> list[FloatArray]:
    """Embed clips, each once: what was embedded is kept in the cache, by content.

    Args:
        clips: what to embed.
        embedder: the network.
        n_frames: of each clip.
        on_done: called after each clip.

    Returns:
        (n, D) float32 per clip.
    """
    vectors = []
    for clip in clips:
        parts = sorted(clip.path.iterdir()) if clip.path.is_dir() else [clip.path]
        content = [artifacts.hash_file(path) for path in parts if path.is_file()]
        digest = artifacts.hash_json([content, embedder.fingerprint, n_frames])
        path = artifacts.cache_dir() / "clips" / f"{digest[:20]}.npz"
        cached = read_arrays(path)
        if cached is None:
            with one_thread():
                cached = {"embeddings": embedder.embed_images(read_frames(clip.path, n_frames))}
            write_arrays(path, cached)
        vectors.append(np.asarray(cached["embeddings"], dtype=np.float32))
        on_done()
    return vectors


@dataclass(frozen=True)
class Frames:
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
) -> Frames:
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
    contexts = np.arange(len(pool)) if same_context else others(len(pool), seed)
    lengths = [len(embeddings[i]) for i in pool]
    reached = [
        (np.arange(n) >= n - max(1, round(GOAL_SHARE * n))) & (any_thing or clips[i].thing == thing)
        for i, n in zip(pool, lengths, strict=True)
    ]
    starts = [embeddings[pool[context]][:1] for context in contexts]
    return Frames(
        np.concatenate([embeddings[i][1:] for i in pool]),
        np.concatenate([np.repeat(start, n - 1, axis=0) for start, n in zip(starts, lengths, strict=True)]),
        np.repeat(pool, np.array(lengths) - 1),
        np.concatenate([one[1:] for one in reached]),
    )
