"""LeRobot datasets (v3.0): parquet files of numbers and MP4 files of frames, several episodes in each.

Layout: https://huggingface.co/docs/lerobot/lerobot-dataset-v3, read without the lerobot package::

    meta/info.json                                  codebase_version, fps, features, data_path, video_path
    meta/episodes/chunk-000/file-000.parquet        a row per episode: episode_index, length, data/{chunk,file}_index,
                                                    videos/KEY/{chunk_index, file_index, from_timestamp}
    data/chunk-000/file-000.parquet                 a row per frame: episode_index, observation.*, action, next.reward …
    videos/KEY/chunk-000/file-000.mp4               one camera

An episode has T rows and T frames, o_0 … o_{T-1}; o_T, which is not recorded, repeats o_{T-1}. LeRobot's ``next.done``
marks the last frame of every episode, so an episode counts as terminated if its last ``next.done`` is true and its
last ``next.truncated`` is false, and as truncated where either is not recorded.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np

from zest_rl.data.observations import choose_pictures
from zest_rl.errors import BadInput
from zest_rl.runtime import artifacts
from zest_rl.sources.conversion import ConvertedEpisode, ConvertedTrajectories
from zest_rl.types import FloatArray, Frame

INFO = Path("meta", "info.json")
_NUMBERS = ("float16", "float32", "float64", "int8", "int16", "int32", "int64", "uint8", "bool")
_OTHERS = ("action", "next.reward", "next.done", "next.truncated", "next.success")


def read_episodes(
    root: Path, files: Sequence[tuple[str, Sequence[int]]], n_steps: Sequence[int], columns: Sequence[str]
) -> Iterator[ConvertedEpisode]:
    """Read one data file at a time; LeRobot limits each to 100 MB.

    Args:
        root: the dataset's folder.
        files: data files, relative to the root, each with the ``episode_index`` of the episodes read from it, in order.
        n_steps: T of every episode.
        columns: observed numbers, and those of `_OTHERS` in the dataset.
    """
    import pyarrow.compute
    import pyarrow.parquet

    lengths = iter(n_steps)
    for file, members in files:
        table = pyarrow.parquet.read_table(root / file, columns=["episode_index", *columns])
        for episode in members:
            rows = table.filter(pyarrow.compute.equal(table["episode_index"], episode))
            if len(rows) != (length := next(lengths)):
                raise BadInput(
                    f"{root / file} has {len(rows)} rows of episode {episode}, but meta/episodes says {length}; "
                    "download the dataset again"
                )
            yield _converted({name: _column(rows[name]) for name in columns})


def _converted(columns: Mapping[str, FloatArray]) -> ConvertedEpisode:
    observed = {name: values for name, values in columns.items() if name not in _OTHERS}
    obs = {name: np.concatenate([values, values[-1:]]) for name, values in observed.items()}
    rewards = columns.get("next.reward", np.full((len(columns["action"]), 1), np.nan, np.float32))[:, 0]
    done, truncated = (columns.get(f"next.{end}") for end in ("done", "truncated"))
    terminated = done is not None and truncated is not None and bool(done[-1, 0] and not truncated[-1, 0])
    success = columns["next.success"][:, 0] > 0 if "next.success" in columns else None
    return ConvertedEpisode(obs, columns["action"], rewards, terminated, success)


def _column(values: Any) -> FloatArray:
    """An Arrow column of numbers, or of lists of them: (T, n) float32."""
    array: Any = values.combine_chunks()
    flat = array.flatten() if hasattr(array, "flatten") and hasattr(array.type, "value_type") else array
    return np.asarray(flat.to_numpy(zero_copy_only=False), np.float32).reshape(len(array), -1)


@dataclass(frozen=True)
class Span:
    """Part of a video that shows one view of one episode."""

    path: Path
    start: float
    """Seconds."""
    n_frames: int


@dataclass(frozen=True)
class Videos:
    """`EpisodeFrames` of videos that hold several episodes each."""

    views: tuple[str, ...]
    fps: float
    spans: tuple[tuple[Span, ...], ...]
    """Per episode, per view."""

    def describe(self) -> dict[str, Any]:
        """The cameras, and the alignment of frames and steps."""
        return {"kind": "videos", "views": list(self.views), "alignment": "frame t is x_t; x_T repeats x_{T-1}"}

    def digest(self, episode: int) -> str:
        """Hash the videos and the spans in them."""
        spans = self.spans[episode]
        return artifacts.hash_json([[_hash_video(s.path), s.start, s.n_frames, self.fps] for s in spans])

    def read(self, episode: int) -> Iterator[Sequence[Frame]]:
        """Decode all views in step."""
        return zip(*(_decode(span, self.fps) for span in self.spans[episode]), strict=False)


@functools.cache
def _hash_video(path: Path) -> str:
    return artifacts.hash_file(path)  # cached, since a video holds many episodes


def _decode(span: Span, fps: float) -> Iterator[Frame]:
    start = max(0.0, span.start - 0.5 / fps)  # ffmpeg gives the first frame that is not before this
    try:
        reader = imageio_ffmpeg.read_frames(
            str(span.path),
            input_params=["-ss", f"{start:.6f}"],
            output_params=["-fps_mode", "passthrough", "-frames:v", str(span.n_frames)],
        )
        width, height = next(reader)["size"]
        for frame in reader:
            yield np.frombuffer(frame, np.uint8).reshape(height, width, 3)
    except (OSError, RuntimeError, StopIteration) as error:
        reason = " ".join(str(error).split())[:200]
        raise BadInput(f"{span.path} cannot be read as a video ({reason}); download the dataset again") from error


def is_lerobot(folder: Path) -> bool:
    """Whether a folder has the layout of a LeRobot dataset of any version."""
    return (folder / INFO).is_file()


def open_lerobot(
    root: Path, keys: Sequence[str], *, with_frames: bool = True
) -> tuple[ConvertedTrajectories, Videos | None]:
    """Open a LeRobot folder.

    Args:
        root: the folder.
        keys: features that are the frames, one per view; empty: the only video.
        with_frames: False where the frames are elsewhere.

    Returns:
        The episodes; and their videos, None without any or without `with_frames`.

    Raises:
        BadInput: another version, pyarrow is not installed, a file is missing, or the choice of videos is ambiguous.
    """
    info = artifacts.read_json(root / INFO)
    version = str(info.get("codebase_version"))
    if not version.startswith("v3."):
        raise BadInput(
            f"{root} is a LeRobot dataset of version {version}, v3.0 is read; convert it with lerobot's own "
            "convert_dataset_v21_to_v30"
        )
    try:
        import pyarrow.parquet
    except ImportError as error:
        raise BadInput("LeRobot's parquet files need pyarrow: pip install 'zest-rl[lerobot]'") from error
    root = root.resolve()
    try:
        features, fps = info["features"], float(info["fps"])
        videos = {name: 3 if f["dtype"] == "video" and not _is_depth(f) else None for name, f in features.items()}
        views = choose_pictures(videos, keys, str(root)) if with_frames and (keys or any(videos.values())) else []
        observed = tuple(
            name
            for name, facts in features.items()
            if name.startswith("observation") and facts["dtype"] in _NUMBERS and len(facts["shape"]) <= 1
        )
        video_columns = [
            f"videos/{view}/{part}" for view in views for part in ("chunk_index", "file_index", "from_timestamp")
        ]
        columns = ["episode_index", "length", "data/chunk_index", "data/file_index", *video_columns]
        parts = [pyarrow.parquet.read_table(p, columns=columns) for p in sorted(root.glob("meta/episodes/*/*.parquet"))]
        episodes = sorted((row for part in parts for row in part.to_pylist()), key=lambda row: row["episode_index"])
        n_steps = tuple(int(row["length"]) for row in episodes)
        if not episodes or len({row["episode_index"] for row in episodes}) < len(episodes):
            raise BadInput(
                f"{root}/meta/episodes must list every episode once, got {len(episodes)} rows; download it again"
            )
        by_file = groupby(episodes, lambda row: _path(info["data_path"], row, "data"))
        files = tuple((file, tuple(row["episode_index"] for row in rows)) for file, rows in by_file)
        spans = tuple(
            tuple(
                Span(
                    root / _path(info["video_path"], row, f"videos/{view}", view),
                    float(row[f"videos/{view}/from_timestamp"]),
                    int(row["length"]),
                )
                for view in views
            )
            for row in episodes
        )
    except (KeyError, OSError, pyarrow.ArrowException) as error:
        raise BadInput(f"{root}/meta is not that of a LeRobot v3.0 dataset ({error}); download it again") from error
    needed = {root / file for file, _ in files} | {span.path for episode in spans for span in episode}
    missing = sorted(path.relative_to(root).as_posix() for path in needed if not path.is_file())
    if missing:
        raise BadInput(f"{root} lacks {missing[0]} ({len(missing)} files in all); download the dataset whole")
    others = tuple(name for name in _OTHERS if name in features)
    if "action" not in others:
        raise BadInput(f"{root} has no feature 'action', got {', '.join(features)}")
    n_bytes = 4 * sum((root / file).stat().st_size for file, _ in files)  # parquet compresses by less than that
    read = partial(read_episodes, root, files, n_steps, (*observed, *others))
    trajectories = ConvertedTrajectories(root, "LeRobot", n_steps, n_bytes, read, fps)
    return trajectories, Videos(tuple(views), fps, spans) if views else None


def _path(template: str, row: Mapping[str, Any], where: str, video_key: str = "") -> str:
    numbers = {f"{part}_index": row[f"{where}/{part}_index"] for part in ("chunk", "file")}
    return template.format(video_key=video_key, **numbers)


def _is_depth(facts: Mapping[str, Any]) -> bool:
    info: Mapping[str, Any] = facts.get("info") or {}
    return bool(info.get("is_depth_map") or info.get("video.is_depth_map"))
