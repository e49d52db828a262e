"""The processes here are real ones, started by ``torchrun``."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from zest_rl.errors import BadInput
from zest_rl.training.distributed import Group, launched
from zest_rl.training.loop import training_device

BIN = Path(sys.executable).parent
SMALL = ["--hidden-size", "32", "--n-layers", "1", "--threads", "1", "--amp", "fp32", "--device", "cpu"]


def command(n_processes: int, *words: object) -> list[str]:
    zest = [str(BIN / "zest"), "train", *map(str, words), *SMALL]
    return [str(BIN / "torchrun"), "--standalone", f"--nproc-per-node={n_processes}", "--no-python", *zest]


def run(n_processes: int, *words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(n_processes, *words), capture_output=True, text=True, timeout=300)


def weights(run_dir: Path) -> dict[str, np.ndarray]:
    return load_file(run_dir / "model.safetensors")


@pytest.mark.parametrize(
    ("agent", "n_networks"),
    [pytest.param("bc", 1, marks=pytest.mark.slow), pytest.param("dt", 1, marks=pytest.mark.slow), ("rvs", 2)],
)
def test_two_processes_train_what_one_does(agent: str, n_networks: int, collected: str, tmp_path: Path) -> None:
    words = [
        agent,
        collected,
        "--n-networks",
        n_networks,
        "--n-updates",
        20,
        "--warmup-updates",
        0,
        "--batch-size",
        33,
        "--dropout",
        0,
        "--json",
    ]
    two = run(2, *words, "--run-dir", tmp_path / "two")
    assert two.returncode == 0, two.stderr
    assert json.loads(two.stdout)["n_updates"] == 20, "one document, from the first process"
    one = run(1, *words, "--run-dir", tmp_path / "one")
    assert one.returncode == 0, one.stderr
    expected, got = weights(tmp_path / "one"), weights(tmp_path / "two")
    assert got.keys() == expected.keys()
    for name, tensor in got.items():
        np.testing.assert_allclose(tensor, expected[name], atol=1e-5, err_msg=name)
    assert json.loads((tmp_path / "two/meta.json").read_text())["n_processes"] == 2
    assert "n_processes" not in json.loads((tmp_path / "one/meta.json").read_text())
    losses = [(tmp_path / name / "metrics.csv").read_text().splitlines()[-1].split(",")[1] for name in ("one", "two")]
    assert float(losses[0]) == pytest.approx(float(losses[1]), rel=1e-5)


@pytest.mark.slow
def test_a_run_of_two_that_was_killed_goes_on_and_ends_as_one_that_was_not(collected: str, tmp_path: Path) -> None:
    words = ["bc", collected, "--n-updates", 600, "--batch-size", 64, "--dropout", 0.1, "--checkpoint-every", 20]
    cut = tmp_path / "cut"
    process = subprocess.Popen(command(2, *words, "--run-dir", cut), stderr=subprocess.PIPE)
    deadline = time.monotonic() + 240
    while len(list(cut.glob("checkpoints/update-*"))) < 2:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.terminate()  # torchrun ends those that it started
    process.communicate()
    assert not (cut / "meta.json").exists(), "it was killed on its way"
    for folder in (cut, tmp_path / "whole"):
        finished = run(2, *words, "--run-dir", folder)
        assert finished.returncode == 0, finished.stderr
    expected, got = weights(tmp_path / "whole"), weights(cut)
    for name, tensor in got.items():
        np.testing.assert_array_equal(tensor, expected[name], err_msg=name)
    assert not (cut / "checkpoints").exists()


def test_a_batch_that_is_too_small_to_be_shared_is_refused(collected: str, tmp_path: Path) -> None:
    failed = run(2, "bc", collected, "--n-updates", 5, "--batch-size", 1, "--run-dir", tmp_path / "run")
    assert failed.returncode != 0
    assert "the batch size must be at least the number of processes, got 1 for 2" in failed.stderr
    assert not (tmp_path / "run").exists(), "the same folder takes the command with another batch size"


def test_shares_are_all_of_a_batch_and_their_weighted_means_are_its_mean() -> None:
    batch = {"obs": torch.arange(14.0).reshape(7, 2), "valid": torch.arange(14).reshape(7, 2) % 5 > 0}
    shares = [Group(rank, 3).share(batch) for rank in range(3)]
    rows = torch.cat([share["obs"] for share, _ in shares])
    assert sorted(rows[:, 0].tolist()) == batch["obs"][:, 0].tolist()
    masked = [share["obs"][share["valid"]].mean() * weight for share, weight in shares]
    torch.testing.assert_close(torch.stack(masked).mean(), batch["obs"][batch["valid"]].mean())
    del batch["valid"]
    plain = [share["obs"].mean() * weight for share, weight in (Group(rank, 3).share(batch) for rank in range(3))]
    torch.testing.assert_close(torch.stack(plain).mean(), batch["obs"].mean())


def test_alone_nothing_is_shared_or_averaged() -> None:
    batch, gradient = {"obs": torch.arange(3.0)}, torch.ones(3)
    assert Group().share(batch) == (batch, 1.0)
    Group().average([gradient])
    Group().agree(finished=True)
    assert gradient.tolist() == [1, 1, 1]


DISAGREE = """
import torch
from zest_rl.training.distributed import process_group
with process_group(torch.device("cpu")) as group:
    group.agree(finished=False)
    group.agree(updates_done=40 * group.rank)
"""


def test_processes_that_see_different_run_folders_are_refused(tmp_path: Path) -> None:
    (tmp_path / "disagree.py").write_text(DISAGREE)
    words = [BIN / "torchrun", "--standalone", "--nproc-per-node=2", tmp_path / "disagree.py"]
    failed = subprocess.run(list(map(str, words)), capture_output=True, text=True, timeout=300)
    assert failed.returncode != 0
    assert "for the first and number 1, updates_done is 0 and 40; on several machines" in failed.stderr


def test_torchrun_gives_each_process_its_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("RANK", "3"), ("WORLD_SIZE", "4"), ("LOCAL_RANK", "1")):
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert launched() == Group(rank=3, size=4)
    assert not launched().leads
    assert training_device("auto") == training_device("cuda") == torch.device("cuda", 1)
    assert training_device("cpu") == torch.device("cpu")
    with pytest.raises(BadInput, match="each process takes a GPU of its own, got device 'cuda:0'"):
        training_device("cuda:0")
    monkeypatch.setenv("LOCAL_RANK", "2")
    with pytest.raises(BadInput, match=r"device cuda:2 is not there: 2 CUDA devices found; .* fewer processes"):
        training_device("cuda")
