from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from read_dataset import read

from zest_rl.cli import main
from zest_rl.cli.collect import FLAWS
from zest_rl.data import reader
from zest_rl.data.reader import Dataset
from zest_rl.errors import BadInput, ZestError
from zest_rl.kitchen import collect
from zest_rl.kitchen.collect import (
    Behaviour,
    References,
    calibrate,
    measure_references,
    rollout,
    run_behaviour,
)
from zest_rl.kitchen.env import HORIZON
from zest_rl.kitchen.experts import DONE_PROGRESS, Manner, make_expert
from zest_rl.runtime.arrays import Arrays, concatenate

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


# --- episodes ---------------------------------------------------------------------------------------------------------


def test_episode_i_is_the_same_however_many_are_run_and_by_how_many_processes(
    first_three: Arrays, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(collect, "EPISODES_PER_JOB", 2)
    assert_equal(run_behaviour(NOISY, 3, n_workers=2), first_three)
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "other"))
    assert_equal(run_behaviour(NOISY, 1, first=2, n_workers=1), {name: a[2:3] for name, a in first_three.items()})


def test_finished_episodes_are_taken_from_the_cache(first_three: Arrays, monkeypatch: pytest.MonkeyPatch) -> None:
    reported: list[int] = []
    before = run_behaviour(NOISY, 1, n_workers=1)
    monkeypatch.setattr(collect, "rollout", lambda behaviour, index: pytest.fail("done again"))
    assert_equal(run_behaviour(NOISY, 1, n_workers=1, on_progress=reported.append), before)
    assert reported == [1]


def test_what_a_behaviour_is_decides_where_its_episodes_are_kept() -> None:
    others = [
        Behaviour("rdoor", "expert", noise_max=0.6),
        Behaviour("micro", "nothing", noise_max=0.6),
        Behaviour("micro", "expert", noise_max=0.61),
        Behaviour("micro", "expert", noise_max=0.6, init_noise=0.01),
        Behaviour("micro", "expert", noise_max=0.6, seed=1),
        *(NOISY.with_value(name, 0.05) for name in collect.LARGEST),
    ]
    folders = [collect.behaviour_folder(behaviour) for behaviour in (NOISY, *others)]
    assert len(set(folders)) == 11
    assert collect.behaviour_folder(Behaviour("micro", "expert", noise_max=0.6)) == folders[0]
    assert not folders[0].exists()


def test_episodes_differ_from_each_other_and_between_seeds(first_three: Arrays) -> None:
    other_seed = rollout(Behaviour("micro", "expert", noise_max=0.6, seed=1), 0)
    starts = np.concatenate([first_three["qpos"][:, 0], other_seed["qpos"][:, 0]])
    assert len(np.unique(starts, axis=0)) == 4
    assert len(np.unique(np.concatenate([first_three["level"], other_seed["level"]]))) == 4


def test_an_episode_is_aligned_and_replays_to_the_same_states(first_three: Arrays) -> None:
    env = gymnasium.make(collect.env_spec("micro"))
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
    drawn = [collect.draw_manner(behaviour, np.random.default_rng(i)) for i in range(n)]
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
    assert collect.returns(slow)[0] < collect.returns(best)[0]


def test_without_noise_the_actions_are_the_experts_own() -> None:
    episode = rollout(Behaviour("micro", "expert", noise_max=0.0), 0)
    env = gymnasium.make(collect.env_spec("micro"))
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
    recordings = collect.recordings(first_three)
    assert len(recordings) == 3
    for i, recording in enumerate(recordings):
        assert recording.seed == first_three["seed"][i]
        assert not recording.terminated
        for name in FIELDS - {"seed", *DRAWN}:
            np.testing.assert_array_equal(getattr(recording, name), first_three[name][i])


