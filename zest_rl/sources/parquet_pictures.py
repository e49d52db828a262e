"""Pictures as PNG or JPEG files in a column of parquet files, as LeRobot keeps features of dtype ``image``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from zest_rl.data.images import decode_image
from zest_rl.errors import BadInput
from zest_rl.runtime import artifacts
from zest_rl.sources.parquet import MAX_ROWS, open_parquet
from zest_rl.types import Frame


@dataclass(frozen=True)
class ParquetPictures:
    """`EpisodeFrames` of parquet files that hold several episodes each."""

    views: tuple[str, ...]
    """Columns."""
    episodes: tuple[tuple[Path, int], ...]
    """The file of each episode, and its ``episode_index``."""

    def describe(self) -> dict[str, Any]:
        """The columns, and the alignment of frames and steps."""
        return {"kind": "pictures", "views": list(self.views), "alignment": "frame t is x_t; x_T repeats x_{T-1}"}

    def digest(self, episode: int) -> str:
        """Hash the picture files."""
        return artifacts.hash_json([[artifacts.hash_bytes(file) for file in files] for files in self._files(episode)])

    def read(self, episode: int) -> Iterator[Sequence[Frame]]:
        """Decode all views in step."""
        path, number = self.episodes[episode]
        for step, files in enumerate(zip(*self._files(episode), strict=True)):
            where = f"at step {step} of episode {number} in {path}"
            yield [decode_image(file, f"{view} {where}") for view, file in zip(self.views, files, strict=True)]

    def _files(self, episode: int) -> list[list[bytes]]:
        """Read the picture files of an episode, per view and step."""
        path, number = self.episodes[episode]
        files: list[list[bytes]] = [[] for _ in self.views]
        with open_parquet(path, MAX_ROWS) as file:
            for group in range(file.num_row_groups):
                numbers = file.read_row_group(group, columns=["episode_index"])["episode_index"].to_pylist()
                if number not in numbers:
                    continue
                table = file.read_row_group(group, columns=list(self.views))
                for view, found in zip(self.views, files, strict=True):
                    rows = table[view].to_pylist()
                    found += [_bytes_of(row) for row, of in zip(rows, numbers, strict=True) if of == number]
        if missing := [view for view, found in zip(self.views, files, strict=True) if b"" in found or not found]:
            raise BadInput(
                f"{missing[0]} of episode {number} in {path} lacks a picture, or names a file elsewhere; store the "
                "pictures themselves"
            )
        return files


def _bytes_of(row: Any) -> bytes:
    """Return the picture file in a row {"bytes", "path"}; empty without any."""
    data = row.get("bytes") if isinstance(row, dict) else None
    return data if isinstance(data, bytes) else b""
