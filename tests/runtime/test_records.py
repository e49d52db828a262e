from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest

from zest_rl.errors import BadInput
from zest_rl.runtime.records import from_json, reading_record


@dataclass(frozen=True)
class Record:
    name: str
    n: int
    share: float = 0.5
    values: tuple[float, ...] = ()
    extra: float | None = None
    kind: Literal["a", "b"] = "a"


def test_a_record_is_built_from_json_with_tuples_for_lists() -> None:
    assert from_json(Record, {"name": "a", "n": 1, "values": [1, 2.5]}) == Record("a", 1, values=(1, 2.5))
    assert from_json(Record, {"name": "a", "n": 1, "share": 1, "extra": None}) == Record("a", 1, 1)


@pytest.mark.parametrize(
    "values",
    [
        {"name": "a"}, {"name": 1, "n": 1}, {"name": "a", "n": 1.0}, {"name": "a", "n": True}, {"name": "a", "n": "1"},
        {"name": "a", "n": 1, "share": float("nan")}, {"name": "a", "n": 1, "share": 10**400}, [],
        {"name": "a", "n": 1, "values": [1, "2"]}, {"name": "a", "n": 1, "values": [float("inf")]},
        {"name": "a", "n": 1, "kind": "c"}, {"name": "a", "n": 1, "kind": []},
        {"name": "a", "n": 1, "other": 2}, {"name": "a", "n": 1, "extra": 10**400},
    ],
)  # fmt: skip
def test_other_keys_types_and_numbers_are_refused_with_the_file(values: dict[str, object]) -> None:
    with (
        pytest.raises(BadInput, match=r"x/meta\.json is not as this package writes it"),
        reading_record(Path("x/meta.json")),
    ):
        from_json(Record, values)
