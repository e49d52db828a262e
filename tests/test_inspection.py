"""What a dataset's rewards are worth: figures and warnings on real relabeled data, and on rewards that are broken."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.conftest import COLLECTED
from zest_rl import data, metrics, quality
from zest_rl.errors import BadInput
from zest_rl.frames import Views
from zest_rl.inspection import FIGURES, confusion, confusion_warnings, inspect, inspection_report, warnings
from zest_rl.metrics import Estimate
from zest_rl.relabel import relabel
from zest_rl.report import render_html
from zest_rl.scorer import ScorerConfig

VIEWS = Views("micro", n_views=1, size=96, tolerance=0.05)
CONFIG = ScorerConfig(VIEWS, "same-scene")
NEEDS_TRUTH = {figure.name for figure in FIGURES if figure.needs_truth}


@pytest.fixture
def scored(collected: str) -> str:
    """The tiny dataset with same-scene scores."""
    return relabel(collected, CONFIG, n_workers=1).dataset_id


def episodes_file(dataset_id: str) -> Path:
    return data.dataset_path(dataset_id) / "data" / "main_data.hdf5"


def test_figures_are_those_of_the_recorded_scores_and_ground_truth(scored: str) -> None:
    found = inspect(scored)
    returns = np.array([score[1:].sum() for score in data.read_scores(scored)])
    truth = np.array([episode.episode_return for episode in data.read_ground_truth(scored)])
    assert set(found.figures) == {figure.name for figure in FIGURES}
    assert found.figures["Spearman ρ"] == metrics.spearman(returns, truth)
    assert found.figures["Pairwise accuracy"] == quality.pairwise_accuracy(returns, truth)
    assert found.figures["Contradictory"].value == 0
    assert (found.label, found.has_truth) == ("micro by same-scene", True)
    scores, success = data.read_scores(scored), [episode.success for episode in data.read_ground_truth(scored)]
    for name, wanted in (("successes", True), ("failures", False)):
        group = [score[1:] for score, won in zip(scores, success, strict=True) if won == wanted]
        assert (name in found.over_time) == bool(group)
        if group:
            np.testing.assert_allclose(found.over_time[name], np.mean(group, axis=0), rtol=1e-5)


def test_scores_of_other_episodes_are_found_out_without_ground_truth(collected: str) -> None:
    shuffled = relabel(collected, CONFIG, shuffle=0, n_workers=1).dataset_id
    found = inspect(shuffled)
    assert found.label == "micro by same-scene, shuffled"
    assert found.figures["Contradictory"].value > 0.01
    assert any("not of these episodes (shuffled?)" in warning for warning in found.warnings)


def test_without_ground_truth_the_rest_is_still_measured(scored: str) -> None:
    with h5py.File(episodes_file(scored), "r+") as file:
        for name in file:
            del file[name]["infos/gt"]
    (data.dataset_path(scored) / data.MANIFEST_FILE).unlink()
    found = inspect(scored)
    assert set(found.figures) == {figure.name for figure in FIGURES} - NEEDS_TRUTH
    assert list(found.over_time) == ["all episodes"]
    assert not found.has_truth
    page = render_html(inspection_report([found], None, {}))
    assert "Contradictory" in page
    assert "Ranking" not in page


FINE = Estimate(0.0, 0.0, 0.0)
SCORES = [np.array([0.0, 0.5, 1.0], np.float32), np.array([0.0, 0.1, 0.2], np.float32)]


@pytest.mark.parametrize(
    ("figure", "value", "expected"),
    [
        ("Contradictory", 0.02, "2% of the frames score otherwise than an equal frame"),
        ("Told by the step", 0.96, "the reward is a clock"),
        ("Saturated", 0.96, "most progress is not rewarded"),
        ("Nothing to see", 0.95, "nothing moves, or the cameras do not see it"),
    ],
)
def test_each_degenerate_reward_has_its_warning(figure: str, value: float, expected: str) -> None:
    figures = dict.fromkeys((figure.name for figure in FIGURES if not figure.needs_truth), FINE)
    assert warnings(SCORES, figures) == []
    (warning,) = warnings(SCORES, {**figures, figure: Estimate(value, value, value)})
    assert expected in warning


@pytest.mark.parametrize(
    ("rho", "expected"),
    [
        (Estimate(0.2, -0.1, 0.5), "ρ = 0.20, 95 % interval -0.10 to 0.50."),
        (Estimate(-0.6, -0.8, -0.4), "The higher the return, the worse the episode."),
        (Estimate(np.nan, np.nan, np.nan), "do not rank the episodes"),
    ],
)
def test_returns_that_do_not_rank_the_episodes_are_warned_of(rho: Estimate, expected: str) -> None:
    figures = {**dict.fromkeys((figure.name for figure in FIGURES), FINE), "Spearman ρ": Estimate(0.9, 0.8, 0.95)}
    assert warnings(SCORES, figures) == []
    (warning,) = warnings(SCORES, {**figures, "Spearman ρ": rho})
    assert expected in warning


def test_constant_scores_and_constant_returns_are_warned_of() -> None:
    figures = dict.fromkeys((figure.name for figure in FIGURES if not figure.needs_truth), FINE)
    assert "tell nothing apart" in warnings([np.ones(3, np.float32)] * 3, figures)[0]
    alike = [np.array([0.0, 1.0], np.float32), np.array([1.0, 0.0], np.float32)]
    assert "same return" in warnings(alike, figures)[0]


def test_a_goal_that_prefers_another_task_is_named(
    collected: str, scored: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = relabel(collected, replace(CONFIG, goal="drawings"), n_workers=1).dataset_id
    done: list[None] = []
    means = confusion((scored, wrong), on_done=lambda: done.append(None))
    assert len(done) == 2
    assert means.shape == (2, 2)
    ends = [np.mean([score[-1] for score in data.read_scores(dataset)]) for dataset in (scored, wrong)]
    np.testing.assert_allclose(means, np.tile(ends, (2, 1)), rtol=1e-4)  # both datasets hold the same episodes
    preferring = np.array([[0.1, 0.9], [0.4, 0.3]], np.float32)
    assert confusion_warnings((scored, wrong), preferring) == {}, "two goals of one task are no rivals"
    monkeypatch.setattr(data, "task_name", {scored: "micro", wrong: "sdoor"}.__getitem__)
    found = confusion_warnings((scored, wrong), preferring)
    assert set(found) == {scored, wrong}
    assert f"episodes of {wrong} higher (0.40) than its own (0.10)" in found[scored]
    assert confusion_warnings((scored, wrong), np.eye(2, dtype=np.float32)) == {}


def test_the_verb_prints_figures_warns_and_leaves_a_page(
    collected: str, scored: str, tmp_path: Path, zest: Callable[..., dict[str, Any]]
) -> None:
    shuffled = relabel(collected, CONFIG, shuffle=0, n_workers=1).dataset_id
    result = zest("inspect", scored, shuffled, "--output", tmp_path / "page.html")
    assert set(result["datasets"]) == {scored, shuffled}
    figure = result["datasets"][scored]["figures"]["Value-order correlation"]
    assert figure["ci95"][0] <= figure["value"] <= figure["ci95"][1]
    assert any("shuffled?" in warning for warning in result["warnings"][shuffled])
    assert not any("shuffled?" in warning for warning in result["warnings"][scored])
    assert result["goals_against_tasks"] is None, "both are of one task"
    page = (tmp_path / "page.html").read_text()
    for heading in ("Warnings", "Reward quality", "Ranking", "Scores over time"):
        assert f"<h2>{heading}</h2>" in page
    json.dumps(result, allow_nan=False)


def test_what_cannot_be_judged_is_refused(collected: str) -> None:
    with pytest.raises(BadInput, match="holds no ZeST scores; run `zest relabel"):
        inspect(COLLECTED)
    with pytest.raises(BadInput, match="there is no dataset"):
        inspect("zest/nothing-v0")
