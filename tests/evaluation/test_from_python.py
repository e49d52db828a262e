"""A policy is trained and evaluated from Python alone, as the command line does it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from zest_rl.agents.dt import DTConfig
from zest_rl.evaluation.evaluate import EvaluationConfig, evaluation_folder, read_evaluation
from zest_rl.runtime import artifacts
from zest_rl.training.loop import TrainingConfig
from zest_rl.training.runs import train

SCRIPT = """
import sys
from pathlib import Path
from zest_rl.agents.dt import DTConfig
from zest_rl.evaluation.evaluate import EvaluationConfig, evaluate
from zest_rl.training.loop import TrainingConfig
from zest_rl.training.runs import train

agent_config = DTConfig(hidden_size=32, n_layers=1)
run = train("dt", sys.argv[1], agent_config, TrainingConfig(n_updates=20, seed=3, threads=1, device="cpu"))
evaluate(run, EvaluationConfig(n_episodes=1, seed=11), n_workers=1)
assert not [name for name in sys.modules if name.startswith("zest_rl.cli")]
print(run)
"""
TRAIN = ("--n-updates", 20, "--seed", 3, "--threads", 1, "--device", "cpu", "--hidden-size", 32, "--n-layers", 1)


def test_a_run_from_python_alone_has_the_weights_and_the_online_scores_of_the_command(
    trained: Path, zest: Callable[..., dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = artifacts.read_json(trained / "dt-0" / "meta.json")["dataset"]["id"]
    (tmp_path / "python").mkdir()
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, dataset], cwd=tmp_path / "python", capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    ours = tmp_path / "python" / done.stdout.strip()

    (tmp_path / "command").mkdir()
    monkeypatch.chdir(tmp_path / "command")
    theirs = Path(zest("train", "dt", dataset, *TRAIN)["run"])
    zest("evaluate", theirs, "--n-episodes", 1, "--seed", 11, "--n-workers", 1, "--no-videos")

    assert ours.relative_to(tmp_path / "python") == theirs
    for name in ("model.safetensors", "zest_scorer.safetensors", "run.json"):
        assert (ours / name).read_bytes() == (theirs / name).read_bytes()
    config = EvaluationConfig(n_episodes=1, seed=11)
    one, other = (read_evaluation(evaluation_folder(run, config)) for run in (ours, theirs))
    assert one.episodes == other.episodes
    assert one.episodes[0].zest_return is not None
    for name, array in one.traces.items():
        np.testing.assert_array_equal(array, other.traces[name], err_msg=name)


def test_a_finished_run_whose_scorer_is_gone_gets_it_back(trained: Path) -> None:
    run = trained / "dt-0"
    scorer, meta = (run / "zest_scorer.safetensors").read_bytes(), artifacts.read_json(run / "run.json")
    (run / "zest_scorer.safetensors").unlink()
    config = TrainingConfig(n_updates=30, device="cpu", threads=1, log_every=10)
    train("dt", meta["dataset"]["id"], DTConfig(**meta["config"]), config, run_dir=run)
    assert (run / "zest_scorer.safetensors").read_bytes() == scorer
