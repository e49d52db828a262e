"""Two equal commands at once: the second says that it waits and on which file, then finds the work done."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from processes import ZEST

from zest_rl.evaluation.evaluate import EvaluationConfig, evaluation_folder
from zest_rl.runtime import artifacts

PART = "seeds-1000000-1000002"
TRAIN = ["--hidden-size", "16", "--n-layers", "1", "--n-updates", "4", "--threads", "1", "--device", "cpu"]


@pytest.mark.parametrize("verb", ["train", "evaluate", "export"])
def test_the_second_command_waits_says_so_and_does_not_do_the_work_again(
    verb: str, trained: Path, tmp_path: Path, zest: Callable[..., dict[str, Any]]
) -> None:
    dataset = artifacts.read_json(trained / "bc-0" / "meta.json")["dataset"]["id"]
    evaluation = evaluation_folder(trained / "bc-0", EvaluationConfig(n_episodes=2))
    words, target, result = {
        "train": (["bc", dataset, "--run-dir", str(tmp_path / "run"), *TRAIN], tmp_path / "run", "model.safetensors"),
        "evaluate": ([str(trained / "bc-0"), "--n-episodes", "2", "--no-videos"], evaluation, f"parts/{PART}.npz"),
        "export": ([dataset, "--output", str(tmp_path / "out.npz")], tmp_path / "out.npz", ""),
    }[verb]  # fmt: skip
    with artifacts.lock(target):
        second = subprocess.Popen([*ZEST, verb, *words], stderr=subprocess.PIPE, text=True)
        assert second.stderr is not None
        waiting = (
            f"waiting for {target.parent}/.{target.name}.lock, which another command holds until {target} is written"
        )
        said = [second.stderr.readline()]
        while waiting not in said[-1]:
            assert said[-1], said
            said.append(second.stderr.readline())
        zest(verb, *words)
    made = (target / result).stat().st_mtime_ns
    _, said_last = second.communicate()
    assert (target / result).stat().st_mtime_ns == made
    if verb == "export":
        assert (second.returncode, "out.npz exists; delete it, or choose another" in said_last) == (2, True)
    else:
        assert second.returncode == 0, said_last


def test_a_reproduction_waits_for_another_of_the_same_folder_and_can_be_interrupted_meanwhile(tmp_path: Path) -> None:
    recipe = artifacts.shipped("eval") / "demo.toml"
    words = ["reproduce", str(recipe), "--output", str(tmp_path / "demo")]
    with artifacts.lock(tmp_path / "demo"):
        second = subprocess.Popen([*ZEST, *words], stderr=subprocess.PIPE, text=True)
        assert second.stderr is not None
        assert f"waiting for {tmp_path}/.demo.lock" in second.stderr.readline()
        second.send_signal(signal.SIGINT)
        assert second.stderr.read() == "interrupted; run the same command again to go on\n"
    assert second.wait() == 130
    assert not (tmp_path / "demo").exists()
