"""`zest_rl.explore`: the page, served by a thread of a program or notebook that goes on meanwhile."""

from __future__ import annotations

import json
import shutil
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from few_states import OPTIONS

import zest_rl
from zest_rl.errors import BadInput


def answer(address: str, path: str, **body: Any) -> Any:
    request = urllib.request.Request(f"{address}{path}", headers={"content-type": "application/json"})
    with urllib.request.urlopen(request, json.dumps(body).encode() if body else None) as response:
        return json.load(response)


def test_the_page_is_served_until_it_is_closed_and_says_what_to_type_in_python(
    collected: str, embedded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(embedded / "cache", tmp_path / "cache")
    monkeypatch.chdir(tmp_path)
    with zest_rl.explore(collected, browser=False, n_workers=1, **OPTIONS) as page:
        assert answer(page.address, "state/0")["ready"] == 4
        (start,) = answer(page.address, "take/0/0/0", view=0)["names"]
        (end,) = answer(page.address, "take/0/0/100", view=0)["names"]
        command = answer(page.address, "goal/0", starts=[start], goals=[end])["command"]
    with pytest.raises(urllib.error.URLError):
        answer(page.address, "state/0")
    assert command.startswith(f"zest_rl.relabel(dataset={collected!r}, ")
    goal = next((tmp_path / "goals").iterdir())
    assert f"goal='goals/{goal.name}'" in command


def test_what_cannot_be_explored_is_refused(collected: str) -> None:
    with pytest.raises(BadInput, match="at least one dataset"):
        zest_rl.explore()
    with pytest.raises(BadInput, match="unknown argument 'view'; did you mean 'views'"):
        zest_rl.explore(collected, view=2)
    with pytest.raises(BadInput, match="unknown embedder"):
        zest_rl.explore(collected, embedder="none")
