"""What is done already is found done without the packages that would do it."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from zest_rl import train
from zest_rl.evaluation.evaluate import EvaluationConfig, evaluate

Zest = Callable[..., dict[str, Any]]
HEAVY = ("torch", "transformers", "timm", "scipy", "matplotlib", "stable_baselines3")
CODE = f"""
import sys
from zest_rl.cli import main
code = main(sys.argv[1:])
print(code, *sorted(set(sys.modules) & set({HEAVY})), file=sys.stderr)
"""


def run_and_list_imports(*words: str) -> tuple[str, str]:
    """Run ``zest WORDS``; return what it printed, and its exit code and heavy imports."""
    done = subprocess.run([sys.executable, "-c", CODE, *words], capture_output=True, text=True, check=True)
    return done.stdout, done.stderr.splitlines()[-1]


def dataset_of(trained: Path) -> str:
    """Return the relabeled dataset that the policies were trained on."""
    return str(json.loads((trained / "bc-0" / "run.json").read_text())["dataset"]["id"])


def test_a_finished_training_is_found_finished_without_torch(trained: Path) -> None:
    words = ["--n-updates=30", "--hidden-size=32", "--n-layers=1", "--warmup-updates=0", f"--run-dir={trained}/bc-0"]
    printed, imported = run_and_list_imports("train", "bc", dataset_of(trained), *words)
    assert "n_updates: 30" in printed
    assert imported == "0"


def test_a_finished_evaluation_is_found_finished_without_torch(trained: Path) -> None:
    evaluate(trained / "bc-0", EvaluationConfig(n_episodes=1), n_workers=1)
    printed, imported = run_and_list_imports("evaluate", f"{trained}/bc-0", "--n-episodes=1", "--no-videos")
    assert "n_episodes: 1" in printed
    assert imported == "0"


def test_a_finished_training_in_the_environment_is_found_finished_without_torch(trained: Path) -> None:
    small = {"start_updates": 2, "hidden_size": 8, "n_layers": 1, "batch_size": 8, "n_envs": 1, "n_steps": 4}
    run = train("sac", dataset_of(trained), run_dir=trained / "sac", device="cpu", threads=1, **small)
    left = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    flags = [f"--{name.replace('_', '-')}={value}" for name, value in small.items()]
    printed, imported = run_and_list_imports("train", "sac", dataset_of(trained), *flags, f"--run-dir={run}")
    assert "agent: sac" in printed
    assert imported == "0"
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == left


def test_a_finished_inspection_is_found_finished(trained: Path, tmp_path: Path, zest: Zest) -> None:
    page = tmp_path / "page.html"
    words = ["inspect", dataset_of(trained), "--output", str(page)]
    made, written = zest(*words), page.stat().st_mtime_ns
    printed, imported = run_and_list_imports(*words, "--json")
    assert json.loads(printed) == made
    assert imported == "0"
    assert page.stat().st_mtime_ns == written
    page.write_text("changed")
    assert zest(*words) == made
    assert page.read_text().startswith("<!DOCTYPE html>")


@pytest.mark.usefixtures("short_videos")
def test_a_finished_report_is_found_finished_until_a_run_is_evaluated_again(
    trained: Path, tmp_path: Path, zest: Zest
) -> None:
    evaluate(trained / "bc-0", EvaluationConfig(n_episodes=1), n_workers=1)
    page = tmp_path / "page.html"
    words = ["report", str(trained / "bc-0"), "--output", str(page)]
    made, written = zest(*words), page.stat().st_mtime_ns
    printed, imported = run_and_list_imports(*words, "--json")
    assert json.loads(printed) == made
    assert imported == "0"
    assert page.stat().st_mtime_ns == written
    evaluate(trained / "bc-0", EvaluationConfig(n_episodes=2), n_workers=1)
    zest(*words)
    assert page.stat().st_mtime_ns > written


@pytest.mark.parametrize("words", [("train", "--help"), ("train", "dt", "--help"), ("evaluate", "--help")])
def test_help_needs_no_heavy_package(words: tuple[str, ...]) -> None:
    printed, imported = run_and_list_imports(*words)
    assert "zest" in printed
    assert imported == "0"
