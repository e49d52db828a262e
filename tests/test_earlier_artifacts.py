"""Datasets and runs that an earlier revision wrote are read as its own: they hold and give the figures of then.

``fixtures/before/files.tar.xz`` holds a Minari root (three episodes of the microwave, and a copy that is relabeled by
the scene itself) and two runs on that copy; ``expected.json`` the commands that made them and their figures.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tarfile
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

FIXTURES = Path(__file__).parent / "fixtures" / "before"
EXPECTED = json.loads((FIXTURES / "expected.json").read_text())
SCORED, RUNS = EXPECTED["scored"], EXPECTED["runs"]
Zest = Callable[..., dict[str, Any]]


def differing_versions(*names: str) -> list[str]:
    versions = EXPECTED["made_with"]["versions"]
    return [name for name in names or versions if version(name) != versions[name]]


def is_the_same_machine() -> bool:
    """Whether floats must agree to the bit: across CPUs and versions they do to some digits."""
    try:
        cpu = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return False
    has_its_name = f": {EXPECTED['made_with']['cpu']}\n" in cpu
    has_avx512 = " avx512f " in cpu  # without, a CPU of the same name sums in another order
    return has_its_name and has_avx512 and not differing_versions()


def close(value: Any, tolerance: float) -> Any:
    """What a figure is compared with."""
    return value if is_the_same_machine() else pytest.approx(value, rel=tolerance, abs=tolerance)


needs_the_renderer = pytest.mark.skipif(
    bool(differing_versions("mujoco", "fast-simplification")),
    reason="scores are of the pinned versions of mujoco and fast-simplification; others are refused",
)


@pytest.fixture
def before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The unpacked files, beside an empty cache."""
    with tarfile.open(FIXTURES / "files.tar.xz") as archive:
        archive.extractall(tmp_path / "before", filter="data")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "before" / "minari"))
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "cache"))
    return tmp_path / "before"


def test_a_collected_dataset_is_found_by_the_command_that_made_it(before: Path, zest: Zest) -> None:
    found = zest("collect", *EXPECTED["collect"]["words"])
    assert {key: value for key, value in found.items() if key not in ("path", "next")} == EXPECTED["collect"]["result"]
    assert not (before.parent / "cache").exists(), "nothing was rolled out"


def test_a_relabeled_dataset_is_exported_to_the_bit(before: Path, zest: Zest, tmp_path: Path) -> None:
    zest("export", SCORED, "--to", "npz", "--output", tmp_path / "data.npz")
    with np.load(tmp_path / "data.npz") as arrays:
        found = {
            name: [arrays[name].dtype.str, list(arrays[name].shape), hashlib.sha256(arrays[name].tobytes()).hexdigest()]
            for name in arrays.files
            if name != "about"
        }
    assert found == EXPECTED["npz"]


def test_a_relabeled_dataset_is_judged_as_it_was(before: Path, zest: Zest, tmp_path: Path) -> None:
    words = ("--output", tmp_path / "page.html", "--n-workers", "1")
    found = zest("inspect", SCORED, *words)["datasets"][SCORED]
    assert found["label"] == EXPECTED["inspect"]["label"]
    assert found["figures"].keys() >= EXPECTED["inspect"]["figures"].keys()
    for name, figure in EXPECTED["inspect"]["figures"].items():
        assert found["figures"][name]["value"] == pytest.approx(figure["value"], abs=1e-6), name
        assert found["figures"][name]["ci95"] == pytest.approx(figure["ci95"], abs=1e-6), name


@needs_the_renderer
def test_the_same_goal_gives_the_same_scores_under_the_same_name(before: Path, zest: Zest) -> None:
    words = EXPECTED["relabel"]["words"]
    there = zest("relabel", *words)
    if is_the_same_machine():  # the name is a hash of the goal's pixels, too
        assert (there["dataset"], there["n_still_frames"]) == (SCORED, None), "it is there already"
    shutil.rmtree(there["path"])
    made = zest("relabel", *words)
    assert made["dataset"] == there["dataset"]
    with h5py.File(Path(made["path"]) / "data" / "main_data.hdf5") as file:
        for i, scores in enumerate(EXPECTED["relabel"]["scores"]):
            np.testing.assert_allclose(file[f"episode_{i}/infos/zest/score"][()], scores, atol=1e-5)
            np.testing.assert_array_equal(file[f"episode_{i}/rewards"], file[f"episode_{i}/infos/zest/score"][1:])


@pytest.mark.parametrize("name", RUNS)
def test_a_finished_run_is_found_by_the_command_that_made_it(name: str, before: Path, zest: Zest) -> None:
    run = before / "runs" / name
    meta, weights = json.loads((run / "meta.json").read_text()), (run / "model.safetensors").read_bytes()
    found = zest("train", *RUNS[name]["train"], "--run-dir", run)
    assert (found["n_params"], found["train_seconds"]) == (meta["n_params"], meta["train_seconds"])
    assert (run / "model.safetensors").read_bytes() == weights


@needs_the_renderer
@pytest.mark.parametrize("name", RUNS)
def test_a_run_acts_and_its_scorer_scores_as_they_did(name: str, before: Path, zest: Zest) -> None:
    run, expected = before / "runs" / name, RUNS[name]
    result = Path(zest("evaluate", run, *expected["evaluate"])["result"])
    found = json.loads(result.read_text(encoding="utf-8"))
    assert found["summary"]["target_return"] == expected["target_return"]
    for episode, then in zip(found["episodes"], expected["episodes"], strict=True):
        assert episode["gt_return"] == close(then["gt_return"], 1e-2)
        assert episode["zest_return"] == close(then["zest_return"], 1e-2)
        assert episode["success"] == then["success"] or not is_the_same_machine()
    (part,) = (result.parent / "parts").glob("*.npz")
    with np.load(part) as arrays:
        assert arrays["qpos"].shape == (2, 101, len(expected["last_qpos"][0]))
        if is_the_same_machine():
            np.testing.assert_array_equal(arrays["qpos"][:, -1], expected["last_qpos"])
