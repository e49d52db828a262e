from __future__ import annotations

import os
import random
import signal
from collections.abc import Callable
from typing import Any

import fuzzing
import pytest
from fuzzing import damaged_bytes, damaged_json, faults, outcome

from zest_rl.errors import BadInput


def refuse() -> None:
    raise BadInput("no")


def loop() -> None:
    while True:
        pass


@pytest.mark.parametrize(
    ("read", "kind"),
    [
        (lambda: 1, "read"),
        (refuse, "refused"),
        (lambda: {}["x"], "unexpected"),
        (lambda: bytes(2 * fuzzing.MEMORY), "unexpected"),
        (lambda: os.kill(os.getpid(), signal.SIGSEGV), "crashed"),
        (loop, "hung"),
    ],
)
def test_every_end_of_a_read_is_told(read: Callable[[], Any], kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuzzing, "LIMIT", 2.0)
    found = outcome(read)
    assert found.kind == kind
    assert faults([found])[1] == ([] if kind in ("read", "refused") else [found])


def test_damage_changes_the_input_alike_for_one_seed() -> None:
    data, value = bytes(range(256)), {"a": [1, {"b": 2}]}
    assert len({damaged_bytes(data, random.Random(seed)) for seed in range(50)}) > 40
    assert damaged_bytes(data, random.Random(7)) == damaged_bytes(data, random.Random(7))
    assert sum(damaged_json(value, random.Random(seed)) != value for seed in range(50)) > 40
    assert value == {"a": [1, {"b": 2}]}