def test_a_return_leaves_out_the_reward_of_the_reset() -> None:
    rewards = np.array([[5.0, 1.0, 2.0], [5.0, 0.0, 0.5]], np.float32)
    np.testing.assert_allclose(collect.returns({"gt_reward": rewards}), [3.0, 0.5])


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
        ({"policy": "export"}, "policy must be 'expert' or 'nothing', got 'export'"),
        ({"seed": -1}, "seed must be 0 or positive, got -1"),
    ],
)
def test_a_behaviour_that_makes_no_sense_is_refused(changes: dict[str, Any], rule: str) -> None:
    with pytest.raises(BadInput, match=rule):
        Behaviour(**{"task": "micro", "policy": "expert", **changes})


def test_no_episodes_and_unknown_tasks_are_refused() -> None:
    with pytest.raises(BadInput, match="n_episodes must be at least 1, got 0"):
        run_behaviour(NOISY, 0)
    with pytest.raises(BadInput, match="unknown task 'knob4'"):
        run_behaviour(Behaviour("knob4", "expert"), 1, n_workers=1)


# --- references and calibration ---------------------------------------------------------------------------------------


def test_references_come_from_the_expert_and_from_doing_nothing_on_starts_of_their_own(
    monkeypatch: pytest.MonkeyPatch, first_three: Arrays
) -> None:
    monkeypatch.setattr(collect, "N_NOTHING", 2)
    references = measure_references(NOISY, 2, n_workers=1)
    assert references.expert_success == 1.0
    assert references.minimum < 1.0 < 50.0 < references.expert < HORIZON
    assert references.n_episodes == 2
    episodes = run_behaviour(Behaviour("micro", "expert"), 2, first=collect.REFERENCE_STREAM, n_workers=1)
    assert references.expert == pytest.approx(collect.returns(episodes).mean())
    assert not set(episodes["seed"]) & set(first_three["seed"])


def test_an_expert_that_is_no_better_than_doing_nothing_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = {"gt_reward": np.zeros((2, 101)), "gt_success": np.zeros((2, 101), bool)}
    monkeypatch.setattr(collect, "run_behaviour", lambda *args, **kwargs: nothing)
    with pytest.raises(ZestError, match=r"the expert of task 'micro' returns 0\.000, no more than doing nothing"):
        measure_references(NOISY, 2)


class Curve:
    """Stands for rollouts: returns alone, which fall with the noise."""

    def __init__(self) -> None:
        self.asked: list[tuple[Behaviour, int]] = []

    def __call__(self, behaviour: Behaviour, n_episodes: int, *, n_workers: int | None) -> Arrays:
        self.asked.append((behaviour, n_episodes))
        return {"gt_reward": np.full((n_episodes, 2), 10 + 60 * np.exp(-behaviour.noise_max))}


SCALE = References(minimum=10.0, expert=70.0, expert_success=1.0, n_episodes=100)


