"""What a dataset's rewards are worth: figures and warnings on real relabeled data, and on rewards that are broken."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from read_dataset import read
from tiny_dataset import COLLECTED

from zest_rl.analysis.cross_task import inspect_datasets
from zest_rl.analysis.inspection import Inspection, inspect, labels
from zest_rl.analysis.reward_figures import FIGURES, reward_warnings
from zest_rl.analysis.verdict import Verdict
from zest_rl.data import reader
from zest_rl.data.provenance import RelabelRecord, ScorerRecord
from zest_rl.data.reader import Dataset
from zest_rl.errors import BadInput
from zest_rl.kitchen.views import Views
from zest_rl.metrics import reward_quality, statistics
from zest_rl.metrics.statistics import Estimate
from zest_rl.report.html import render_html
from zest_rl.report.inspection_page import inspection_report
from zest_rl.rewards.relabel import relabel_source
from zest_rl.rewards.scorer import ScorerConfig
from zest_rl.sources.kitchen import kitchen_source

VIEWS = Views("micro", n_views=1, size=96, tolerance=0.05)
CONFIG = ScorerConfig("same-scene")
NEED_TRUTH = {"spearman", "kendall", "pairwise", "auprc", "successes", "epic"}
NEED_NO_TRUTH = {figure.key for figure in FIGURES} - NEED_TRUTH


@pytest.fixture
def scored(collected: str) -> str:
    """The tiny dataset with same-scene scores."""
    return relabel_source(kitchen_source(collected, VIEWS), CONFIG, n_workers=1).dataset_id


def episodes_file(dataset_id: str) -> Path:
    return reader.dataset_path(dataset_id) / "data" / "main_data.hdf5"


def test_figures_are_those_of_the_recorded_scores_and_ground_truth(scored: str) -> None:
    found = inspect(scored)
    returns = np.array([score[1:].sum() for score in read(scored, Dataset.scores)])
    truth = np.array([episode.episode_return for episode in read(scored, Dataset.truth)])
    assert set(found.figures) == {figure.key for figure in FIGURES}
    assert found.figures["spearman"] == statistics.spearman(returns, truth)
    assert found.figures["pairwise"] == reward_quality.pairwise_accuracy(returns, truth)
    assert found.figures["contradictory"].value == 0
    assert found.task == "micro"
    scores, success = read(scored, Dataset.scores), [episode.success for episode in read(scored, Dataset.truth)]
    for name, wanted in (("successes", True), ("failures", False)):
        group = [score[1:] for score, won in zip(scores, success, strict=True) if won == wanted]
        assert (name in found.over_time) == bool(group)
        if group:
            np.testing.assert_allclose(found.over_time[name], np.mean(group, axis=0), rtol=1e-5)


def test_scores_of_other_episodes_are_found_out_without_ground_truth(collected: str) -> None:
    shuffled = relabel_source(kitchen_source(collected, VIEWS), CONFIG, shuffle=0, n_workers=1).dataset_id
    found = inspect(shuffled)
    assert found.figures["contradictory"].value > 0.01
    told, seen = (warning for warning in found.warnings if "shuffle" in warning)
    assert "relabeled with --shuffle" in told
    assert "not of these episodes (shuffled?)" in seen


def test_without_ground_truth_the_rest_is_still_measured(scored: str) -> None:
    with h5py.File(episodes_file(scored), "r+") as file:
        for name in file:
            del file[name]["infos/gt"]
    (reader.dataset_path(scored) / reader.MANIFEST_FILE).unlink()
    found = inspect(scored)
    assert set(found.figures) == NEED_NO_TRUTH
    assert list(found.over_time) == ["all episodes"]
    assert found.true_returns is None
    page = render_html(inspection_report(inspect_datasets([scored], n_workers=1)))
    assert "Contradictory" in page
    assert "Ranking" not in page


FINE, UNDEFINED = Estimate(0.0, 0.0, 0.0), Estimate(np.nan, np.nan, np.nan)
SCORES = [np.array([0.0, 0.5, 1.0], np.float32), np.array([0.0, 0.1, 0.2], np.float32)]


@pytest.mark.parametrize(
    ("figure", "value", "expected"),
    [
        ("contradictory", 0.02, "2% of the frames score otherwise than an equal frame"),
        ("told_by_step", 0.96, "the reward is a clock"),
        ("straight_in_time", 0.93, "nearly proportional to time"),
        ("saturated", 0.96, "most progress is not rewarded"),
        ("still", 0.95, "nothing moves, or the cameras do not see it"),
        ("fallen", 0.6, "60% of the episodes end with a lower score than they began with"),
    ],
)
def test_each_degenerate_reward_has_its_warning(figure: str, value: float, expected: str) -> None:
    figures = dict.fromkeys(NEED_NO_TRUTH, FINE)
    assert reward_warnings(SCORES, figures) == []
    (warning,) = reward_warnings(SCORES, {**figures, figure: Estimate(value, value, value)})
    assert expected in warning


@pytest.mark.parametrize(
    ("rho", "expected"),
    [
        (Estimate(0.2, -0.1, 0.5), "ρ = 0.20, 95 % interval -0.10 to 0.50."),
        (Estimate(-0.6, -0.8, -0.4), "The higher the return, the worse the episode."),
        (UNDEFINED, "All true returns are equal, so they rank nothing"),
    ],
)
def test_returns_that_do_not_rank_the_episodes_are_warned_of(rho: Estimate, expected: str) -> None:
    figures = {**dict.fromkeys((figure.key for figure in FIGURES), FINE), "spearman": Estimate(0.9, 0.8, 0.95)}
    assert reward_warnings(SCORES, figures) == []
    (warning,) = reward_warnings(SCORES, {**figures, "spearman": rho})
    assert expected in warning


def test_constant_scores_and_constant_returns_are_warned_of() -> None:
    figures = dict.fromkeys(NEED_NO_TRUTH, FINE)
    assert "tell nothing apart" in reward_warnings([np.ones(3, np.float32)] * 3, figures)[0]
    nearly = [np.float32(0.7) + np.float32(1e-6) * score for score in SCORES]
    assert "tell nothing apart" in reward_warnings(nearly, figures)[0]
    assert reward_warnings([np.float32(1e-6) * score for score in SCORES], figures) == [], "small is not constant"
    assert reward_warnings([np.float32(0.999) + np.float32(8e-4) * score for score in SCORES], figures) == []
    alike = [np.array([0.0, 1.0], np.float32), np.array([1.0, 0.0], np.float32)]
    assert "same return" in reward_warnings(alike, figures)[0]
    assert len(reward_warnings(alike, {**figures, "spearman": UNDEFINED})) == 1, "nothing more is said of them"


def test_returns_that_follow_the_length_of_the_episode_are_warned_of() -> None:
    figures = dict.fromkeys(NEED_NO_TRUTH, FINE)
    longer = [np.full(length, 0.5, np.float32) + 0.1 * np.arange(length, dtype=np.float32) for length in (2, 5, 9)]
    (warning,) = reward_warnings(longer, figures)
    assert "Episodes are 2 to 9 steps long, and their returns follow the length (ρ = 1.00)" in warning
    changes = [np.array(values, np.float32) for values in ([0.1, 0.4], [0.1] * 5, [0.05] * 8, [0.1] * 9, [0.0] * 10)]
    assert reward_warnings(changes, figures) == []


@pytest.mark.parametrize("views", [{"task": 7}, {"colour": 1}, {"size": "224"}, {"n_views": 1.5}])
def test_views_that_are_not_ours_are_refused(views: dict[str, Any], scored: str) -> None:
    folder = reader.dataset_path(scored)
    metadata = json.loads((folder / reader.METADATA_FILE).read_text())
    metadata["zest"]["relabel"]["scorer"]["config"]["views"] |= views
    (folder / reader.METADATA_FILE).write_text(json.dumps(metadata))
    (folder / reader.MANIFEST_FILE).unlink()
    with pytest.raises(BadInput, match=r"not as this package writes it|was made is not ours"):
        inspect(scored)


def test_differences_are_judged_as_the_trainer_sees_them(collected: str, scored: str) -> None:
    differences = relabel_source(kitchen_source(collected, VIEWS), CONFIG, reward="difference", n_workers=1).dataset_id
    found, level = inspect(differences), inspect(scored)
    last = np.array([score[-1] - score[0] for score in read(differences, Dataset.scores)])
    truth = np.array([episode.episode_return for episode in read(differences, Dataset.truth)])
    assert found.figures["spearman"].value == pytest.approx(statistics.spearman(last, truth).value)
    assert found.figures["contradictory"].value == 0, "levels repeat where states do, differences need not"
    assert found.figures["value_order"] == level.figures["value_order"], "scores rise, whatever is made of them"
    assert found.figures["told_by_step"] != level.figures["told_by_step"]
    assert labels([found, level]) == ["micro by same-scene, reward difference", "micro by same-scene, reward level"]


def test_labels_tell_what_differs() -> None:
    def made(**changes: Any) -> RelabelRecord:
        config = {"goal": "same-scene", "embedder": "e", "features": "delta", "similarity": "cos", "precision": "auto"}
        rest = {"goal_share": 1.0, "goal_sha256": "", "embedder_sha256": "", "views": {"n_views": 8}}
        of_scorer = {name: value for name, value in changes.items() if name not in ("reward", "shuffle")}
        scorer = ScorerRecord(**{**config, **rest, **of_scorer})
        of_rewards = {name: value for name, value in changes.items() if name not in of_scorer}
        return RelabelRecord(**{"source": "", "source_sha256": "", "reward": "level", "scorer": scorer, **of_rewards})

    def named(*records: RelabelRecord) -> list[str]:
        nothing = (Verdict("do not", "", {}), {}, (), {}, np.zeros(0), None, (0.0, 1.0), None, True)
        return labels([Inspection(f"zest/{i}", "micro", record, *nothing) for i, record in enumerate(records)])

    assert named(made()) == ["micro by same-scene"]
    assert named(made(), made(goal="/a/b/drawn")) == ["micro by same-scene", "micro by drawn"]
    assert named(made(), made(features="raw", views={"n_views": 1})) == [
        "micro by same-scene, features delta, views 8",
        "micro by same-scene, features raw, views 1",
    ]
    assert named(made(), made(shuffle=3)) == ["micro by same-scene, shuffled no", "micro by same-scene, shuffled 3"]
    assert named(made(), made()) == ["micro by same-scene (zest/0)", "micro by same-scene (zest/1)"]


def test_what_cannot_be_judged_is_refused(collected: str) -> None:
    with pytest.raises(BadInput, match="holds no ZeST scores; run `zest relabel"):
        inspect(COLLECTED)
    with pytest.raises(BadInput, match="there is no dataset"):
        inspect("zest/nothing-v0")
