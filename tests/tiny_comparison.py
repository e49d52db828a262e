"""A recipe of `zest reproduce` that is done in seconds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

RECIPE = """
title = "A tiny comparison"
seeds = [0]
caveats = ["Tiny."]
paper_demo = 81.19

[collect]
task = "micro"
n_episodes = 4
noise_max = 1.0
dataset = "zest/kitchen-micro-whole-v0"

[relabel]
views = 1
tolerance = 0.05

[goals.scene]
goal = "same-scene"

[train]
n_updates = 20
hidden_size = 32
n_layers = 1
warmup_updates = 0
log-every = 10
[train.dt]
context_len = 5
snapshot_every = 10

[methods.BC]
agent = "bc"
goal = "scene"
kind = "control"
paper = 80.67

[methods."ZeST+DT"]
agent = "dt"
goal = "scene"

[evaluate]
n_episodes = 2
videos = false
"""


TASK_AND_SIZE = 'task = "micro"\nn_episodes = 4'


def write(folder: Path, text: str) -> Path:
    path = folder / "tiny.toml"
    path.write_text(text)
    return path


def refuse_edited(
    text: str,
    edit: tuple[str, str],
    refusal: Callable[..., tuple[int, str]],
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> tuple[Path, str]:
    """Run a recipe with one edit in an empty folder; return its file, and the words with which it is refused."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    monkeypatch.setenv("ZEST_CACHE", str(folder / "cache"))
    monkeypatch.delenv("ZEST_VISUAL_TASKS", raising=False)
    assert text.count(edit[0]) == 1
    recipe = write(folder, text.replace(*edit))
    code, message = refusal("reproduce", recipe, "--output", folder / "out")
    assert code == 2
    return recipe, message
