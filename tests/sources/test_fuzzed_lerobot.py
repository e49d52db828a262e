"""Damaged LeRobot folders: read or refused, never a crash, a hang or an error of Arrow."""

from __future__ import annotations

import json
import random
import shutil
from pathlib import Path

import pytest
from fuzzing import damaged_bytes, damaged_json, faults, outcomes
from lerobot_files import store_pictures, write_lerobot
from rollouts import Episode

from zest_rl.sources import open_source

FILES = {
    "info": "meta/info.json",
    "listing": "meta/episodes/chunk-000/file-000.parquet",
    "data": "data/chunk-000/file-000.parquet",
    "video": "videos/observation.images.top/chunk-000/file-000.mp4",
}


@pytest.fixture(scope="module")
def root(maze: list[Episode], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_lerobot(tmp_path_factory.mktemp("whole") / "pusht", maze)


@pytest.fixture(scope="module")
def pictured(root: Path, maze: list[Episode]) -> Path:
    """The same with pictures in the data files."""
    copy = shutil.copytree(root, root.parent / "pictured")
    store_pictures(copy, maze)
    return copy


@pytest.mark.parametrize("n", [20, pytest.param(500, marks=pytest.mark.slow)])
@pytest.mark.parametrize("what", ["info as JSON", *FILES, "data with pictures"])
def test_damaged_lerobot_folders_are_read_or_refused(what: str, n: int, root: Path, pictured: Path) -> None:
    root, rng = pictured if what == "data with pictures" else root, random.Random(what)
    path = root / FILES[what.split()[0]]
    whole = path.read_bytes()

    def read(data: bytes) -> list[str]:
        path.write_bytes(data)
        source = open_source(str(root))
        return [source.trajectories.fingerprint(), *(str(len(list(source.frames.read(i)))) for i in range(2))]

    def damaged() -> bytes:
        if what == "info as JSON":
            return json.dumps(damaged_json(json.loads(whole), rng)).encode()
        return damaged_bytes(whole, rng)

    inputs = [damaged() for _ in range(n)]
    counts, wrong = faults(outcomes(lambda i: read(inputs[i]), n))
    path.write_bytes(whole)
    print(f"LeRobot {what}: {n} inputs, {dict(counts)}")
    assert not wrong, wrong[0]
    assert counts["refused"]
