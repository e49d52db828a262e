"""The command and the function that collect a dataset, uncut and killed."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from read_dataset import read

from zest_rl.cli import main
from zest_rl.data import reader
from zest_rl.data.folders import MANIFEST_FILE, METADATA_FILE
from zest_rl.data.reader import Dataset
from zest_rl.errors import BadInput
from zest_rl.kitchen.collect import collect_dataset
from zest_rl.kitchen.collect_config import CollectConfig
from zest_rl.runtime import artifacts


@pytest.fixture(autouse=True)
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "cache"))


SMALL = (
    ("zest_rl.kitchen.calibration", "N_REFERENCE", 2),
    ("zest_rl.kitchen.calibration", "N_NOTHING", 1),
    ("zest_rl.kitchen.behaviour", "EPISODES_PER_JOB", 1),
)
WORDS = ["collect", "--task", "micro", "--n-episodes", "3", "--noise-max", "0.5", "--n-workers", "1", "--json"]
DATASET = "zest/kitchen-micro-noisy-v0"


def zest(words: list[str]) -> tuple[int, dict[str, Any], str]:
    """Run the command in this process: exit code, result, what it told on the way."""
    out, err = StringIO(), StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = main(words)
    return code, json.loads(out.getvalue()), err.getvalue()


def collect_into(folder: Path, patch: pytest.MonkeyPatch, *more: str) -> dict[str, Any]:
    for module, name, value in SMALL:
        patch.setattr(f"{module}.{name}", value)
    patch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    patch.setenv("ZEST_CACHE", str(folder / "cache"))
    code, result, err = zest([*WORDS, *more])
    assert code == 0, err
    return result


@pytest.fixture(scope="module")
def uncut(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Folder and result of a command that nothing interrupted."""
    folder = tmp_path_factory.mktemp("uncut")
    with pytest.MonkeyPatch.context() as patch:
        return folder, collect_into(folder, patch)


def parts(cache: Path) -> list[Path]:
    """Return the finished parts of the dataset's own episodes, not those of the references."""
    return list(cache.glob("episodes/*/episodes-?-?.npz"))


