"""What is done already is found done without the packages that would do it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from zest_rl.evaluation.evaluate import EvaluationConfig, evaluate

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


def test_a_finished_training_is_found_finished_without_torch(trained: Path) -> None:
    asked = json.loads((trained / "bc-0" / "run.json").read_text())
    words = ["--n-updates=30", "--hidden-size=32", "--n-layers=1", "--warmup-updates=0", f"--run-dir={trained}/bc-0"]
    printed, imported = run_and_list_imports("train", "bc", asked["dataset"]["id"], *words)
    assert "n_updates: 30" in printed
    assert imported == "0"


def test_a_finished_evaluation_is_found_finished_without_torch(trained: Path) -> None:
    evaluate(trained / "bc-0", EvaluationConfig(n_episodes=1), n_workers=1)
    printed, imported = run_and_list_imports("evaluate", f"{trained}/bc-0", "--n-episodes=1", "--no-videos")
    assert "n_episodes: 1" in printed
    assert imported == "0"


@pytest.mark.parametrize("words", [("train", "--help"), ("train", "dt", "--help"), ("evaluate", "--help")])
def test_help_needs_no_heavy_package(words: tuple[str, ...]) -> None:
    printed, imported = run_and_list_imports(*words)
    assert "zest" in printed
    assert imported == "0"
