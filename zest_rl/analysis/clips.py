"""Real video by object: clips as files or as folders of pictures, and folders laid out as Something-Something V2."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from zest_rl.data.video import VIDEO_SUFFIXES, read_frames
from zest_rl.embedders import Embedder
from zest_rl.errors import BadInput, nearest
from zest_rl.rewards.embeddings import check_equal
from zest_rl.runtime import artifacts
from zest_rl.runtime.arrays import read_arrays, write_arrays
from zest_rl.runtime.cache import cache_folder
from zest_rl.types import FloatArray

OPENING = "Opening [something]"
OBJECTS = ("door", "drawer", "box", "fridge", "laptop", "washing machine", "oven")
"""The seven objects of the paper."""
LABEL_PATTERNS = {
    "box": "box(es)?",
    "fridge": "(fridge|refrigerator)s?",
    "laptop": "laptops?( computers?)?",
    "oven": "(?<!microwave )ovens?",
}
"""Regular expression for an object in a label, where it is not its name with an optional s."""
VIDEOS = "20bn-something-something-v2"
LABELS = tuple(
    f"{folder}{prefix}{part}.json"
    for folder in ("", "labels/")
    for prefix in ("something-something-v2-", "")
    for part in ("train", "validation")
)
"""Paths of the labels in its releases."""


@dataclass(frozen=True)
class Clip:
    """One video of one object."""

    path: Path
    """A video file, or a folder of pictures in the order of their names."""
    thing: str
    """The object that is acted on."""


def find_clips(root: Path, template: str = OPENING) -> list[Clip]:
    """Find the clips in a folder of either layout: `something_something` or `folder_of_clips`.

    Args:
        root: the folder.
        template: the action; a folder of clips by object has one action only.

    Raises:
        BadInput: there is none.
    """
    return something_something(root, template=template) if (root / VIDEOS).exists() else folder_of_clips(root)


def something_something(root: Path, things: Sequence[str] = OBJECTS, template: str = OPENING) -> list[Clip]:
    """Find the clips of one action on some objects in a folder laid out as Something-Something V2.

    The folder holds ``20bn-something-something-v2/ID.webm`` and one of `LABELS`, lists of ``{"id", "template",
    "placeholders"}``. A clip's object is the end of its first placeholder: "a kitchen drawer" is a drawer, "the fridge
    door" a fridge.

    Raises:
        BadInput: the layout differs, or no clip is found.
    """
    files = [root / name for name in LABELS if (root / name).is_file()]
    if not files or not (root / VIDEOS).is_dir():
        raise BadInput(f"{root} must hold {VIDEOS}/ and {LABELS[0]} (or {LABELS[-2]}), as Something-Something V2 does")
    clips, templates = [], set()
    for file in files:
        try:
            entries = json.loads(file.read_text(encoding="utf-8"))
            for entry in entries:
                templates.add(str(entry["template"]))
                if entry["template"] == template:
                    thing = _object_of(str(entry["placeholders"][0]).lower().strip(), things)
                    name = f"{entry['id']}.webm"
                    if name != Path(name).name:
                        raise ValueError(f"{name!r} is no file name")
                    path = root / VIDEOS / name
                    if thing is not None and path.is_file():
                        clips.append(Clip(path, thing))
        except (ValueError, KeyError, TypeError, IndexError, RecursionError, MemoryError) as error:
            raise BadInput(f"{file} is not a list of labels ({error!r}); download it again") from error
    if template not in templates:
        raise BadInput(f"no clip is of {template!r}; {nearest(template, templates)}")
    if not clips:
        raise BadInput(f"{root} has no video of {template!r} with {', '.join(things)}")
    return clips


def _object_of(label: str, things: Sequence[str]) -> str | None:
    """Return the object that a label names, if any."""

    def at_end(text: str) -> str | None:
        patterns = {thing: LABEL_PATTERNS.get(thing, f"{re.escape(thing)}s?") for thing in things}
        return next((thing for thing, pattern in patterns.items() if re.search(rf"\b({pattern})$", text)), None)

    return at_end(re.sub(r"\s+doors?$", "", label)) or at_end(label)


def folder_of_clips(root: Path) -> list[Clip]:
    """Find clips sorted by object: ``ROOT/OBJECT/CLIP.mp4``, or ``ROOT/OBJECT/CLIP/`` with pictures.

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
    clips: Sequence[Clip], embedder: Embedder, n_frames: int, on_progress: Callable[[int, int], None] | None = None
) -> list[FloatArray]:
    """Embed clips, each once: embeddings are cached by content, and one is compared with the same computed again.

    Args:
        clips: to be embedded.
        embedder: the network.
        n_frames: of each clip.
        on_progress: called with (clips embedded, clips in all).

    Returns:
        (n, D) float32 per clip.
    """
    folder, paths, vectors = cache_folder("clips"), [], []
    for clip in clips:
        parts = sorted(clip.path.iterdir()) if clip.path.is_dir() else [clip.path]
        content = [artifacts.hash_file(path) for path in parts if path.is_file()]
        digest = artifacts.hash_json([content, embedder.cache_key, n_frames])
        paths.append(folder / f"{digest[:20]}.npz")
    rng = np.random.default_rng()
    cached = [path for path in paths if path.exists()]
    checked = cached[rng.integers(len(cached))] if cached else None
    for clip, path in zip(clips, paths, strict=True):
        arrays = read_arrays(path, {"embeddings": (np.float32, (None, embedder.dim))})
        if arrays is None:
            arrays = {"embeddings": embedder.embed_images(read_frames(clip.path, n_frames))}
            write_arrays(path, arrays)
        elif path == checked:
            again = embedder.embed_images(read_frames(clip.path, n_frames)[:1])
            check_equal(folder, [(arrays["embeddings"][:1], again)])
        vectors.append(arrays["embeddings"])
        if on_progress is not None:
            on_progress(len(vectors), len(clips))
    return vectors
