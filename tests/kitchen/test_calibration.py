"""How good an expert is, and how imperfect it must be for a level."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from zest_rl.errors import BadInput, ZestError
from zest_rl.kitchen import calibration
from zest_rl.kitchen.behaviour import (
    Behaviour,
    returns,
    rollout,
    run_behaviour,
)
from zest_rl.kitchen.calibration import References, calibrate, measure_references
from zest_rl.kitchen.env import HORIZON
from zest_rl.runtime.arrays import Arrays, concatenate

NOISY = Behaviour("micro", "expert", noise_max=0.6)


@pytest.fixture(autouse=True)
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def first_three() -> dict[str, Any]:
    return concatenate([rollout(NOISY, index) for index in range(3)])


def test_references_come_from_the_expert_and_from_doing_nothing_on_starts_of_their_own(
    monkeypatch: pytest.MonkeyPatch, first_three: Arrays
) -> None:
    monkeypatch.setattr(calibration, "N_NOTHING", 2)
    references = measure_references(NOISY, 2, n_workers=1)
    assert references.expert_success == 1.0
    assert references.minimum < 1.0 < 50.0 < references.expert < HORIZON
    assert references.n_episodes == 2
    episodes = run_behaviour(Behaviour("micro", "expert"), 2, first=calibration.REFERENCE_STREAM, n_workers=1)
    assert references.expert == pytest.approx(returns(episodes).mean())
    assert not set(episodes["seed"]) & set(first_three["seed"])


def test_an_expert_that_is_no_better_than_doing_nothing_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = {"gt_reward": np.zeros((2, 101)), "gt_success": np.zeros((2, 101), bool)}
    monkeypatch.setattr(calibration, "run_behaviour", lambda *args, **kwargs: nothing)
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
    monkeypatch.setattr(calibration, "run_behaviour", curve)
    found = calibrate(NOISY, "noise_max", 7, SCALE, target, tolerance=0.5, on_round=lambda *pair: rounds.append(pair))
    assert 100 * np.exp(-found.noise_max) == pytest.approx(target, abs=0.5)
    assert found == NOISY.with_value("noise_max", found.noise_max)
    assert len(rounds) <= 7
    assert [behaviour.noise_max for behaviour, _ in curve.asked] == [noise for noise, _ in rounds]
    assert rounds[-1][0] == found.noise_max
    assert {(b.task, b.policy, b.seed, n) for b, n in curve.asked} == {("micro", "expert", 0, 7)}


def test_a_level_out_of_reach_is_an_error_that_says_how_near_it_came(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration, "run_behaviour", Curve())
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
    monkeypatch.setattr(calibration, "run_behaviour", curve)
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
    assert 100 * returns(episodes).mean() / 71.0 == pytest.approx(80.0, abs=18.0)
