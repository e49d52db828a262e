"""Policies that learn in the environment: what a run leaves, that it can be cut short, and what it refuses."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import zest_rl
from zest_rl.agents import load_policy
from zest_rl.agents.base import describe_data
from zest_rl.agents.online import PPO, SAC, TRPO, CorrectedPolicy
from zest_rl.data.reader import open_dataset
from zest_rl.errors import BadInput, Notice, ZestError
from zest_rl.evaluation.environments import find_environment
from zest_rl.online.algorithms import SymmetricReplay, build, mean_network
from zest_rl.online.environments import RewardedVecEnv, make_environments
from zest_rl.online.learning import CHECKPOINT
from zest_rl.online.rewards import OnlineReward, Steps, own_reward
from zest_rl.runtime import artifacts
from zest_rl.runtime.learner_state import restore, state_of

SMALL: dict[str, Any] = {"start_updates": 5, "hidden_size": 16, "n_layers": 1, "batch_size": 32, "n_envs": 2}
SETTINGS = {"threads": 1, "device": "cpu", "log_every": 100}
AGENTS = {"sac": {"n_steps": 220}, "ppo": {"n_steps": 300, "rollout": 128}, "trpo": {"n_steps": 300, "rollout": 128}}


def scored_dataset(trained: Path) -> str:
    return str(artifacts.read_json(trained / "bc-0" / "meta.json")["dataset"]["id"])


def few_environments(dataset_id: str, reward: Callable[[Steps], Any] | None = None) -> RewardedVecEnv:
    """Two copies of a dataset's environment, with its own reward or another one."""
    with open_dataset(dataset_id) as dataset:
        episodes, described = dataset.episodes(), dataset.describe()
        own = own_reward(dataset, episodes)
    facts = describe_data(episodes)
    environment = find_environment({"dataset": described, "max_steps": facts.max_steps})
    actor = SAC.networks(SAC.config(**SMALL), facts)
    assert isinstance(actor, CorrectedPolicy)
    given = own if reward is None else OnlineReward(reward, own.recorded)
    return make_environments(environment, facts, actor, given, 2, subprocesses=False)


