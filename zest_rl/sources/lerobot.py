"""LeRobot datasets (v3.0): parquet files of numbers and MP4 files of frames, several episodes in each.

Layout: https://huggingface.co/docs/lerobot/lerobot-dataset-v3, read without the lerobot package::

    meta/info.json                                  codebase_version, fps, features, data_path, video_path
    meta/episodes/chunk-000/file-000.parquet        a row per episode: episode_index, length, data/{chunk,file}_index,
                                                    videos/KEY/{chunk_index, file_index, from_timestamp}
    data/chunk-000/file-000.parquet                 a row per frame: episode_index, observation.*, action, next.reward …
    videos/KEY/chunk-000/file-000.mp4               one camera; a feature of dtype image is a column of the data files

An episode has T rows and T frames, o_0 … o_{T-1}; o_T, which is not recorded, repeats o_{T-1}. LeRobot's ``next.done``
marks the last frame of every episode, so an episode counts as terminated if its last ``next.done`` is true and its
last ``next.truncated`` is false, and as truncated where either is not recorded.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from zest_rl.data.video import frame_times, iter_frames
from zest_rl.errors import BadInput
from zest_rl.runtime import artifacts
from zest_rl.runtime.files import check_file
from zest_rl.sources.conversion import ConvertedEpisode, ConvertedTrajectories
from zest_rl.sources.lerobot_meta import INFO, OTHERS, Info, complete_episodes, read_listing
from zest_rl.sources.parquet import MAX_ROWS, as_numbers, open_parquet, read_table
from zest_rl.sources.parquet_pictures import ParquetPictures
from zest_rl.types import FloatArray, Frame, check_finite


def read_episodes(
    root: Path, files: Sequence[tuple[str, Sequence[int]]], n_steps: Sequence[int], columns: Mapping[str, str]
) -> Iterator[ConvertedEpisode]:
    """Read one data file at a time; LeRobot limits each to 100 MB.

    Args:
        root: the dataset's folder.
        files: data files, relative to the root, each with the ``episode_index`` of the episodes read from it, in order.
        n_steps: T of every episode.
        columns: observed numbers, and those of `OTHERS` in the dataset, by their names here; their names in the files.

    Raises:
        BadInput: a file is damaged, or an episode in it is not what ``meta/episodes`` says, or holds no finite numbers.
    """
    lengths, widths = iter(n_steps), dict[str, int]()
    for file, members in files:
        table = read_table(root / file, ["episode_index", *columns.values()], MAX_ROWS)
        for episode in members:
            rows, where = _rows_of(table, episode), f"episode {episode} in {root / file}"
            if len(rows) != (length := next(lengths)):
                raise BadInput(
                    f"{root / file} has {len(rows)} rows of episode {episode}, but meta/episodes says {length}; "
                    "download the dataset again"
                )
            read = {name: as_numbers(rows[column], f"{column} of {where}") for name, column in columns.items()}
            for name, values in read.items():
                if name != "next.reward":
                    check_finite(f"{columns[name]} of {where}", values)
                if values.shape[1] != widths.setdefault(name, values.shape[1]):
                    raise BadInput(
                        f"{columns[name]} of {where} holds {values.shape[1]} numbers per step, but {widths[name]} in "
                        "the first episode; download the dataset again"
                    )
            yield _converted(read)


def _rows_of(table: Any, episode: int) -> Any:
    import pyarrow.compute

    try:
        return table.filter(pyarrow.compute.equal(table["episode_index"], episode))
    except pyarrow.ArrowException as error:
        raise BadInput(f"episode_index must be whole numbers in every file, got {error}") from error


def _converted(columns: Mapping[str, FloatArray]) -> ConvertedEpisode:
    observed = {name: values for name, values in columns.items() if name not in OTHERS}
    obs = {name: np.concatenate([values, values[-1:]]) for name, values in observed.items()}
    rewards = columns.get("next.reward", np.full((len(columns["action"]), 1), np.nan, np.float32))[:, 0]
    done, truncated = (columns.get(f"next.{end}") for end in ("done", "truncated"))
    terminated = done is not None and truncated is not None and bool(done[-1, 0] and not truncated[-1, 0])
    success = columns["next.success"][:, 0] > 0 if "next.success" in columns else None
    return ConvertedEpisode(obs, columns["action"], rewards, terminated, success)


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
        return zip(*(self._decode(span) for span in self.spans[episode]), strict=False)

    def _decode(self, span: Span) -> Iterator[Frame]:
        """Start half a frame early: the first frame is the one that is not before that."""
        return iter_frames(span.path, max(0.0, span.start - 0.5 / self.fps), span.n_frames)

    def check(self, episodes: Sequence[int]) -> None:
        """Compare the times of all frames with those of the steps; nothing is decoded.

        Raises:
            BadInput: a video is damaged or ends early, or a frame is missing; the message names the episode.
        """
        times_of = functools.lru_cache(maxsize=64)(frame_times)  # a video holds many episodes
        for episode, spans in zip(episodes, self.spans, strict=True):
            for span in spans:
                times = times_of(span.path)
                first = np.searchsorted(times, span.start - 0.5 / self.fps)
                shown = times[first : first + span.n_frames]
                late = np.abs(shown - span.start - np.arange(len(shown)) / self.fps) > 0.75 / self.fps
                if len(shown) < span.n_frames or late.any():
                    step = int(np.argmax(late)) if late.any() else len(shown)
                    raise BadInput(
                        f"{span.path} has no frame for step {step} of episode {episode}, at "
                        f"{span.start + step / self.fps:.3f} s: {len(times)} frames until {times[-1]:.3f} s, and "
                        f"info.json says {self.fps:g} per second; download the dataset again"
                    )


@functools.cache
def _hash_video(path: Path) -> str:
    return artifacts.hash_file(path)  # cached, since a video holds many episodes


def is_lerobot(folder: Path) -> bool:
    """Whether a folder has the layout of a LeRobot dataset of any version."""
    return (folder / INFO).is_file()


def open_lerobot(
    root: Path, keys: Sequence[str], *, with_frames: bool = True, skip_incomplete: bool = False
) -> tuple[ConvertedTrajectories, Videos | ParquetPictures | None]:
    """Open a LeRobot folder.

    Args:
        root: the folder.
        keys: features that are the frames, one per view; empty: the only video or picture.
        with_frames: False where the frames are elsewhere.
        skip_incomplete: leave out episodes without steps, and those whose files are missing; a `Notice` names them.

    Returns:
        The episodes; and their frames, None without any or without `with_frames`.

    Raises:
        BadInput: another version, pyarrow is not installed, a file is missing or damaged, a video does not show every
            step, or the choice of frames is ambiguous.
    """
    root = root.resolve()
    info = Info.read(root)
    views, are_videos = info.choose_views(keys, root) if with_frames else ([], False)
    columns = info.columns(root)
    listed = complete_episodes(root, read_listing(root, info, views if are_videos else []), skip_incomplete)
    by_file = groupby(listed, lambda episode: episode.data)
    files = tuple((file, tuple(episode.number for episode in episodes)) for file, episodes in by_file)
    for path in {root / name for e in listed for name in (e.data, *(name for name, _ in e.videos))}:
        check_file(path)
    n_steps = tuple(episode.n_steps for episode in listed)
    n_listed = Counter[str]()
    for episode in listed:
        n_listed[episode.data] += episode.n_steps
    stored = set() if are_videos else set(views)
    for file, n in n_listed.items():
        with open_parquet(root / file, MAX_ROWS) as opened:
            if missing := stored - set(opened.schema_arrow.names):
                raise BadInput(f"{root / file} has no column {min(missing)!r}, as info.json says; download it again")
            if opened.metadata.num_rows < n:
                raise BadInput(
                    f"{root / file} has {opened.metadata.num_rows} rows, but meta/episodes lists {n} of them; download "
                    "the dataset again"
                )
    n_bytes = 4 * sum((root / file).stat().st_size for file, _ in files)  # parquet compresses by less than that
    read = partial(read_episodes, root, files, n_steps, columns)
    names = tuple(str(episode.number) for episode in listed)
    trajectories = ConvertedTrajectories(root, "LeRobot", names, n_steps, n_bytes, read, info.fps)
    if not views:
        return trajectories, None
    if not are_videos:
        return trajectories, ParquetPictures(tuple(views), tuple((root / e.data, e.number) for e in listed))
    spans = tuple(tuple(Span(root / name, start, e.n_steps) for name, start in e.videos) for e in listed)
    videos = Videos(tuple(views), info.fps, spans)
    videos.check([episode.number for episode in listed])
    return trajectories, videos
