"""Real commands in little memory: each ends with a message and exit code 1, none with a signal."""

from __future__ import annotations

import resource
import subprocess
from pathlib import Path

import pytest
from processes import ZEST

GB = 2**30


@pytest.mark.parametrize("n_workers", ["1", "2"])
def test_relabeling_in_little_memory_says_what_it_needs(n_workers: str, collected: str) -> None:
    code, message = run("relabel", collected, "--views", "1", "--n-workers", n_workers)
    assert code == 1
    assert message.startswith("error: GL needs 2 GB of address space and crashes with less, and this shell allows a")
    assert "process 1.0 GB; raise the limit (ulimit -v unlimited)" in message


@pytest.mark.parametrize("verb", ["train", "evaluate"])
def test_training_and_evaluating_in_little_memory_say_so(verb: str, trained: Path, collected: str) -> None:
    words = {"train": ["bc", collected, "--run-dir", str(trained / "new")], "evaluate": [str(trained / "bc-0")]}
    code, message = run(verb, *words[verb])
    assert code == 1
    assert "the memory does not suffice" in message
    assert "raise the limit (ulimit -v)" in message


def test_doctor_names_the_limit() -> None:
    code, message = run("doctor")
    assert code == 1
    assert "fail  limits" in message
    assert "ulimit -v unlimited, or ask the cluster for more memory" in message


def run(*words: str, n_bytes: int = GB) -> tuple[int, str]:
    done = subprocess.run(
        [*ZEST, *words],
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (n_bytes, n_bytes)),
    )
    return done.returncode, "\n".join(
        line for line in (done.stderr + done.stdout).splitlines() if not line.startswith("checking")
    )
