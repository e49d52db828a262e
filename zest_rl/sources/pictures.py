"""Pictures in the HDF5 files of the episodes: Minari's image observations, robomimic's ``*_image``."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from zest_rl.data.hdf5 import check_stored, open_hdf5
from zest_rl.data.observations import entries, stored_rows
from zest_rl.data.picture_forms import ROWS, PictureForm, form_of, read_pictures
from zest_rl.runtime import artifacts
from zest_rl.types import Frame


@dataclass(frozen=True)
class Pictures:
    """`EpisodeFrames` that are stored in one HDF5 file, one group per episode."""

    file: Path
    episodes: tuple[str, ...]
    """Groups of the episodes."""
    views: tuple[str, ...]
    """Paths of the entries within a group, one per view; ``KEY[i]`` is one of the pictures in each step of KEY."""
    lasts: tuple[str, ...] = ()
    """Paths of entries whose last row is x_T, one per view, where `views` end with x_{T-1}."""

    def describe(self) -> dict[str, Any]:
        """The entries that are the frames."""
        return {"kind": "pictures", "views": list(self.views), "last_frame_from": list(self.lasts)}

    def digest(self, episode: int) -> str:
        """Hash the stored rows, and what is black and white of floats that are not in [0, 1]."""
        with open_hdf5(self.file) as file:
            group = file[self.episodes[episode]]

            def stored(path: str, *, is_last: bool = False) -> Iterator[NDArray[Any]]:
                name, part = split_part(path)
                check_stored(group[name])
                blocks = [group[name][-1:]] if is_last else stored_rows(group[name])
                return (block if part is None else block[:, part] for block in blocks)

            views = (block for view in self.views for block in stored(view))
            lasts = (block for last in self.lasts for block in stored(last, is_last=True))
            ranges = [
                (f.low, f.high) for f in self._forms() if f.dtype.startswith("float") and (f.low, f.high) != (0, 1)
            ]
            return artifacts.hash_json([*(artifacts.hash_stream(rows) for rows in (views, lasts)), *ranges])

    def read(self, episode: int) -> Iterator[Sequence[Frame]]:
        """Yield the views of each step."""
        forms = self._forms()
        with open_hdf5(self.file) as file:
            group = file[self.episodes[episode]]

            def frames(path: str, form: PictureForm, rows: slice) -> list[Frame]:
                name, part = split_part(path)
                return read_pictures(group[name], rows, form, part)

            for start in range(0, len(group[split_part(self.views[0])[0]]), ROWS):
                rows = slice(start, start + ROWS)
                yield from zip(*(frames(*view, rows) for view in zip(self.views, forms, strict=True)), strict=True)
            if self.lasts:
                yield [frames(*last, slice(-1, None))[0] for last in zip(self.lasts, forms, strict=True)]

    def _forms(self) -> tuple[PictureForm, ...]:
        """Return the forms of the views in the first episode."""
        return _forms(self.file, self.file.stat().st_mtime_ns, self.episodes[0], self.views)


@functools.lru_cache(maxsize=16)
def _forms(file: Path, changed: int, episode: str, views: tuple[str, ...]) -> tuple[PictureForm, ...]:
    with open_hdf5(file) as opened:
        return tuple(form_of(opened[episode][split_part(view)[0]]) for view in views)


def split_part(path: str) -> tuple[str, int | None]:
    """Split ``KEY[i]`` into the entry's path and the index of the picture in each of its steps, None without."""
    match = re.fullmatch(r"(.*)\[(\d+)\]", path)
    return (path, None) if match is None else (match[1], int(match[2]))


def picture_entries(file: Path, group: str) -> dict[str, PictureForm]:
    """Return the forms of all entries below a group; of cameras or stacked frames in one entry as ``KEY[i]`` each."""
    forms = dict[str, PictureForm]()
    with open_hdf5(file) as opened:
        for name, entry in entries(opened[group]).items():
            form = form_of(entry)
            forms |= {f"{name}[{part}]": form for part in range(form.n_parts)} if form.n_parts else {name: form}
    return forms