@pytest.mark.parametrize("target", [20.0, 50.0, 81.19, 99.0])
def test_calibration_looks_at_returns_alone_and_meets_the_target(
    target: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    curve = Curve()
    rounds: list[tuple[float, float]] = []
    monkeypatch.setattr(collect, "run_behaviour", curve)
    found = calibrate(NOISY, "noise_max", 7, SCALE, target, tolerance=0.5, on_round=lambda *pair: rounds.append(pair))
    assert 100 * np.exp(-found.noise_max) == pytest.approx(target, abs=0.5)
    assert found == NOISY.with_value("noise_max", found.noise_max)
    assert len(rounds) <= 7
    assert [behaviour.noise_max for behaviour, _ in curve.asked] == [noise for noise, _ in rounds]
    assert rounds[-1][0] == found.noise_max
    assert {(b.task, b.policy, b.seed, n) for b, n in curve.asked} == {("micro", "expert", 0, 7)}


def test_a_level_out_of_reach_is_an_error_that_says_how_near_it_came(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collect, "run_behaviour", Curve())
    with pytest.raises(
        ZestError, match=r"no noise_max in \[0, 2.0\] brings the dataset to 5.0 ± 0.5 % .*gave 13\.\d+ %"
    ):
        calibrate(NOISY, "noise_max", 7, SCALE, 5.0)


@pytest.mark.parametrize("target", [0.0, -3.0, 101.0, float("nan")])
def test_a_level_that_is_no_share_of_the_expert_is_refused_before_any_episode(target: float) -> None:
    with pytest.raises(BadInput, match=r"must be in \(0, 100\] percent of the expert"):
        calibrate(NOISY, "noise_max", 7, SCALE, target)


def test_calibration_stops_where_there_is_no_further_to_go(monkeypatch: pytest.MonkeyPatch) -> None:
    curve = Curve()
    monkeypatch.setattr(collect, "run_behaviour", curve)
    with pytest.raises(ZestError, match=r"the last try, 2\.0, gave 13\.5"):
        calibrate(NOISY, "noise_max", 7, SCALE, 5.0)
    assert [behaviour.noise_max for behaviour, _ in curve.asked] == [0.6, 1.2, 2.0]
    curve.asked.clear()
    with pytest.raises(ZestError, match=r"the last try, 0\.0, gave 5"):
        calibrate(NOISY, "stop_share", 7, SCALE, 81.19)
    assert len(curve.asked) == 1, "the noise alone is too much"


def test_only_what_makes_the_expert_imperfect_can_be_calibrated() -> None:
    with pytest.raises(BadInput, match=r"'init_noise' cannot be calibrated; .*noise_max"):
        calibrate(NOISY, "init_noise", 7, SCALE, 50.0)
    assert set(FLAWS) == collect.LARGEST.keys()


def test_real_episodes_are_calibrated_to_a_level() -> None:
    scale = References(minimum=0.0, expert=71.0, expert_success=1.0, n_episodes=100)
    rounds: list[float] = []
    behaviour = Behaviour("micro", "expert", noise_max=0.1)
    found = calibrate(
        behaviour, "stop_share", 2, scale, 80.0, tolerance=18.0, n_workers=1,
        on_round=lambda share, level: rounds.append(share),
    )  # fmt: skip
    assert found.stop_share == rounds[-1]
    assert found.noise_max == 0.1
    episodes = run_behaviour(found, 2, n_workers=1)
    assert 100 * collect.returns(episodes).mean() / 71.0 == pytest.approx(80.0, abs=18.0)


# --- the command ------------------------------------------------------------------------------------------------------

SMALL = {"N_REFERENCE": 2, "N_NOTHING": 1, "EPISODES_PER_JOB": 1}
WORDS = ["collect", "--task", "micro", "--n-episodes", "3", "--noise-max", "0.5", "--n-workers", "1", "--json"]
DATASET = "zest/kitchen-micro-noisy-v0"


def zest(words: list[str]) -> tuple[int, dict[str, Any], str]:
    """Run the command in this process: exit code, result, what it told on the way."""
    out, err = StringIO(), StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = main(words)
    return code, json.loads(out.getvalue()), err.getvalue()


def collect_into(folder: Path, patch: pytest.MonkeyPatch) -> dict[str, Any]:
    for name, value in SMALL.items():
        patch.setattr(collect, name, value)
    patch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    patch.setenv("ZEST_CACHE", str(folder / "cache"))
    code, result, err = zest(WORDS)
    assert code == 0, err
    return result


@pytest.fixture(scope="module")
def uncut(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Folder and result of a command that nothing interrupted."""
    folder = tmp_path_factory.mktemp("uncut")
    with pytest.MonkeyPatch.context() as patch:
        return folder, collect_into(folder, patch)


def parts(cache: Path) -> list[Path]:
    """Return the finished parts of the dataset's own episodes, not those of the references."""
    return list(cache.glob("episodes/*/episodes-?-?.npz"))


def test_the_command_tells_what_it_made(uncut: tuple[Path, dict[str, Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    folder, result = uncut
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    assert (result["dataset"], result["path"]) == (DATASET, str(folder / "minari" / DATASET))
    assert result["next"] == f"zest relabel {DATASET} --goal same-scene"
    assert (result["n_episodes"], result["noise_max"]) == (3, 0.5)
    truths = read(DATASET, Dataset.truth)
    assert result["n_failed"] == sum(not truth.success for truth in truths)
    span = result["expert_return"] - result["minimum_return"]
    mean = np.mean([100 * (truth.episode_return - result["minimum_return"]) / span for truth in truths])
    estimate = result["normalized_return"]
    assert estimate["value"] == pytest.approx(mean)
    assert estimate["low"] <= mean <= estimate["high"]
    metadata = read(DATASET, lambda ds: ds.metadata)
    assert (metadata["ref_min_score"], metadata["ref_max_score"]) == (result["minimum_return"], result["expert_return"])
    assert metadata["zest"]["collect"]["asked"]["noise_max"] == 0.5
    assert not parts(folder / "cache")


def test_the_command_typed_again_does_nothing_and_refuses_other_arguments(
    uncut: tuple[Path, dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, result = uncut
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    file = reader.dataset_path(DATASET) / reader.DATA_FILE
    before = file.stat().st_mtime_ns
    code, again, err = zest(WORDS)
    assert (code, again) == (0, result)
    assert f"{DATASET} is there already, nothing to do" in err
    calibrated = ["calibrate" if word == "0.5" else word for word in WORDS]
    level = str(result["normalized_return"]["value"])
    assert zest([*calibrated, "--level", level])[:2] == (0, result), "it is what calibration to this level would give"
    assert zest(calibrated)[0] == 2
    code, refused, _ = zest([*WORDS, "--seed", "1"])
    assert code == 2
    assert refused["error"]["type"] == "BadInput"
    assert f"dataset {DATASET} exists and was collected with other arguments" in refused["error"]["message"]
    assert file.stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("words", "rule"),
    [
        (["--n-episodes", "0"], "n-episodes must be at least 1, got 0"),
        (["--task", "mirco"], "unknown task 'mirco'; did you mean 'micro'?"),
        (["--noise-max", "3"], "noise_max must be in [0, 2.0]"),
        (["--seed", "-1"], "seed must be 0 or positive, got -1"),
        (["--dataset", "../x-v0"], "a dataset id must look like"),
        (["--stop-share", "calibrate"], "one number can be calibrated, got noise_max and stop_share"),
        (["--noise-max", "high"], "--noise-max"),
    ],
)
def test_bad_arguments_end_with_exit_code_2_before_any_episode(words: list[str], rule: str, tmp_path: Path) -> None:
    code, result, _ = zest(["collect", "--n-workers", "1", "--json", *words])
    assert code == 2
    assert rule in result["error"]["message"]
    assert not (tmp_path / "minari").exists()
    assert not list(tmp_path.rglob("*.npz"))


def test_a_killed_command_goes_on_where_it_stopped_and_ends_with_the_same_dataset(
    tmp_path: Path, uncut: tuple[Path, dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    code = (
        "import sys; from zest_rl.kitchen import collect; from zest_rl.cli import main\n"
        f"for name, value in {SMALL}.items(): setattr(collect, name, value)\n"
        "main(sys.argv[1:])"
    )
    command = subprocess.Popen([sys.executable, "-c", code, *WORDS], stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while not parts(tmp_path / "cache"):
        assert command.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    command.send_signal(signal.SIGKILL)
    command.wait()
    assert reader.list_datasets() == []
    assert len(parts(tmp_path / "cache")) < 3
    references = {path: path.stat().st_mtime_ns for path in tmp_path.glob("cache/episodes/*/episodes-2147*.npz")}
    assert len(references) == 3

    result = collect_into(tmp_path, monkeypatch)
    assert {path: path.stat().st_mtime_ns for path in references} == references
    resumed = read(DATASET, Dataset.describe)
    folder, uncut_result = uncut
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    assert resumed == read(DATASET, Dataset.describe)
    assert {**result, "path": None} == {**uncut_result, "path": None}
