"""Several inspected datasets: each goal against the episodes of all tasks, and the page and words of the verb."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from read_dataset import read

from tests.conftest import collect_some
from zest_rl.analysis.cross_task import Confusion, confusion, confusion_warnings
from zest_rl.analysis.inspection import inspect
from zest_rl.analysis.verdict import Verdict
from zest_rl.cli import inspect as inspect_verb
from zest_rl.data.reader import Dataset
from zest_rl.kitchen import scene
from zest_rl.kitchen.views import Views
from zest_rl.rewards.relabel import relabel_source
from zest_rl.rewards.scorer import ScorerConfig
from zest_rl.sources.kitchen import kitchen_source

VIEWS = Views("micro", n_views=1, size=96, tolerance=0.05)
CONFIG = ScorerConfig("same-scene")


@pytest.fixture
def scored(collected: str) -> str:
    """The tiny dataset with same-scene scores."""
    return relabel_source(kitchen_source(collected, VIEWS), CONFIG, n_workers=1).dataset_id


@pytest.fixture
def of_two_tasks(collected: str, zest: Callable[..., dict[str, Any]]) -> tuple[str, str]:
    """The tiny microwave dataset and one of the sliding door, each with scores of its own scene."""
    other = "zest/kitchen-sdoor-tiny-v0"
    collect_some(other, "sdoor", 3)
    small = ("--views", 1, "--tolerance", 0.05, "--n-workers", 1)
    return zest("relabel", collected, *small)["dataset"], zest("relabel", other, *small)["dataset"]


def test_each_goal_scores_the_ends_of_all_tasks_as_their_own_views_show_them(
    collected: str, scored: str, of_two_tasks: tuple[str, str]
) -> None:
    inspections = [inspect(dataset) for dataset in (*of_two_tasks, scored)]
    done: list[None] = []
    compared = confusion(inspections, n_workers=1, on_done=lambda: done.append(None))
    assert len(done) == 3
    ids = collected, "zest/kitchen-sdoor-tiny-v0"
    assert list(compared.sources.items()) == [
        ((ids[0], read(ids[0], Dataset.fingerprint)), "micro"),
        ((ids[1], read(ids[1], Dataset.fingerprint)), "sdoor"),
    ]
    assert compared.row_names() == ("micro", "sdoor")
    assert compared.own_rows == (0, 1, 0), "what was relabeled twice is one row"
    means = compared.means
    assert means.shape == (2, 3)
    for i, dataset in enumerate(of_two_tasks):
        own = np.mean([score[-1] for score in read(dataset, Dataset.scores)])
        assert means[i, i] == pytest.approx(own, abs=1e-5)
        assert means[i, i] > means[1 - i, i], "an open door looks more like itself than like another one"
        assert means[1 - i, i] != 0, "something is seen to change"
    assert confusion_warnings(inspections, compared) == {}
    assert (compared.low <= means).all()
    assert (means <= compared.high).all()
    found = confusion_warnings(inspections, replace(compared, means=means[::-1]))
    assert set(found) == {*of_two_tasks, scored}
    assert "the episodes of sdoor higher" in found[of_two_tasks[0]]


def test_a_goal_that_scores_another_task_higher_is_told_though_a_sibling_scores_highest(
    of_two_tasks: tuple[str, str],
) -> None:
    inspections = [inspect(dataset) for dataset in of_two_tasks]
    a, b, c = ("zest/a-v0", "1" * 64), ("zest/b-v0", "2" * 64), ("zest/c-v0", "3" * 64)
    means = np.array([[0.3, 0.1], [0.9, 0.1], [0.5, 0.8]], np.float32)
    found = Confusion({a: "micro", b: "micro", c: "sdoor"}, (0, 2), means, means - 0.01, means + 0.01)
    assert confusion_warnings(inspections, found) == {
        of_two_tasks[0]: "Its goal scores the episodes of sdoor higher (0.50) than its own (0.30)."
    }
    assert found.row_names() == ("micro (zest/a-v0)", "micro (zest/b-v0)", "sdoor")
    alike = np.full((3, 2), 0.8, np.float32)
    told = confusion_warnings(inspections, replace(found, means=alike, low=alike - 0.01, high=alike + 0.01))
    assert set(told) == set(of_two_tasks)
    assert "every task alike (0.80 to 0.80)" in told[of_two_tasks[0]]
    again = replace(found, sources={a: "micro", (a[0], b[1]): "micro", c: "sdoor"})
    assert again.row_names() == ("micro (zest/a-v0, 11111111)", "micro (zest/a-v0, 22222222)", "sdoor")


def test_the_page_shows_tasks_against_goals_and_does_without_where_scorers_are_of_another_version(
    of_two_tasks: tuple[str, str],
    tmp_path: Path,
    zest: Callable[..., dict[str, Any]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    words = ("inspect", *of_two_tasks, "--output", tmp_path / "page.html", "--n-workers", 1)
    found = zest(*words)["goals_against_tasks"]
    assert found["by_goal_of"] == list(of_two_tasks)
    assert found["episodes_of"][1] == "zest/kitchen-sdoor-tiny-v0"
    matrix = found["mean_scores"]
    assert np.shape(matrix) == (2, 2)
    page = (tmp_path / "page.html").read_text()
    assert "<h2>Tasks against goals</h2>" in page
    assert f"<b>{matrix[1][1]:.2f}</b>" in page
    low, high = found["ci95"][1][1]
    assert low <= matrix[1][1] <= high
    monkeypatch.setattr(scene, "_RENDERER_VERSION", -1)
    (tmp_path / "page.html").unlink()  # else it is found made
    assert zest(*words)["goals_against_tasks"] is None
    assert "<h2>Frames</h2>" not in (tmp_path / "page.html").read_text()
    assert "<h2>Reward quality</h2>" in (tmp_path / "page.html").read_text()


def test_the_verb_prints_figures_warns_and_leaves_a_page(
    collected: str, scored: str, tmp_path: Path, zest: Callable[..., dict[str, Any]]
) -> None:
    shuffled = relabel_source(kitchen_source(collected, VIEWS), CONFIG, shuffle=0, n_workers=1).dataset_id
    result = zest("inspect", scored, shuffled, "--output", tmp_path / "page.html")
    assert set(result["datasets"]) == {scored, shuffled}
    figure = result["datasets"][scored]["figures"]["value_order"]
    assert figure["ci95"][0] <= figure["value"] <= figure["ci95"][1]
    verdicts = [result["verdicts"][dataset] for dataset in (scored, shuffled)]
    assert [verdict["advice"] for verdict in verdicts] == ["too few episodes to tell", "do not"]
    assert verdicts[1]["why"] == "these are the scores of other episodes"
    said = inspect_verb.summary(result).splitlines()
    assert said[0] == f"{scored}: {Verdict.from_json(verdicts[0])}", "the verdict comes first"
    assert "R² of a linear trend. Of score over time in an episode; 1 is proportional to time." in "\n".join(said)
    assert any("shuffled?" in warning for warning in result["warnings"][shuffled])
    assert not any("shuffled?" in warning for warning in result["warnings"][scored])
    assert result["goals_against_tasks"] is None, "both are of one task"
    page = (tmp_path / "page.html").read_text()
    assert page.count("data:video/mp4") == 2
    assert page.count('class="strip"') == 2, "best and worst; the shuffled scores are not those of what is seen"
    assert page.index("these are the scores of other episodes") < page.index("<h2>Warnings</h2>")
    for heading in (
        "Verdict",
        "Warnings",
        "Reward quality",
        "Ranking",
        "Frames",
        "Views",
        "Pixels",
        "Scores over time",
    ):
        assert f"<h2>{heading}</h2>" in page
    json.dumps(result, allow_nan=False)
