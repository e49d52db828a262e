"""Kills at every operation on files, and at every message to another process: the same bits, and no litter."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = Path(__file__).with_name("kills.py")
QUICK = {"train dt": 40, "export torchrl 1": 6}
SLOW = {
    **dict.fromkeys(("train bc", "train dt", "torchrun bc 0", "torchrun bc 1", "torchrun dt 0", "torchrun dt 1"), 1),
    **{"evaluate": 1, "adopt": 1, "collect 0": 5, "collect 1": 1, "relabel 0": 2, "relabel 1": 1},
    **dict.fromkeys(("export npz 0", "export torchrl 0", "export torchrl 1"), 1),
}
"""What is killed, and at every how many operations: a collection takes seconds."""


@pytest.mark.parametrize(
    ("scenario", "stride"),
    [
        *QUICK.items(),
        *(pytest.param(*scenario, marks=pytest.mark.slow) for scenario in SLOW.items()),
    ],
)
def test_what_is_killed_anywhere_and_done_again_ends_as_if_nothing_had_cut_it(
    scenario: str, stride: int, tmp_path: Path
) -> None:
    command = [sys.executable, "-W", "ignore", str(PROGRAM), scenario, str(tmp_path), str(stride)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    print(f"{scenario}: {told['kills']} kills")
    assert told["wrong"] == []
    assert told["kills"] > 1
