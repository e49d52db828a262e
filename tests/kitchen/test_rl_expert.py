"""The experts that reinforcement learning found, in the real kitchen; their training, cut short."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from zest_rl.errors import BadInput
from zest_rl.kitchen import rl_training
from zest_rl.kitchen.behaviour import Behaviour, behaviour_folder, rollout
from zest_rl.kitchen.collect_config import CollectConfig
from zest_rl.kitchen.env import ACT_DIM, ARM_DIM, KitchenEnv, env_spec
from zest_rl.kitchen.experts import make_expert
from zest_rl.kitchen.rl_expert import WEIGHTS, RLExpert, Senses, make_rl_expert, weights_file
from zest_rl.kitchen.rl_training import ShapedKitchen, shaped_reward, train
from zest_rl.kitchen.tasks import TASKS
from zest_rl.runtime import artifacts
from zest_rl.runtime.arrays import read_arrays

RANDOMIZED = Behaviour("sdoor", "rl", noise_max=0.3)


@pytest.mark.parametrize("task", TASKS)
def test_an_expert_solves_its_task(task: str) -> None:
    assert rollout(Behaviour(task, "rl-mean"), 0)["gt_success"].any()


@pytest.mark.parametrize("task", TASKS)
def test_the_weights_are_those_of_their_record_which_is_of_95_percent_of_100_starts_or_more(task: str) -> None:
    record = artifacts.read_json(WEIGHTS / f"{task}.json")
    weights = load_file(weights_file(task))
    assert record["weights_sha256"] == artifacts.hash_arrays(*(weights[name] for name in sorted(weights)))
    assert weights_file(task).stat().st_size < 200_000
    assert record["command"].startswith(f"python -m zest_rl.kitchen.rl_training {task} --seed {record['seed']} ")
    assert (record["task"], record["n_starts"]) == (task, 100)
    assert record["success"] >= 0.95


def test_an_expert_acts_as_the_network_of_torch_does_and_changes_nothing() -> None:
    env = KitchenEnv("sdoor")
    env.reset(seed=0)
    weights = {name: torch.from_numpy(array) for name, array in load_file(weights_file("sdoor")).items()}
    before = env.data.qpos.copy()

    def linear(name: str, x: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.linear(x, weights[f"{name}.weight"], weights[f"{name}.bias"])

    features = torch.from_numpy(Senses(env).features())
    hidden = linear("latent_pi.2", linear("latent_pi.0", features).relu()).relu()
    mean, std = linear("mu", hidden), linear("log_std", hidden).exp()
    action = make_rl_expert("sdoor", env).act()
    assert action.dtype == np.float32
    np.testing.assert_allclose(action, mean.tanh(), atol=1e-5)
    expert, rng = make_rl_expert("sdoor", env, np.random.default_rng(0)), np.random.default_rng(0)
    sampled = (mean + std * torch.from_numpy(rng.standard_normal(ACT_DIM))).tanh()
    np.testing.assert_allclose(expert.act(), sampled, atol=1e-5)
    np.testing.assert_array_equal(env.data.qpos, before)


def test_a_randomized_expert_acts_differently_in_each_episode_but_equally_in_the_same() -> None:
    episode = rollout(RANDOMIZED, 1)
    np.testing.assert_array_equal(rollout(RANDOMIZED, 1)["actions"], episode["actions"])
    mean = rollout(RANDOMIZED.without_flaws(), 1)
    assert RANDOMIZED.without_flaws() == Behaviour("sdoor", "rl-mean")
    assert mean["seed"] == episode["seed"]
    assert np.abs(mean["actions"] - episode["actions"]).max() > 0.3
    assert behaviour_folder(RANDOMIZED) != behaviour_folder(RANDOMIZED.without_flaws())


def test_the_gap_closes_as_the_hand_comes_to_the_contact() -> None:
    env = ShapedKitchen("sdoor")
    env.reset(seed=0)
    senses, expert = Senses(env.kitchen), make_rl_expert("sdoor", env)
    distances = [np.linalg.norm(senses.gap())]
    while not env.kitchen.progress > 0.1:
        env.step(expert.act())
        distances.append(np.linalg.norm(senses.gap()))
    assert distances[-1] < 0.1 < 0.4 < distances[0]


def test_the_way_behind_a_door_that_is_ajar_leads_round_its_edge() -> None:
    env = ShapedKitchen("ldoor")
    env.reset(seed=0)
    senses, script = Senses(env.kitchen), make_expert("ldoor", env)
    ways, rewards = [], []
    while not env.kitchen.progress > 1.0:
        rewards.append(env.step(script.act())[1])
        ways.append(senses.way_behind_door())
    n_closed = ways.index(next(way for way in ways if way is not None))
    assert n_closed > 10
    assert None not in ways[n_closed:]
    assert ways[-1] < 0.05 < 0.2 < ways[n_closed]
    assert min(rewards[n_closed:]) > max(rewards[:n_closed]), "letting go of the bar costs nothing"


def test_the_reward_rises_with_progress_nearness_and_calm() -> None:
    still = np.zeros(ACT_DIM, np.float32)
    progress = [shaped_reward(p, 0.1, still) for p in (-0.1, 0.0, 0.1, 0.5, 0.998, 0.999, 1.03, 1.5)]
    assert progress[0] == progress[1] < progress[2] < progress[3] < progress[4] < progress[5] - 0.4
    assert progress[6] == progress[7]
    assert np.all(np.diff([shaped_reward(0.2, distance, still) for distance in (0.0, 0.05, 0.3, 1.0, 3.0)]) < -0.05)
    fingers = still.copy()
    fingers[ARM_DIM:] = 1.0
    assert shaped_reward(0.0, 0.0, fingers) == shaped_reward(0.0, 0.0, still) > shaped_reward(0.0, 0.0, still + 1)


def test_training_writes_the_weights_and_their_record_and_the_same_seed_gives_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("stable_baselines3")
    monkeypatch.setattr(rl_training, "CHECK_EVERY", 60)
    monkeypatch.setattr(rl_training, "CHECK_STARTS", range(1))
    monkeypatch.setattr(rl_training, "TEST_STARTS", range(1))
    monkeypatch.setitem(rl_training.SAC, "learning_starts", 80)
    records = [train("sdoor", 3, 120, tmp_path / name) for name in ("one", "other")]
    assert artifacts.read_json(tmp_path / "one" / "sdoor.json") == records[0]
    assert records[0]["weights_sha256"] == records[1]["weights_sha256"]
    assert {path.name for path in (tmp_path / "one").iterdir()} == {"sdoor.json", "sdoor.safetensors"}
    env = gymnasium.make(env_spec("sdoor"))
    env.reset(seed=0)
    assert RLExpert(env.unwrapped, load_file(tmp_path / "one" / "sdoor.safetensors")).act().shape == (ACT_DIM,)


ENDLESS = """
import sys
from pathlib import Path
from zest_rl.kitchen import rl_training
rl_training.CHECK_EVERY, rl_training.CHECK_STARTS, rl_training.TEST_STARTS = 100, range(1), range(10**6)
rl_training.SAC["learning_starts"] = 60
rl_training.train("sdoor", 3, int(sys.argv[2]), Path(sys.argv[1]))
"""
"""A training with a check after each episode, which is still at its last judgement when it is killed."""


def train_and_kill(folder: Path, n_steps: int, killed_after: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Kill a training after a checkpoint of so many steps; return the arrays of the checkpoint and the rest of it."""
    process = subprocess.Popen([sys.executable, "-c", ENDLESS, str(folder), str(n_steps)], stderr=subprocess.DEVNULL)
    while True:
        assert process.poll() is None
        arrays = read_arrays(folder / "sdoor.checkpoint.npz")
        told = {} if arrays is None else json.loads(arrays.pop("told").tobytes())
        if arrays is not None and told["progress"]["step"] >= killed_after:
            break
        time.sleep(0.05)
    process.kill()
    process.wait()
    return arrays, told


