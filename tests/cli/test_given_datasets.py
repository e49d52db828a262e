"""`zest reproduce` on datasets that are there already, of any environment."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import gymnasium
import gymnasium_robotics  # noqa: F401  # registers its environments
import numpy as np
import pytest
from tiny_comparison import refuse_edited, write

from zest_rl.cli.reproduce.comparison import read_comparison
from zest_rl.simulation.recorder import Recorder

TWO = """
title = "Given"

[tasks.push]
dataset = "given/push-v0"
made_by = "python record.py push"
relabel = { goal = "text:far -> near", views = 2 }

[tasks.door]
dataset = "given/door-v0"
env = "my_robot:door"
horizon = 50
success_key = "open"
relabel = { goal = "text:shut -> open" }

[relabel]
views = 3

[goals.words]

[goals.shuffled]
goal = "text:closed -> open"
shuffle = 0
"""


def test_the_goal_and_the_environment_may_be_those_of_each_task(tmp_path: Path) -> None:
    comparison = read_comparison(write(tmp_path, TWO))
    datasets = {task: given.dataset for task, given in comparison.tasks.items()}
    assert datasets == {"push": "given/push-v0", "door": "given/door-v0"}
    push, door = comparison.relabel["push"], comparison.relabel["door"]
    assert (push["words"].goal, push["words"].views, push["words"].env) == ("text:far -> near", 2, None)
    assert (door["words"].goal, door["words"].views, door["words"].env) == ("text:shut -> open", 3, "my_robot:door")
    assert (push["shuffled"].goal, push["shuffled"].shuffle) == ("text:closed -> open", 0), "what a goal says wins"
    asked = {"env": "my_robot:door", "horizon": 50, "success_key": "open"}
    assert comparison.tasks["door"].arguments(*asked) == asked
    assert comparison.tasks["push"].arguments(*asked) == {}


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('"given/door-v0"', '"given/push-v0"', "[tasks]: two tasks have the same dataset"),
        ("made_by", "made-bye", "[tasks.push]: unknown key 'made-bye'; did you mean 'made-by'"),
        ("[tasks.door]", "[tasks.report]", "[tasks.'report']: the name becomes a file's beside report.html"),
        ("views = 2", 'dataset = "a/b-v0"', "'dataset' is not for a recipe to set"),
        ("views = 2", 'preview = "look.png"', "'preview' is not for a recipe to set"),
        ("[goals.words]", "[collect]\n[goals.words]", "[tasks.push]: unknown key 'made_by'"),
        ('"text:far -> near"', '"visual-tasks:real_imgs/open_cabinet"', "set it to your copy of the Visual Tasks"),
        (TWO[TWO.index("[tasks.push]") : TWO.index("[relabel]")], "", "names no data: give it a table [collect]"),
        ("[relabel]", "[relabel]", "given/push-v0: python record.py push\n  given/door-v0"),
    ],
)
def test_given_datasets_that_cannot_be_used_are_refused_before_anything_runs(
    old: str,
    new: str,
    complaint: str,
    refusal: Callable[..., tuple[int, str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recipe, message = refuse_edited(TWO, (old, new), refusal, tmp_path, monkeypatch)
    assert complaint in message
    assert recipe.name in message
    assert not (tmp_path / "minari").exists()


PUSH = """
title = "Given"
seeds = [0, 1]

[tasks.push]
dataset = "given/push-v0"
horizon = 4
relabel = { show_robot = true, look_at = "robot0:gripper_link" }

[relabel]
views = 1

[goals.episode]
goal = "episode:0"

[train]
hidden_size = 16
n_layers = 1

[train.bc]
n_updates = 20
warmup_updates = 0

[train.rvs]
n_updates = 20
warmup_updates = 0

[train.ppo]
n_steps = 32
n_envs = 2
rollout = 16
batch_size = 16
start_updates = 5
log_every = 16

[evaluate]
n_episodes = 2
videos = false

[methods.BC]
seeds = [0]
agent = "bc"
goal = "episode"

[methods."ZeST+RvS"]
seeds = [0]
agent = "rvs"
goal = "episode"

[methods."GT-reward RvS"]
seeds = [0]
agent = "rvs"
kind = "control"

[methods.PPO]
agent = "ppo"
"""


def test_methods_are_compared_on_a_dataset_of_another_robot(
    tmp_path: Path,
    zest: Callable[..., dict[str, Any]],
    refusal: Callable[..., tuple[int, str]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "cache"))
    (tmp_path / "minari").mkdir()
    env = Recorder(gymnasium.make("FetchPush-v4"))
    env.action_space.seed(0)
    for seed in range(3):
        env.reset(seed=seed)
        for _ in range(4):
            env.step(env.action_space.sample())
    words = ["reproduce", write(tmp_path, PUSH), "--output", tmp_path / "out", "--n-workers", "1"]
    path = env.write("given/push-v0")
    assert "given/push-v0 lacks ref_min_score or ref_max_score" in refusal(*words)[1]
    shutil.rmtree(path)
    env.write("given/push-v0", ref_min_score=-10.0, ref_max_score=0.0)
    other = write(tmp_path / "minari", PUSH.replace("horizon = 4", "horizon = 50"))
    assert "horizon must be that of given/push-v0, 4 steps" in refusal("reproduce", other, *words[2:])[1]
    result = zest(*words)
    assert {name: (row["kind"], row["n_episodes"]) for name, row in result["rows"].items()} == {
        "Demo": ("dataset", 3),
        "BC": ("method", 2),
        "ZeST+RvS": ("method", 2),
        "GT-reward RvS": ("control", 2),
        "PPO": ("method", 4),
    }
    assert result["rows"]["Demo"]["normalized_return"] == pytest.approx(60), "-4 of -10 to 0"
    assert result["rows"]["BC"]["normalized_return"] == pytest.approx(60), "4 steps, as the recipe says, and not 50"
    assert result["rows"]["BC"]["success"] == 0
    assert result["tasks"]["push"]["dataset"] == {"dataset": "given/push-v0"}
    assert list(result["seconds_by_stage"]) == ["relabel", "train and evaluate", "report"], "nothing is collected"
    html = (tmp_path / "out" / "report.html").read_text()
    assert all(part in html for part in ("ZeST+RvS", "given/push-v0", "episode:0", "Step in the environment"))
    of_task = result["tasks"]["push"]
    assert {name: len(of_seeds) for name, of_seeds in of_task["train_seconds"].items()} == {
        "BC": 1, "ZeST+RvS": 1, "GT-reward RvS": 1, "PPO": 2,
    }  # fmt: skip
    curves = of_task["learning_curves"]
    assert {name: (curve["quantity"], curve["steps"]) for name, curve in curves.items()} == {
        "PPO": ("normalized return, %", [16, 32])
    }
    low, mean, high = (np.array(curves["PPO"][key]) for key in ("low", "mean", "high"))
    np.testing.assert_allclose(mean, (low + high) / 2, atol=0.01)
    assert ((low >= 60) & (high <= 100)).all()
    assert zest(*words)["n_cells_run"] == 0
