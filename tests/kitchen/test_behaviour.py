"""Episodes of an imperfect expert, rolled out in the real kitchen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from zest_rl.errors import BadInput, ZestError
from zest_rl.kitchen import behaviour as kitchen_behaviour
from zest_rl.kitchen.behaviour import (
    Behaviour,
    behaviour_folder,
    draw_manner,
    recordings,
    returns,
    rollout,
    run_behaviour,
)
from zest_rl.kitchen.collect_config import LARGEST
from zest_rl.kitchen.env import HORIZON, env_spec
from zest_rl.kitchen.experts import DONE_PROGRESS, Manner, make_expert
from zest_rl.runtime.arrays import Arrays, concatenate, write_arrays

NOISY = Behaviour("micro", "expert", noise_max=0.6)
DRAWN = {"level", "stop_at", "speed"}
FIELDS = {"obs", "actions", "qpos", "qvel", "gt_reward", "gt_success", "seed", *DRAWN}


@pytest.fixture(autouse=True)
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def first_three() -> dict[str, Any]:
    return concatenate([rollout(NOISY, index) for index in range(3)])


def assert_equal(one: Arrays, other: Arrays) -> None:
    assert one.keys() == other.keys() == FIELDS
    for name in FIELDS:
        np.testing.assert_array_equal(one[name], other[name])


def test_episode_i_is_the_same_however_many_are_run_and_by_how_many_processes(
    first_three: Arrays, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kitchen_behaviour, "EPISODES_PER_JOB", 2)
    assert_equal(run_behaviour(NOISY, 3, n_workers=2), first_three)
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "other"))
    assert_equal(run_behaviour(NOISY, 1, first=2, n_workers=1), {name: a[2:3] for name, a in first_three.items()})


def test_finished_episodes_are_taken_from_the_cache_and_one_is_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    reported: list[int] = []
    again: list[int] = []
    before = run_behaviour(NOISY, 2, n_workers=1)

    def counted(behaviour: Behaviour, index: int) -> Arrays:
        again.append(index)
        return rollout(behaviour, index)

    monkeypatch.setattr(kitchen_behaviour, "rollout", counted)
    assert_equal(run_behaviour(NOISY, 2, n_workers=1, on_progress=reported.append), before)
    assert reported == [2]
    assert len(again) == 1


def test_damaged_episodes_are_run_again_and_exchanged_ones_are_refused() -> None:
    before = run_behaviour(NOISY, 1, n_workers=1)
    (path,) = behaviour_folder(NOISY).glob("*.npz")
    whole = path.read_bytes()
    for damaged in (b"", whole[:-1000], whole[:5000] + b"\0" + whole[5001:]):
        path.write_bytes(damaged)
        assert_equal(run_behaviour(NOISY, 1, n_workers=1), before)
    write_arrays(path, {**before, "gt_reward": before["gt_reward"][:, :50]})
    assert_equal(run_behaviour(NOISY, 1, n_workers=1), before)
    write_arrays(path, rollout(NOISY, 1))
    with pytest.raises(ZestError, match="are not those that this machine computes"):
        run_behaviour(NOISY, 1, n_workers=1)


def test_what_a_behaviour_is_decides_where_its_episodes_are_kept() -> None:
    others = [
        Behaviour("rdoor", "expert", noise_max=0.6),
        Behaviour("micro", "nothing", noise_max=0.6),
        Behaviour("micro", "expert", noise_max=0.61),
        Behaviour("micro", "expert", noise_max=0.6, init_noise=0.01),
        Behaviour("micro", "expert", noise_max=0.6, seed=1),
        *(NOISY.with_value(name, 0.05) for name in LARGEST),
    ]
    folders = [behaviour_folder(behaviour) for behaviour in (NOISY, *others)]
    assert len(set(folders)) == 11
    assert behaviour_folder(Behaviour("micro", "expert", noise_max=0.6)) == folders[0]
    assert not folders[0].exists()


def test_episodes_differ_from_each_other_and_between_seeds(first_three: Arrays) -> None:
    other_seed = rollout(Behaviour("micro", "expert", noise_max=0.6, seed=1), 0)
    starts = np.concatenate([first_three["qpos"][:, 0], other_seed["qpos"][:, 0]])
    assert len(np.unique(starts, axis=0)) == 4
    assert len(np.unique(np.concatenate([first_three["level"], other_seed["level"]]))) == 4


def test_an_episode_is_aligned_and_replays_to_the_same_states(first_three: Arrays) -> None:
    env = gymnasium.make(env_spec("micro"))
    obs, info = env.reset(seed=int(first_three["seed"][2]))
    for t in range(HORIZON):
        np.testing.assert_array_equal(obs, first_three["obs"][2, t])
        np.testing.assert_array_equal(info["state"]["qpos"], first_three["qpos"][2, t])
        obs, reward, _, truncated, info = env.step(first_three["actions"][2, t])
        assert reward == first_three["gt_reward"][2, t + 1]
        np.testing.assert_array_equal(info["state"]["qvel"], first_three["qvel"][2, t + 1])
    assert truncated
    env.close()


def test_noise_levels_are_drawn_per_episode_up_to_the_largest(first_three: Arrays) -> None:
    assert first_three["level"].min() >= 0
    assert first_three["level"].max() <= 0.6
    assert np.abs(first_three["actions"]).max() <= 1
    assert first_three["actions"].dtype == np.float32


def manners(behaviour: Behaviour, n: int = 400) -> tuple[list[Manner], np.ndarray]:
    drawn = [draw_manner(behaviour, np.random.default_rng(i)) for i in range(n)]
    return [manner for manner, _ in drawn], np.stack([bias for _, bias in drawn])


def test_an_expert_with_no_flaws_acts_as_well_as_it_can() -> None:
    drawn, bias = manners(Behaviour("micro", "expert", noise_max=1.0), 20)
    assert set(drawn) == {Manner()}
    assert not bias.any()


def test_flaws_are_drawn_per_episode_within_their_bounds() -> None:
    drawn, bias = manners(Behaviour("micro", "expert", stop_share=0.5, slow_max=0.4, bias_max=0.2, grip_max=0.02))
    stops = np.array([manner.stop_at for manner in drawn if manner.stop_at < DONE_PROGRESS])
    assert 0.4 < len(stops) / len(drawn) < 0.6
    assert 0.1 <= stops.min() < 0.2
    assert 0.9 < stops.max() <= 1.0
    speeds = np.array([manner.speed for manner in drawn])
    assert 0.6 <= speeds.min() < 0.65
    assert 0.95 < speeds.max() <= 1.0
    errors = np.abs([manner.grip_error for manner in drawn])
    assert 0.01 < errors.max() <= 0.02
    assert 0.1 < np.abs(bias).max() <= 0.2
    assert bias.dtype == np.float32


def test_a_larger_value_moves_every_episode_the_same_way_and_changes_no_other_draw() -> None:
    base = Behaviour("micro", "expert", stop_share=0.3, slow_max=0.2)
    some, _ = manners(base)
    more, bias = manners(base.with_value("stop_share", 0.6).with_value("bias_max", 0.1))
    assert [manner.speed for manner in some] == [manner.speed for manner in more]
    assert all(
        after.stop_at == before.stop_at
        for before, after in zip(some, more, strict=True)
        if before.stop_at < DONE_PROGRESS
    )
    assert bias.any()


def test_an_expert_that_stops_early_leaves_the_door_ajar_and_a_slow_one_is_late() -> None:
    best = rollout(Behaviour("micro", "expert"), 0)
    stopping = rollout(Behaviour("micro", "expert", stop_share=1.0), 0)
    slow = rollout(Behaviour("micro", "expert", slow_max=0.9), 0)
    assert stopping["stop_at"][0] <= stopping["gt_reward"].max() < 0.999 <= best["gt_reward"].max()
    assert slow["speed"][0] < 1.0
    assert returns(slow)[0] < returns(best)[0]


def test_without_noise_the_actions_are_the_experts_own() -> None:
    episode = rollout(Behaviour("micro", "expert", noise_max=0.0), 0)
    env = gymnasium.make(env_spec("micro"))
    env.reset(seed=int(episode["seed"][0]))
    expert = make_expert("micro", env)
    for t in range(HORIZON):
        action = expert.act()
        np.testing.assert_array_equal(action, episode["actions"][0, t])
        env.step(action)
    env.close()
    assert episode["gt_success"].any()


def test_the_robot_that_does_nothing_sends_zero_actions() -> None:
    episode = rollout(Behaviour("micro", "nothing"), 0)
    np.testing.assert_array_equal(episode["actions"], 0)
    assert not episode["gt_success"].any()


def test_recordings_are_what_was_rolled_out(first_three: Arrays) -> None:
    recorded = recordings(first_three)
    assert len(recorded) == 3
    for i, recording in enumerate(recorded):
        assert recording.seed == first_three["seed"][i]
        assert not recording.terminated
        for name in FIELDS - {"seed", *DRAWN}:
            np.testing.assert_array_equal(getattr(recording, name), first_three[name][i])


def test_a_return_leaves_out_the_reward_of_the_reset() -> None:
    rewards = np.array([[5.0, 1.0, 2.0], [5.0, 0.0, 0.5]], np.float32)
    np.testing.assert_allclose(returns({"gt_reward": rewards}), [3.0, 0.5])


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"noise_max": -0.1}, r"noise_max must be in \[0, 2.0\], got -0.1"),
        ({"noise_max": 2.1}, r"noise_max must be in \[0, 2.0\]"),
        ({"noise_max": float("nan")}, "noise_max must be in"),
        ({"stop_share": 1.1}, r"stop_share must be in \[0, 1.0\], got 1.1"),
        ({"slow_max": 1.0}, r"slow_max must be in \[0, 0.9\], got 1.0"),
        ({"bias_max": -1.0}, r"bias_max must be in \[0, 1.0\], got -1.0"),
        ({"grip_max": 0.2}, r"grip_max must be in \[0, 0.1\], got 0.2"),
        ({"policy": "export"}, "policy must be one of expert, rl, rl-mean, nothing, got 'export'"),
        ({"seed": -1}, "seed must be 0 or positive, got -1"),
    ],
)
def test_a_behaviour_that_makes_no_sense_is_refused(changes: dict[str, Any], rule: str) -> None:
    with pytest.raises(BadInput, match=rule):
        Behaviour(**{"task": "micro", "policy": "expert", **changes})


def test_no_episodes_and_unknown_tasks_are_refused() -> None:
    with pytest.raises(BadInput, match="n-episodes must be at least 1, got 0"):
        run_behaviour(NOISY, 0)
    with pytest.raises(BadInput, match="unknown task 'knob4'"):
        run_behaviour(Behaviour("knob4", "expert"), 1, n_workers=1)
