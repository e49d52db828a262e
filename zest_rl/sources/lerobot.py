"""LeRobot datasets (v3.0): parquet files of numbers and MP4 files of frames, several episodes in each.

Layout: https://huggingface.co/docs/lerobot/lerobot-dataset-v3, read without the lerobot package::

    meta/info.json                                  codebase_version, fps, features, data_path, video_path
    meta/episodes/chunk-000/file-000.parquet        a row per episode: episode_index, length, data/{chunk,file}_index,
                                                    videos/KEY/{chunk_index, file_index, from_timestamp}
    data/chunk-000/file-000.parquet                 a row per frame: episode_index, observation.*, action, next.reward …
    videos/KEY/chunk-000/file-000.mp4               one camera

An episode has T rows and T frames, o_0 … o_{T-1}; o_T, which is not recorded, repeats o_{T-1}. LeRobot's ``next.done``
marks the last frame whatever ended the episode, so an episode counts as terminated when its last ``next.done`` is true
and its last ``next.truncated`` false; where either is not recorded, as cut by a time limit.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray

from zest_rl.data.observations import choose_pictures
from zest_rl.errors import BadInput
from zest_rl.runtime import artifacts
from zest_rl.sources import conversion
from zest_rl.sources.conversion import ConvertedEpisode
from zest_rl.types import FloatArray, Frame

INFO = Path("meta", "info.json")
_NUMBERS = ("float16", "float32", "float64", "int8", "int16", "int32", "int64", "uint8", "bool")

_OTHERS = ("action", "next.reward", "next.done", "next.truncated", "next.success")


@dataclass(frozen=True)
class Rows:
    """The `Trajectories` of a LeRobot folder; videos are left where they are."""

    root: Path
    files: tuple[tuple[str, tuple[int, ...]], ...]
    """Data files, relative to the root, with the ``episode_index`` of each that is read from it, in order."""
    n_steps: tuple[int, ...]
    """T of every episode."""
    observed: tuple[str, ...]
    """Columns with numbers that are observed."""
    others: tuple[str, ...]
    """Those of `_OTHERS` that there are."""
    fps: float
    """Steps per second."""

    @property
    def dataset_id(self) -> str:
        """Made of the folder's name."""
        return conversion.dataset_id_of(self.root)

    @property
    def n_bytes(self) -> int:
        """Of the parquet files, which are compressed by less than this."""
        return 4 * sum((self.root / file).stat().st_size for file, _ in self.files)

    def fingerprint(self) -> str:
        """Hash observations, actions and ends, and the frame rate, which the copy keeps."""
        return artifacts.hash_json([conversion.fingerprint(self.episodes()), self.fps])

    def rewards_to_keep(self) -> Sequence[FloatArray | None]:
        """Read the rewards that the episodes came with."""
        return [episode.rewards for episode in self.episodes()]

    def fill(self, folder: Path) -> None:
        """Write them as a Minari dataset."""
        description = f"Imported from {self.root.name} (LeRobot)."
        conversion.write_converted(folder, self.dataset_id, self.episodes(), description, fps=self.fps)

    def written(self) -> Iterator[Mapping[str, NDArray[Any]]]:
        """Yield what is written of each episode."""
        return map(conversion.stored, self.episodes())

    def episodes(self) -> Iterator[ConvertedEpisode]:
        """Read one file at a time, which LeRobot keeps at 100 MB."""
        import pyarrow.compute
        import pyarrow.parquet

        lengths = iter(self.n_steps)
        for file, members in self.files:
            path = self.root / file
            table = pyarrow.parquet.read_table(path, columns=["episode_index", *self.observed, *self.others])
            for episode in members:
                rows = table.filter(pyarrow.compute.equal(table["episode_index"], episode))
                if len(rows) != (length := next(lengths)):
                    raise BadInput(
                        f"{path} has {len(rows)} rows of episode {episode}, but meta/episodes says {length}; download "
                        "the dataset again"
                    )
                yield self._episode({name: _column(rows[name]) for name in (*self.observed, *self.others)})

    def _episode(self, columns: Mapping[str, FloatArray]) -> ConvertedEpisode:
        obs = {name: np.concatenate([columns[name], columns[name][-1:]]) for name in self.observed}
        n_steps = len(columns["action"])
        rewards = columns.get("next.reward", np.full((n_steps, 1), np.nan, np.float32))[:, 0]
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
    """Where a view of an episode stands in a video."""

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
        """Tell which cameras the frames are of, and how they align."""
        return {"kind": "videos", "views": list(self.views), "alignment": "frame t is x_t; x_T repeats x_{T-1}"}

    def digest(self, episode: int) -> str:
        """Hash the videos and the places in them."""
        spans = self.spans[episode]
        return artifacts.hash_json([[_hash_video(s.path), s.start, s.n_frames, self.fps] for s in spans])

    def read(self, episode: int) -> Iterator[Sequence[Frame]]:
        """Decode the views side by side."""
        return zip(*(_decode(span, self.fps) for span in self.spans[episode]), strict=False)


@functools.cache
def _hash_video(path: Path) -> str:
    return artifacts.hash_file(path)  # once, though many episodes are in it


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
    """Whether a folder is laid out as a LeRobot dataset, of any version."""
    return (folder / INFO).is_file()


def open_lerobot(root: Path, keys: Sequence[str], *, with_frames: bool = True) -> tuple[Rows, Videos | None]:
    """Open a LeRobot folder.

    Args:
        root: the folder.
        keys: which features are the frames, one per view; empty: the only video there is.
        with_frames: False where the frames are elsewhere.

    Returns:
        The episodes; and their videos, None where there are none, or they are not asked for.

    Raises:
        BadInput: another version, pyarrow is not installed, a file is missing, or the videos cannot be told apart.
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
        places = [f"videos/{view}/{part}" for view in views for part in ("chunk_index", "file_index", "from_timestamp")]
        columns = ["episode_index", "length", "data/chunk_index", "data/file_index", *places]
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
    rows_ = Rows(root, files, n_steps, observed, others, fps)
    return rows_, Videos(tuple(views), fps, spans) if views else None


def _path(template: str, row: Mapping[str, Any], where: str, video_key: str = "") -> str:
    numbers = {f"{part}_index": row[f"{where}/{part}_index"] for part in ("chunk", "file")}
    return template.format(video_key=video_key, **numbers)


def _is_depth(facts: Mapping[str, Any]) -> bool:
    info: Mapping[str, Any] = facts.get("info") or {}
    return bool(info.get("is_depth_map") or info.get("video.is_depth_map"))