@pytest.mark.parametrize("agent", AGENTS)
def test_a_policy_learns_in_the_environment_and_is_evaluated(
    agent: str, trained: Path, zest: Callable[..., dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    words = [word for name, value in (SMALL | SETTINGS | AGENTS[agent]).items() for word in (f"--{name}", value)]
    words = [word.replace("_", "-") if str(word).startswith("--") else word for word in words]

    made = zest("train", agent, scored_dataset(trained), *words, "--run-dir", tmp_path / "run")

    assert made["agent"] == agent
    assert made["n_updates"] > 0
    assert not [*temporary.iterdir()]
    run = tmp_path / "run"
    left = {path.name for path in run.iterdir() if not path.name.startswith(".")}
    assert left == {
        "README.md", "meta.json", "metrics.csv", "model.safetensors", "run.json", "tb", "zest_scorer.safetensors",
    }  # fmt: skip
    rows = list(csv.DictReader((run / "metrics.csv").open(newline="")))
    assert int(rows[-1]["step"]) >= 200
    evaluated = zest("evaluate", run, "--n-episodes", 2, "--n-workers", 1, "--no-videos", "--horizon", 5)
    assert evaluated["n_episodes"] == 2
    assert load_policy(run).agent == agent


def test_loading_a_policy_and_help_import_no_stable_baselines3(trained: Path) -> None:
    code = (
        "import sys; from zest_rl.cli.train import CONFIGS; import zest_rl.evaluation.evaluate; "
        "assert 'sac' in CONFIGS; assert not {'stable_baselines3', 'sb3_contrib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_learned_policy_acts_as_it_did_in_its_environments(trained: Path, tmp_path: Path) -> None:
    run = zest_rl.train("sac", scored_dataset(trained), run_dir=tmp_path / "run", **SMALL, **SETTINGS, n_steps=20)
    policy = load_policy(run)
    model = policy._model
    obs = np.random.default_rng(0).normal(size=(3, policy.meta["obs_dim"])).astype(np.float32)

    policy.begin(3)
    actions = policy.act(obs)

    normalized = torch.from_numpy(policy._facts.normalize(obs))
    with torch.no_grad():
        cloned = torch.stack([network(normalized) for network in model.start]).mean(0)
        corrected = cloned + SAC.config().correction * torch.tanh(model.correction(normalized))
    np.testing.assert_allclose(actions, corrected.clamp(-1, 1).numpy(), atol=1e-6)


@pytest.mark.parametrize("agent", [SAC, PPO, TRPO])
def test_the_state_of_an_algorithm_is_restored_whole(agent: Any, collected: str) -> None:
    venv = few_environments(collected)
    small = {**SMALL, "n_steps": 40} | ({} if agent is SAC else {"rollout": 32})
    config, cpu = agent.config(**small, from_scratch=True), torch.device("cpu")
    never: Any = None
    one = build(config, venv, None, seed=0, device=cpu).learn(40, log_interval=never)
    if agent is SAC:
        one.train(2, 16)

    other = build(config, venv, None, seed=1, device=cpu)
    other.set_logger(one.logger)
    restore(other, state_of(one))

    before, after = state_of(one), state_of(other)
    assert before.keys() == after.keys()
    assert any("exp_avg" in name for name in before)
    for name, array in before.items():
        np.testing.assert_array_equal(array, after[name], err_msg=name)
    assert all(map(torch.equal, mean_network(one).state_dict().values(), mean_network(other).state_dict().values()))
    venv.close()


class Cut(Exception):
    """What ends a training here."""


def test_a_run_that_was_cut_short_goes_on_from_its_checkpoint(trained: Path, tmp_path: Path) -> None:
    run, steps = tmp_path / "run", list[int]()
    settings = {**SMALL, **SETTINGS, "n_steps": 400, "checkpoint_every": 200, "run_dir": run}

    def cut(n: int, **row: float) -> None:
        raise Cut

    with pytest.raises(Cut):
        zest_rl.train("sac", scored_dataset(trained), **{**settings, "log_every": 300}, on_progress=cut)
    assert (run / CHECKPOINT).exists()
    zest_rl.train("sac", scored_dataset(trained), **settings, on_progress=lambda n, **row: steps.append(n))

    assert sum(steps) == 400
    meta = artifacts.read_json(run / "meta.json")
    assert meta["n_updates"] == 398, "those before the checkpoint, whose own step is not learned from, and those after"
    assert not (run / CHECKPOINT).exists()
    with pytest.raises(BadInput, match=r"config.gamma \(was 0.97, is 0.9\)"):
        zest_rl.train("sac", scored_dataset(trained), **settings, gamma=0.9)


def test_a_damaged_checkpoint_is_told(trained: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    settings = {**SMALL, **SETTINGS, "n_steps": 400, "checkpoint_every": 100, "run_dir": run}

    def cut(n: int, **row: float) -> None:
        raise Cut

    with pytest.raises(Cut):
        zest_rl.train("sac", scored_dataset(trained), **settings, on_progress=cut)
    content = bytearray((run / CHECKPOINT).read_bytes())
    content[len(content) // 2] ^= 1
    (run / CHECKPOINT).write_bytes(content)
    with pytest.raises(ZestError, match="is damaged; delete it"):
        zest_rl.train("sac", scored_dataset(trained), **settings)


def test_half_of_every_batch_is_from_the_dataset(collected: str) -> None:
    venv = few_environments(collected)
    ones = [torch.ones(5, n) for n in (venv.observation_space.shape[0], venv.action_space.shape[0])]
    recorded: Any = (*ones, ones[0], torch.zeros(5, 1), torch.full((5, 1), 7.0))
    from stable_baselines3.common.type_aliases import ReplayBufferSamples

    buffer = SymmetricReplay(
        10, venv.observation_space, venv.action_space, n_envs=2, recorded=ReplayBufferSamples(*recorded)
    )
    obs, actions = np.zeros((2, len(ones[0][0]))), np.zeros((2, len(ones[1][0])))
    buffer.add(obs, obs, actions, np.zeros(2), np.zeros(2), [{}, {}])

    batch = buffer.sample(9)

    assert (batch.rewards == 7).sum() == 4
    assert (batch.rewards == 0).sum() == 5
    venv.close()


def test_online_rewards_are_those_that_the_dataset_holds(trained: Path) -> None:
    with open_dataset(scored_dataset(trained)) as dataset:
        episodes, states = dataset.episodes(), dataset.states()
        reward = own_reward(dataset, episodes)
        assert reward.views is not None
        first = np.repeat(states[0][:1], len(states[0]) - 1, axis=0)
        steps = Steps(episodes[0].obs[1:], np.zeros(len(first), np.float32), first, states[0][:-1], states[0][1:])
        np.testing.assert_allclose(reward.of_steps(steps), episodes[0].rewards, atol=1e-5)


def test_rewards_that_never_change_or_are_nan_are_told(collected: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zest_rl.online.environments.WATCHED", 10)
    still = np.zeros((2, 9), np.float32)
    venv = few_environments(collected, lambda steps: np.full(len(steps.own), 0.5, np.float32))
    venv.reset()
    for _ in range(4):
        venv.step(still)
    with pytest.warns(Notice, match=r"reward was 0.5 in each of the first 10 steps: there is nothing to learn from"):
        venv.step(still)
    venv.close()
    venv = few_environments(collected, lambda steps: np.full(len(steps.own), np.nan, np.float32))
    venv.reset()
    with pytest.raises(ZestError, match="rewards must be finite, got"):
        venv.step(still)
    venv.close()


def test_what_cannot_be_learned_from_online_is_refused(
    collected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_dataset(collected) as dataset:
        given = zest_rl.with_rewards(collected, dataset.rewards(), "mine")
    with pytest.raises(BadInput, match="were given as numbers, so new states have none"):
        zest_rl.train("sac", given, **SMALL, **SETTINGS, run_dir=tmp_path / "run")
    with pytest.raises(BadInput, match=r"correction must be in \(0, 2\], got 3"):
        zest_rl.train("ppo", collected, correction=3)
    with pytest.raises(BadInput, match="unknown argument 'n_updates'"):
        zest_rl.train("ppo", collected, n_updates=3)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(BadInput, match=r"`zest train sac` needs stable_baselines3: pip install 'zest-rl\[rl\]'"):
        zest_rl.train("sac", collected, run_dir=tmp_path / "run")


def test_the_truth_is_the_reward_before_relabeling(trained: Path, tmp_path: Path) -> None:
    settings = {**SMALL, **SETTINGS, "n_steps": 20, "run_dir": tmp_path / "run"}
    run = zest_rl.train("sac", scored_dataset(trained), reward="truth", **settings)
    assert artifacts.read_json(run / "meta.json")["dataset"]["id"] == "zest/kitchen-micro-tiny-v0"


def test_a_learned_reward_is_of_the_same_task(collected: str, tmp_path: Path) -> None:
    trex = zest_rl.train("trex", collected, run_dir=tmp_path / "trex", n_updates=2, hidden_size=16, threads=1)
    settings = {**SMALL, **SETTINGS, "n_steps": 10, "reward": str(trex)}
    assert (zest_rl.train("sac", collected, run_dir=tmp_path / "run", **settings) / "model.safetensors").exists()

    meta = artifacts.read_json(trex / "meta.json")
    meta["dataset"]["env_spec"] = meta["dataset"]["env_spec"].replace('"micro"', '"sdoor"')
    artifacts.write_json(trex / "meta.json", meta)
    with pytest.raises(
        BadInput, match=r"task sdoor of zest/Kitchen-v1, where .* but zest/kitchen-micro-tiny-v0 is of task micro of"
    ):
        zest_rl.train("sac", collected, run_dir=tmp_path / "other", **settings)
    assert not (tmp_path / "other").exists()


@pytest.mark.slow
def test_a_killed_run_goes_on(trained: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    words = [f"--{name.replace('_', '-')}={value}" for name, value in {**SMALL, **SETTINGS, "n_steps": 1500}.items()]
    command = [
        sys.executable, "-c", "from zest_rl.cli import main; raise SystemExit(main())", "train", "sac",
        scored_dataset(trained), *words, "--checkpoint-every=100", f"--run-dir={run}",
    ]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    while not (run / CHECKPOINT).exists():
        assert process.poll() is None
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    assert artifacts.read_json(run / "meta.json")["n_updates"] >= 1490
    steps = [int(row["step"]) for row in csv.DictReader((run / "metrics.csv").open(newline=""))]
    assert steps == sorted(set(steps))
