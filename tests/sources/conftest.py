"""Rollouts of a maze, goal pictures of it, and a dataset of its pictures."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image
from rollouts import LENGTHS, Episode, roll_out, with_pictures, write_rollouts


@pytest.fixture(scope="package", autouse=True)
def _temporary(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Mazes leave their XML where temporary files are."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", str(tmp_path_factory.mktemp("temporary")))
        yield


@pytest.fixture(scope="package")
def maze() -> list[Episode]:
    return roll_out("PointMaze_UMaze-v3", LENGTHS)


@pytest.fixture(autouse=True)
def _places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "cache"))
    (tmp_path / "minari").mkdir()


@pytest.fixture(scope="package")
def goal(maze: list[Episode], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A start and a goal as pictures of the scene."""
    folder = tmp_path_factory.mktemp("goal")
    for part, frame in (("init", maze[1].frames[0]), ("goal", maze[1].frames[-1])):
        (folder / part).mkdir()
        Image.fromarray(frame).save(folder / part / "0.png")
    return folder


@pytest.fixture
def pictured(maze: list[Episode]) -> str:
    """A Minari dataset whose observations hold numbers and two cameras; raw, so that they are exact."""
    return write_rollouts("maze/pictured-v0", maze, with_pictures, jpeg_encoding=False)