def test_the_command_tells_what_it_made(uncut: tuple[Path, dict[str, Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    folder, result = uncut
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    assert (result["dataset"], result["path"]) == (DATASET, str(folder / "minari" / DATASET))
    assert result["next"] == f"zest relabel {DATASET} --goal same-scene"
    assert (result["n_episodes"], result["noise_max"]) == (3, 0.5)
    truths = read(DATASET, Dataset.truth)
    assert result["n_failed"] == sum(not truth.success for truth in truths)
    span = result["expert_return"] - result["minimum_return"]
    mean = np.mean([100 * (truth.episode_return - result["minimum_return"]) / span for truth in truths])
    estimate = result["normalized_return"]
    assert estimate["value"] == pytest.approx(mean)
    assert estimate["low"] <= mean <= estimate["high"]
    metadata = read(DATASET, lambda ds: ds.metadata)
    assert (metadata["ref_min_score"], metadata["ref_max_score"]) == (result["minimum_return"], result["expert_return"])
    assert metadata["zest"]["collect"]["asked"]["noise_max"] == 0.5
    assert not parts(folder / "cache")


def test_a_dataset_of_an_expert_by_rl_says_so_and_one_of_a_script_is_recorded_as_ever(
    uncut: tuple[Path, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = collect_into(tmp_path, monkeypatch, "--expert", "rl", "--task", "sdoor")
    metadata = read(made["dataset"], lambda ds: ds.metadata)
    assert metadata["zest"]["collect"]["asked"]["expert"] == "rl"
    assert metadata["algorithm_name"] == "imperfect randomized expert found by soft actor-critic"
    assert "by a randomized expert found by soft actor-critic with noise_max 0.5 (" in metadata["description"]
    assert made["expert_success"] == 1
    code, refused, _ = zest([*WORDS, "--task", "sdoor"])
    assert (code, "was collected with other arguments" in refused["error"]["message"]) == (2, True)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(uncut[0] / "minari"))
    assert "expert" not in read(DATASET, lambda ds: ds.metadata)["zest"]["collect"]["asked"]


def test_the_command_typed_again_does_nothing_and_refuses_other_arguments(
    uncut: tuple[Path, dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, result = uncut
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    file = reader.dataset_path(DATASET) / reader.DATA_FILE
    before = file.stat().st_mtime_ns
    code, again, err = zest(WORDS)
    assert (code, again) == (0, result)
    assert f"{DATASET} is there already, nothing to do" in err
    calibrated = ["calibrate" if word == "0.5" else word for word in WORDS]
    level = str(result["normalized_return"]["value"])
    assert zest([*calibrated, "--level", level])[:2] == (0, result), "it is what calibration to this level would give"
    assert zest(calibrated)[0] == 2
    code, refused, _ = zest([*WORDS, "--seed", "1"])
    assert code == 2
    assert refused["error"]["type"] == "BadInput"
    assert f"dataset {DATASET} exists and was collected with other arguments" in refused["error"]["message"]
    assert file.stat().st_mtime_ns == before


def test_the_library_does_what_the_command_does(
    uncut: tuple[Path, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, result = uncut
    for module, name, value in SMALL:
        monkeypatch.setattr(f"{module}.{name}", value)
    config = CollectConfig("micro", 3, noise_max=0.5)
    parts_done: list[tuple[int, int]] = []
    sentences: list[str] = []
    made = collect_dataset(config, n_workers=1, on_progress=lambda *p: parts_done.append(p), on_result=sentences.append)
    assert (made.dataset_id, made.path, made.already_there) == (DATASET, tmp_path / "minari" / DATASET, False)
    assert made.result == {key: result[key] for key in made.result}
    assert parts_done == [(n, 6) for n in range(1, 7)]
    assert [sentence.split(":")[0] for sentence in sentences] == ["expert", f"writing {made.path}"]
    described = read(DATASET, Dataset.describe)
    again = collect_dataset(config)
    assert (again.already_there, again.result) == (True, made.result)
    metadata = artifacts.read_json(made.path / METADATA_FILE)
    del metadata["zest"]["collect"]["result"]["noise_max"]
    (tmp_path / "damaged/zest").mkdir(parents=True)
    damaged = shutil.copytree(made.path, tmp_path / "damaged" / DATASET)
    artifacts.write_json(damaged / METADATA_FILE, metadata)
    (damaged / MANIFEST_FILE).unlink()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "damaged"))
    with pytest.raises(BadInput, match=r"as this package writes it \(KeyError: 'noise_max'\); choose another id"):
        collect_dataset(config)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    assert described == read(DATASET, Dataset.describe)


@pytest.mark.parametrize(
    ("words", "rule"),
    [
        (["--n-episodes", "0"], "n-episodes must be at least 1, got 0"),
        (["--n-episodes", "100000000000000"], "n-episodes must be at most 1000000, got 100000000000000"),
        (["--task", "mirco"], "unknown task 'mirco'; did you mean 'micro'?"),
        (["--noise-max", "3"], "noise_max must be in [0, 2.0]"),
        (["--seed", "-1"], "seed must be 0 or positive, got -1"),
        (["--dataset", "../x-v0"], "a dataset id must look like"),
        (["--stop-share", "calibrate"], "one number can be calibrated, got noise_max and stop_share"),
        (["--noise-max", "high"], "--noise-max"),
    ],
)
def test_bad_arguments_end_with_exit_code_2_before_any_episode(words: list[str], rule: str, tmp_path: Path) -> None:
    code, result, _ = zest(["collect", "--n-workers", "1", "--json", *words])
    assert code == 2
    assert rule in result["error"]["message"]
    assert not (tmp_path / "minari").exists()
    assert not list(tmp_path.rglob("*.npz"))


def start(*words: str) -> subprocess.Popen[str]:
    code = (
        "import importlib, sys; from zest_rl.cli import main\n"
        f"for module, name, value in {SMALL}: setattr(importlib.import_module(module), name, value)\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", code, *WORDS, *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize("other", [DATASET, "zest/kitchen-micro-other-v0"], ids=["one-dataset", "the-same-episodes"])
def test_two_commands_at_once_do_the_work_once_and_both_end_well(
    other: str, uncut: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    commands = [start("--dataset", dataset_id) for dataset_id in (DATASET, other)]
    told = [command.communicate(timeout=240) for command in commands]
    assert [command.returncode for command in commands] == [0, 0], told
    assert sum("is there already" in err for _, err in told) == (other == DATASET)
    figures = {"normalized_return", "expert_return", "minimum_return", "n_failed", "noise_max"}
    for out, _ in told:
        assert {name: json.loads(out)[name] for name in figures} == {name: uncut[1][name] for name in figures}
    assert not parts(tmp_path / "cache"), "nothing is left of finished parts"


def test_a_killed_command_goes_on_where_it_stopped_and_ends_with_the_same_dataset(
    tmp_path: Path, uncut: tuple[Path, dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    command = start()
    while not parts(tmp_path / "cache"):
        assert command.poll() is None
        time.sleep(0.02)
    command.send_signal(signal.SIGKILL)
    command.communicate()
    assert reader.list_datasets() == []
    assert len(parts(tmp_path / "cache")) < 3
    references = {path: path.stat().st_mtime_ns for path in tmp_path.glob("cache/episodes/*/episodes-2147*.npz")}
    assert len(references) == 3

    result = collect_into(tmp_path, monkeypatch)
    assert {path: path.stat().st_mtime_ns for path in references} == references
    resumed = read(DATASET, Dataset.describe)
    folder, uncut_result = uncut
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    assert resumed == read(DATASET, Dataset.describe)
    assert {**result, "path": None} == {**uncut_result, "path": None}
