"""Which code made a cell: hashes of the sources that policies and their evaluations depend on, kept beside the cells.

``OUTPUT/code/NAME.json`` lists every code that worked on the training of a run, or on the evaluation of a cell: more
than one where the package changed between an interruption and the command that went on.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

from zest_rl.cli.ui import shortened
from zest_rl.runtime import artifacts

ROOMS = (
    "types.py",
    "data",
    "simulation",
    "kitchen",
    "embedders",
    "rewards",
    "agents",
    "training",
    "evaluation",
    "online",
)
"""What a policy and its returns depend on. ``runtime`` decides where the work runs and how it is kept, ``metrics`` and
``report`` what is made of finished cells, and relabeled rewards are in a cell's identity themselves. Versions of other
packages are not recorded here; a run's ``meta.json`` has them."""


@dataclass(frozen=True)
class Code:
    """The sources of `ROOMS` at one time."""

    files: Mapping[str, str]
    """Path below the package → sha256."""
    git_revision: str | None

    @property
    def sha256(self) -> str:
        """Of all files; two revisions that differ elsewhere alone have the same."""
        return artifacts.hash_json(dict(self.files))


class Cell(Protocol):
    """What this module needs to know of `zest_rl.cli.reproduce.cells.Cell`, which imports it."""

    @property
    def name(self) -> str:
        """Of the cell."""

    @property
    def run(self) -> Path:
        """Folder of its policy."""

    @property
    def code_records(self) -> tuple[Path, Path]:
        """Of its training, which cells may share, and of its evaluation."""


@functools.cache
def code_now() -> Code:
    """Return the code of this process, as it was when this was first called."""
    package = Path(__file__).resolve().parents[2]
    found = (path for room in ROOMS for path in [package / room, *(package / room).rglob("*.py")] if path.is_file())
    files = {path.relative_to(package).as_posix(): artifacts.hash_file(path) for path in sorted(found)}
    return Code(files, artifacts.git_revision())


def record(path: Path, made: Path) -> None:
    """Add this process's code to those that worked on `made`; on what is not there yet, none has."""
    before = _recorded(path) if made.exists() else []
    if all(code.sha256 != code_now().sha256 for code in before):
        artifacts.write_json(path, [asdict(code) for code in (*before, code_now())])


def _recorded(path: Path) -> list[Code]:
    return [Code(**code) for code in artifacts.read_json(path)] if path.exists() else []


def codes_of(cell: Cell) -> list[Code]:
    """Return all codes that worked on a cell; none where versions made it that recorded none."""
    training, evaluation = map(_recorded, cell.code_records)
    return list({code.sha256: code for code in training + evaluation}.values()) if training and evaluation else []


def is_outdated(cell: Cell) -> bool:
    """Whether code different from this process's worked on a cell, or unknown code."""
    return [code.sha256 for code in codes_of(cell)] != [code_now().sha256]


def describe(cells: Iterable[Cell]) -> dict[str, Any]:
    """Return as JSON the code of now, the codes that worked on the cells, and which cells these are where it differs.

    A cell counts for each code that worked on it; unknown code has no hash, and the revisions that its files name.
    """
    now, outdated = code_now(), []
    made_by: dict[str | None, dict[str, Any]] = {}
    for cell in cells:
        codes = codes_of(cell)
        if is_outdated(cell):
            outdated.append(cell.name)
        known = ((code.sha256, code.git_revision, _changed(code.files, now.files)) for code in codes)
        for sha256, revision, changed in known if codes else [(None, _revision_of_run(cell.run), None)]:
            entry = made_by.setdefault(
                sha256, {"source_sha256": sha256, "git_revisions": [], "n_cells": 0, "changed_files": changed}
            )
            entry["n_cells"] += 1
            entry["git_revisions"] = sorted({*entry["git_revisions"], *([revision] if revision else [])})
    return {
        "source_sha256": now.sha256,
        "git_revision": now.git_revision,
        "made_by": list(made_by.values()),
        "outdated_cells": outdated,
    }


def _revision_of_run(run: Path) -> str | None:
    revision: str | None = artifacts.read_json(run / "meta.json").get("made_by", {}).get("git_revision")
    return revision


def _changed(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    return sorted(path for path in before.keys() | now.keys() if before.get(path) != now.get(path))


def caveats(code: Mapping[str, Any], n_cells: int) -> list[str]:
    """Return the report's caveat about the outdated cells that `describe` found; none if there is none."""
    outdated: Sequence[str] = code["outdated_cells"]
    if not outdated:
        return []
    others = [made for made in code["made_by"] if made["source_sha256"] != code["source_sha256"]]
    changed = sorted({path for made in others for path in made["changed_files"] or []})
    reasons = [f"changed since: {shortened(changed)}"] if changed else []
    reasons += ["a version that did not record it"] if any(made["source_sha256"] is None for made in others) else []
    return [
        f"Of {n_cells} cells {len(outdated)} were made by different code ({'; '.join(reasons)}): "
        f"{shortened(outdated)}. The same command with --rerun-outdated deletes them and runs them again."
    ]