@pytest.mark.slow
def test_a_training_that_is_killed_goes_on_by_the_same_command_as_if_nothing_had_been(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    train_and_kill(tmp_path / "cut", 300, 100)
    arrays, told = train_and_kill(tmp_path / "cut", 300, 300)
    whole_arrays, whole = train_and_kill(tmp_path / "whole", 300, 300)
    del told["progress"]["seconds"], whole["progress"]["seconds"]
    assert told == whole
    assert arrays.keys() == whole_arrays.keys()
    for name, array in whole_arrays.items():
        np.testing.assert_array_equal(arrays[name], array, err_msg=name)
    with pytest.raises(BadInput, match="with --seed 3 --steps 300, but --seed 4 --steps 300 is asked for; ask for the"):
        train("sdoor", 4, 300, tmp_path / "cut")


def test_what_an_expert_of_rl_cannot_do_is_refused() -> None:
    with pytest.raises(BadInput, match="needs a KitchenEnv made with task='sdoor', got 'micro'"):
        make_rl_expert("sdoor", KitchenEnv("micro"))
    with pytest.raises(BadInput, match="no expert was trained by RL for task 'kettle'"):
        make_rl_expert("kettle", KitchenEnv("micro"))
    for flaw in ({"slow_max": 0.1}, {"stop_share": "calibrate", "noise_max": 0.1}):
        with pytest.raises(BadInput, match=f"has the flaws noise_max and bias_max, got {next(iter(flaw))}"):
            CollectConfig(expert="rl", **flaw)
    with pytest.raises(BadInput, match="expert must be scripted or rl, got 'RL'"):
        CollectConfig(expert="RL")
