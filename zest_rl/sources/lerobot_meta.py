"""What ``meta/`` of a LeRobot v3.0 folder says (layout in `zest_rl.sources.lerobot`), checked: it may be anyone's."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from zest_rl.data.observations import choose_pictures
from zest_rl.data.picture_forms import PictureForm
from zest_rl.errors import BadInput, Notice, ZestError
from zest_rl.runtime import artifacts
from zest_rl.runtime.files import is_there, path_under
from zest_rl.sources.parquet import MAX_ROWS, read_table

INFO = Path("meta", "info.json")
OTHERS = ("action", "next.reward", "next.done", "next.truncated", "next.success")
"""Features that are read besides what is observed."""
_MAX_EPISODES, _MAX_FPS = 10**6, 10_000
_NUMBERS = ("float16", "float32", "float64", "int8", "int16", "int32", "int64", "uint8", "bool")
_BOOKKEEPING = ("timestamp", "frame_index", "episode_index", "index", "task_index", "actions")
_FIELD = re.compile(r"\{(chunk_index|file_index|video_key)(?::0?(\d{1,2})d)?\}")
_WRONG = (ZestError, AttributeError, KeyError, TypeError, ValueError, OverflowError, RecursionError, MemoryError)
"""What reading JSON of another form than expected raises."""


@dataclass(frozen=True)
class ListedEpisode:
    """A row of ``meta/episodes``."""

    number: int
    n_steps: int
    data: str
    """The file, relative to the root."""
    videos: tuple[tuple[str, float], ...]
    """Per view: the file, and where the episode starts in it, in seconds."""

    def problem(self, root: Path) -> str:
        """Say what the episode lacks; empty if it is complete."""
        if self.n_steps < 1:
            return f"has {self.n_steps} steps"
        files = (path_under(root, name) for name in (self.data, *(name for name, _ in self.videos)))
        return next((f"lacks {path.relative_to(root).as_posix()[:200]}" for path in files if not is_there(path)), "")


@dataclass(frozen=True)
class Info:
    """What ``meta/info.json`` says, checked."""

    features: Mapping[str, Mapping[str, Any]]
    fps: float
    data_path: str
    video_path: str
    n_episodes: int | None

    @classmethod
    def read(cls, root: Path) -> Info:
        """Raise `BadInput` for another version or format."""
        try:
            info = artifacts.read_json(root / INFO)
            if not isinstance(info, dict):
                raise ValueError(f"a list of names and values is needed, got {str(info)[:20]}")
            version = str(info["codebase_version"])
            if not version.startswith("v3."):
                raise BadInput(
                    f"{root} is a LeRobot dataset of version {version[:20]}, v3.0 is read; convert it with "
                    "lerobot's own convert_dataset_v21_to_v30 (if it is older than v2.1, to that first)"
                )
            features = {str(name): dict(facts) for name, facts in dict(info["features"]).items()}
            total = None if info.get("total_episodes") is None else int(info["total_episodes"])
            made = cls(features, float(info["fps"]), str(info["data_path"]), str(info.get("video_path")), total)
            if not 0 < made.fps <= _MAX_FPS:
                raise ValueError(f"fps must be in (0, {_MAX_FPS}], got {made.fps:g}")
            for name, facts in features.items():
                if "/" in name or not name.strip(".") or not name.isprintable():
                    raise ValueError(f"{name!r} cannot be the name of a feature")
                facts["dtype"], facts["shape"] = str(facts["dtype"]), [int(n) for n in facts["shape"]]
        except BadInput:
            raise
        except _WRONG as error:
            raise BadInput(
                f"{root}/meta is not that of a LeRobot v3.0 dataset ({error} in info.json); download it again"
            ) from error
        return made

    def columns(self, root: Path) -> dict[str, str]:
        """Return the names of observed numbers and of `OTHERS` here, and their columns.

        Raises:
            BadInput: there is no action.
        """
        numeric = [n for n, facts in self.features.items() if facts["dtype"] in _NUMBERS and len(facts["shape"]) <= 1]
        observed = {name: name for name in numeric if name.startswith("observation")}
        others = {name: name for name in OTHERS if name in self.features}
        if "action" not in others and "actions" in numeric:  # openpi's names
            others = {"action": "actions", **others}
        if not observed:
            observed = {name: name for name in numeric if name not in (*_BOOKKEEPING, *OTHERS)}
        if "action" not in others:
            raise BadInput(f"{root} has no feature 'action', got {', '.join(self.features)}; rename it in info.json")
        return observed | others

    def choose_views(self, keys: Sequence[str], root: Path) -> tuple[list[str], bool]:
        """Return the features that are the frames, and whether they are videos rather than pictures in the data files.

        Those are taken that are asked for, else the only video, else the only picture; none if there is neither.
        """
        kinds = {name: facts["dtype"] for name, facts in self.features.items() if not _is_depth(facts)}
        taken = ("video",) if not keys and "video" in kinds.values() else ("video", "image")
        forms = {name: PictureForm(3) for name, kind in kinds.items() if kind in taken}
        views = choose_pictures(forms, keys, str(root)) if keys or forms else []
        chosen = {kinds[view] for view in views}
        if len(chosen) > 1:
            raise BadInput(f"the views must be all videos or all pictures, got {', '.join(views)}")
        return views, chosen == {"video"}

    def listed(self, row: Mapping[str, Any], views: Sequence[str]) -> ListedEpisode:
        """Read a row of ``meta/episodes``; raises what `int`, `float` and missing keys raise."""
        videos = []
        for view in views:
            start = float(row[f"videos/{view}/from_timestamp"])
            if not 0 <= start < math.inf:
                raise ValueError(f"videos/{view}/from_timestamp is {start}")
            videos.append((_path(self.video_path, row, f"videos/{view}", view), start))
        number, n_steps = int(row["episode_index"]), int(row["length"])
        if not (0 <= number < MAX_ROWS and n_steps < MAX_ROWS):
            raise ValueError(f"episode_index is {number}, length {n_steps}")
        return ListedEpisode(number, n_steps, _path(self.data_path, row, "data"), tuple(videos))


def read_listing(root: Path, info: Info, views: Sequence[str]) -> list[ListedEpisode]:
    """Read ``meta/episodes``, sorted by number.

    Raises:
        BadInput: a file is damaged, or an episode is listed twice or not at all.
    """
    parts = ("chunk_index", "file_index")
    videos = [f"videos/{view}/{part}" for view in views for part in (*parts, "from_timestamp")]
    columns = ["episode_index", "length", *(f"data/{part}" for part in parts), *videos]
    listed = []
    for path in sorted(root.glob("meta/episodes/*/*.parquet")):
        rows = read_table(path, columns, _MAX_EPISODES).to_pylist()
        try:
            listed += [info.listed(row, views) for row in rows]
        except BadInput:
            raise
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise BadInput(f"{path} is not that of a LeRobot v3.0 dataset ({error!r}); download it again") from error
    if info.n_episodes not in (None, len(listed)):
        message = f"{root}/meta/episodes lists {len(listed)} episodes, but info.json says {info.n_episodes}"
        warnings.warn(f"{message}; those that are listed are taken", Notice, stacklevel=2)
    if not listed or len({episode.number for episode in listed}) < len(listed):
        raise BadInput(f"{root}/meta/episodes must list every episode once, got {len(listed)} rows; download it again")
    return sorted(listed, key=lambda episode: episode.number)


def complete_episodes(root: Path, listed: Sequence[ListedEpisode], skip_incomplete: bool) -> list[ListedEpisode]:
    """Return the episodes that have steps and whose files are there.

    Raises:
        BadInput: there are others, and they are not to be skipped (else a `Notice` names them), or there is none.
    """
    problems = {episode.number: problem for episode in listed if (problem := episode.problem(root))}
    complete = [episode for episode in listed if episode.number not in problems]
    if problems:
        first = ", ".join(f"episode {number} {problem}" for number, problem in list(problems.items())[:3])
        n = f"{len(problems)} of the {len(listed)} episodes of {root} are incomplete: {first}"
        if not (skip_incomplete and complete):
            there = ", ".join(str(episode.number) for episode in complete[:10]) or "none"
            raise BadInput(
                f"{n}; download the dataset whole, or take what is there by --skip-incomplete: {len(complete)} "
                f"episodes ({there}{', …' if len(complete) > 10 else ''})"
            )
        warnings.warn(f"{n}; they are left out", Notice, stacklevel=2)
    return complete


def _path(template: str, row: Mapping[str, Any], where: str, video_key: str = "") -> str:
    """Fill in a path of ``info.json``: the known names and widths of integers, and nothing else that `format` knows."""
    rest = _FIELD.sub("", template)
    if "{" in rest or "}" in rest:
        raise ValueError(f"the path {template[:80]!r} in info.json may name chunk_index, file_index and video_key only")
    values = {f"{part}_index": int(row[f"{where}/{part}_index"]) for part in ("chunk", "file")}

    def value(field: re.Match[str]) -> str:
        return video_key if field[1] == "video_key" else str(values[field[1]]).zfill(int(field[2] or 0))

    return _FIELD.sub(value, template)


def _is_depth(facts: Mapping[str, Any]) -> bool:
    info = facts.get("info")
    return isinstance(info, Mapping) and bool(info.get("is_depth_map") or info.get("video.is_depth_map"))
