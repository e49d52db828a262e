"""Finished pages: the cache keeps hashes of each page and of what it was made from, and what its command printed.

A command finds its page finished while its inputs, this package and those that it uses are as they were, and the page
is as it was left. Anything else makes the page anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from zest_rl.data.folders import CARD_FILE, dataset_path
from zest_rl.data.provenance import DatasetRecord
from zest_rl.errors import ZestError
from zest_rl.runtime import artifacts
from zest_rl.runtime.cache import cache_folder
from zest_rl.runtime.records import reading_record

OF_RUNS = (".json", ".csv", ".npz")
"""Files of a run that a report depends on; its videos are drawn from these."""
OF_THE_PACKAGE = (".py", ".html", ".css", ".js")


class PageRecord:
    """The record of a page in the cache; where the cache cannot be used, there is none."""

    def __init__(self, page: Path, *inputs: Any) -> None:
        """Describe a page by all that it is made from, JSON-ready."""
        package = Path(__file__).resolve().parents[1]
        sources = contents(package, OF_THE_PACKAGE)
        self._page = page
        self._made_from = artifacts.hash_json([str(page), inputs, sources, artifacts.versions()])

    @property
    def _file(self) -> Path:
        return cache_folder("pages") / f"{artifacts.hash_json(str(self._page.absolute()))[:20]}.json"

    def result(self) -> dict[str, Any] | None:
        """Return what the command printed that made the page; None where it is to be made."""
        with suppress(ZestError, OSError), reading_record(self._file):
            kept = artifacts.read_json(self._file)
            if [kept["made_from"], kept["page"]] == [self._made_from, artifacts.hash_file(self._page)]:
                return dict(kept["result"])
        return None

    def keep(self, result: dict[str, Any]) -> dict[str, Any]:
        """Keep that the page is made, and what its command prints, JSON-ready, which is returned."""
        kept = {"made_from": self._made_from, "page": artifacts.hash_file(self._page), "result": result}
        with suppress(ZestError):
            artifacts.write_json(self._file, kept)
        return result


def contents(folder: Path, suffixes: Sequence[str] = ()) -> list[list[str]]:
    """Return path and sha256 of the files below a folder, all or those of some suffixes."""
    found = (path for path in folder.rglob("*") if path.is_file() and (not suffixes or path.suffix in suffixes))
    return [[path.relative_to(folder).as_posix(), artifacts.hash_file(path)] for path in sorted(found)]


def dataset_contents(dataset_id: str) -> list[Any]:
    """Return the files of a dataset by path, size and time of change, without the card that readers may add to.

    Their hashes would take longer than a page where they are large.

    Raises:
        BadInput: the id has not the form of one.
    """
    folder = dataset_path(dataset_id)
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path != folder / CARD_FILE)
    return [dataset_id, [[path.relative_to(folder).as_posix(), *_size_and_time(path)] for path in files]]


def _size_and_time(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_size, status.st_mtime_ns


def runs_contents(runs: Sequence[Path]) -> list[Any]:
    """Return what runs hold, which evaluation of each is the newest, and the datasets that they name.

    Raises:
        BadInput: ``meta.json`` is not as this package writes it.
    """
    held: list[Any] = []
    datasets = set()
    for run in runs:
        if (run / "meta.json").exists():
            with reading_record(run / "meta.json"):
                record = DatasetRecord.of_run(artifacts.read_json(run / "meta.json"))
            datasets |= {record.id, record.source_id}
        results = sorted(run.rglob("result.json"), key=lambda path: path.stat().st_mtime)
        held.append([str(run), contents(run, OF_RUNS), [str(path) for path in results]])
    return [*held, *map(dataset_contents, sorted(datasets))]
