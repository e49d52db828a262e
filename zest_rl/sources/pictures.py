"""Pictures in the HDF5 files of the episodes: Minari's image observations, robomimic's ``*_image``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from zest_rl.data.hdf5 import open_hdf5
from zest_rl.data.observations import ROWS, entries, n_channels, read_pictures, stored_rows
from zest_rl.runtime import artifacts
from zest_rl.types import Frame


@dataclass(frozen=True)
class Pictures:
    """`EpisodeFrames` that are stored in one HDF5 file, one group per episode."""

    file: Path
    episodes: tuple[str, ...]
    """Groups of the episodes."""
    views: tuple[str, ...]
    """Paths of the entries within a group, one per view."""
    lasts: tuple[str, ...] = ()
    """Paths of entries whose last row is x_T, one per view, where `views` end with x_{T-1}."""

    def describe(self) -> dict[str, Any]:
        """The entries that are the frames."""
        return {"kind": "pictures", "views": list(self.views), "last_frame_from": list(self.lasts)}

    def digest(self, episode: int) -> str:
        """Hash the stored rows."""
        with open_hdf5(self.file) as file:
            group = file[self.episodes[episode]]
            parts = (part for view in self.views for part in stored_rows(group[view]))
            lasts = (group[last][-1:] for last in self.lasts)
            return artifacts.hash_json([artifacts.hash_stream(rows) for rows in (parts, lasts)])

    def read(self, episode: int) -> Iterator[Sequence[Frame]]:
        """Yield the views of each step."""
        with open_hdf5(self.file) as file:
            group = file[self.episodes[episode]]
            for start in range(0, len(group[self.views[0]]), ROWS):
                rows = slice(start, start + ROWS)
                yield from zip(*(read_pictures(group[view], rows) for view in self.views), strict=True)
            if self.lasts:
                yield [read_pictures(group[last], slice(-1, None))[0] for last in self.lasts]


def picture_entries(file: Path, group: str) -> dict[str, int | None]:
    """Return the `n_channels` of all entries below a group."""
    with open_hdf5(file) as opened:
        return {name: n_channels(entry) for name, entry in entries(opened[group]).items()}
