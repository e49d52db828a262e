"""Studies: a grid of `zest select` from one recipe, beside the paper's figures."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from zest_rl.analysis.learned_rewards import judge_learned_reward
from zest_rl.cli.reproduce.reward_study import figures, read_reward_study
from zest_rl.cli.reproduce.study import read_study
from zest_rl.cli.reproduce.study_tables import as_markdown, mean_over_tasks
from zest_rl.errors import BadInput
from zest_rl.kitchen import calibration

RECIPE = """
study = "goals"
title = "A tiny study"
caveats = ["Tiny."]

[collect]
task = "micro"
n_episodes = 4
noise_max = 1.0
dataset = "zest/kitchen-micro-whole-v0"

[select]
views = 1
tolerance = 0.05
n_frames = 60
top = 3

[grid]
pool = ["single", "all"]
goal = ["same-scene", "drawings"]

[paper]
"SGSD, CLIP" = { micro = 92.0 }
"""


def write(folder: Path, text: str = RECIPE) -> Path:
    path = folder / "study.toml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def _data(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """One Minari root and cache for all studies here: the first collects and embeds. Few starts judge the expert."""
    root = tmp_path_factory.mktemp("data")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root / "minari"))
        patch.setenv("ZEST_CACHE", str(root / "cache"))
        patch.setattr(calibration, "N_REFERENCE", 2)
        patch.setattr(calibration, "N_NOTHING", 1)
        yield


@pytest.mark.usefixtures("_data")
def test_a_study_selects_in_every_cell_and_puts_the_paper_beside(
    tmp_path: Path, zest: Callable[..., dict[str, Any]]
) -> None:
    words = ("reproduce", write(tmp_path), "--output", tmp_path / "out", "--n-workers", "1")
    result = zest(*words)
    assert [row["name"] for row in result["rows"]] == [
        f"pool {pool}, goal {goal}" for pool in ("single", "all") for goal in ("same-scene", "drawings")
    ]
    alone = zest(
        "select", "goals", "zest/kitchen-micro-whole-v0", "--views", 1, "--tolerance", 0.05, "--n-frames", 60,
        "--top", 3, "--goal", "drawings", "--n-workers", 1,
    )  # fmt: skip
    assert result["rows"][1]["tasks"]["micro"] == alone
    assert result["rows"][1]["mean"]["top_n_success"] == alone["top_n_success"]["value"]
    assert result["rows"][3]["tasks"] == result["rows"][1]["tasks"], "of one task, all tasks are the single one"
    assert result["paper"] == {"SGSD, CLIP": {"micro": 92.0}}
    assert alone["n_repeats"] == 1, "nothing was drawn"
    assert result["rows"][1]["mean"]["top_n_standard_error_of_repeats"] is None
    assert json.loads((tmp_path / "out" / "result.json").read_text())["rows"] == result["rows"]
    table = (tmp_path / "out" / "table.md").read_text()
    assert table == as_markdown(result)
    for line in ("| | micro | mean |", "| paper: SGSD, CLIP | 92.0 | 92.0 |", "| at random, pool single |"):
        assert line in table
    page = (tmp_path / "out" / "report.html").read_text()
    for part in ("A tiny study", "paper: SGSD, CLIP", "at random, pool all", "Tiny."):
        assert part in page
    assert zest(*words)["rows"] == result["rows"]
    recipe = write(
        tmp_path,
        'verb = "select goals"\ndatasets = ["zest/kitchen-micro-whole-v0"]\nviews = 1\ntolerance = 0.05\n'
        'n_frames = 60\ntop = 3\ngoal = "drawings"\n',
    )
    of_verb = zest("reproduce", recipe, "--output", tmp_path / "verb", "--n-workers", "1")
    assert {key: of_verb[key] for key in alone} == alone
    assert json.loads((tmp_path / "verb" / "result.json").read_text())["top_n_success"] == alone["top_n_success"]
    assert [path.name for path in (tmp_path / "verb").iterdir()] == ["result.json"], "select has no page"


@pytest.mark.usefixtures("_data")
def test_the_mean_of_repeats_has_a_standard_error_over_them(
    tmp_path: Path, zest: Callable[..., dict[str, Any]]
) -> None:
    drawn = RECIPE.replace("top = 3", "top = 3\nn_goals = 1\nn_repeats = 3").replace('"same-scene", ', "")
    result = zest("reproduce", write(tmp_path, drawn), "--output", tmp_path / "out", "--n-workers", "1")
    row = result["rows"][0]
    by_repeat = row["tasks"]["micro"]["top_n_by_repeat"]
    assert len(by_repeat) == row["tasks"]["micro"]["n_repeats"] == 3
    assert row["mean"]["top_n_success"] == pytest.approx(np.mean(by_repeat))
    error = np.std(by_repeat, ddof=1) / np.sqrt(3)
    assert row["mean"]["top_n_standard_error_of_repeats"] == pytest.approx(error)
    assert f"± {100 * error:.1f} |" in (tmp_path / "out" / "table.md").read_text()


def test_standard_errors_are_over_tasks_and_over_the_repeats_of_their_mean() -> None:
    cells = {
        task: {
            "top_n_success": {"value": float(np.mean(repeats))},
            "relative_variation": {"value": 0.5},
            "goal_frame_ratio": 0.1,
            "top_n_by_repeat": repeats,
        }
        for task, repeats in {"micro": [0.1, 0.5, 0.9], "sdoor": [0.3, 0.3, 0.6]}.items()
    }
    mean = mean_over_tasks(cells)
    assert mean["top_n_success"] == pytest.approx(0.45)
    assert mean["top_n_standard_error"] == pytest.approx(np.std([0.5, 0.4], ddof=1) / np.sqrt(2))
    assert mean["top_n_standard_error_of_repeats"] == pytest.approx(np.std([0.2, 0.4, 0.75], ddof=1) / np.sqrt(3))


def test_the_papers_mean_is_over_the_columns_that_are_shown() -> None:
    cell = {"top_n_success": {"value": 0.5}, "relative_variation": {"value": 0.5}, "goal_frame_ratio": 0.1}
    mean = {"top_n_success": 0.5, "relative_variation": 0.5, "goal_frame_ratio": 0.1}
    row = {
        "name": "a",
        "pool": "single",
        "tasks": {"oven": cell},
        "mean": mean | {"top_n_standard_error_of_repeats": None},
    }
    result = {"rows": [row], "paper": {"here": {"oven": 40.0, "door": 90.0}, "elsewhere": {"door": 90.0}}}
    table = as_markdown(result)
    assert "| paper: here | 40.0 | 40.0 |" in table
    assert "elsewhere" not in table


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('study = "goals"', 'study = "goal"', "'study' must be"),
        ('pool = ["single", "all"]', 'pool = ["every"]', "unknown pool 'every'"),
        ("top = 3", "tops = 3", "unknown key 'tops'; did you mean 'top'"),
        ('"drawings"]', '"drawing"]', "unknown goal 'drawing'"),
        ("micro = 92.0", "sdoor = 92.0", "there is no task 'sdoor' here"),
        (
            '[grid]\npool = ["single", "all"]\ngoal = ["same-scene", "drawings"]',
            "[grid]\npool = []",
            "at least 1 value",
        ),
        ("top = 3", 'task = "micro"', "'task' is not for a recipe to set"),
        ("top = 3", 'similarity = "l2"\nfeatures = "progress"', "bring a similarity of their own"),
        ("top = 3", "n-repeats = 0", "must be at least 1"),
        ('study = "goals"', 'study = "footage"', "one of footage takes none"),
        ("{ micro = 92.0 }", "{}", "every row needs the figure of at least 1 task"),
    ],
)
def test_a_wrong_study_is_refused_before_anything_runs(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in RECIPE
    with pytest.raises(BadInput, match=message):
        read_study(write(tmp_path, RECIPE.replace(old, new)))


LEARNED = """
study = "trex"
title = "A tiny study of rewards"
caveats = ["Tiny."]

[collect]
task = "micro"
n_episodes = 4
noise_max = 1.0
dataset = "zest/kitchen-micro-whole-v0"

[relabel]
goal = "same-scene"
views = 1
tolerance = 0.05

[rankings."Cos+Delta"]
[rankings."shuffled"]
shuffle = 0

[train]
n_updates = 10
hidden_size = 8
snippet_len = 10
threads = 1
device = "cpu"

[inputs.obs]
[inputs.embeddings]

[paper."ResNet, raw Cos"]
micro = 84.88
"""


@pytest.mark.usefixtures("_data")
def test_a_study_learns_rewards_from_every_ranking_and_judges_them_beside_the_plain_sums(
    tmp_path: Path, zest: Callable[..., dict[str, Any]]
) -> None:
    words = ("reproduce", write(tmp_path, LEARNED), "--output", tmp_path / "out", "--n-workers", "1")
    result = zest(*words)
    rows = {(row["ranking"], row["inputs"]): row["tasks"]["micro"] for row in result["rows"]}
    assert list(rows) == [(r, i) for r in ("Cos+Delta", "shuffled") for i in ("obs", "embeddings")]
    assert all(0 <= row["accuracy"] <= 1 for row in rows.values())
    assert rows["Cos+Delta", "obs"]["plain"] == rows["Cos+Delta", "embeddings"]["plain"], (
        "both learned from these scores"
    )

    best = result["returns"]
    judged = judge_learned_reward(next(run for run in (tmp_path / "out" / "runs").iterdir() if is_of(run, best)))
    assert figures(judged) == rows[best["ranking"], best["inputs"]]
    assert best["tasks"]["micro"]["held_out"] == np.flatnonzero(judged.held_out).tolist()
    np.testing.assert_allclose(best["tasks"]["micro"]["learned"], judged.learned_returns, atol=0.005)
    np.testing.assert_allclose(best["tasks"]["micro"]["true"], judged.true_returns, atol=0.005)

    table = (tmp_path / "out" / "table.md").read_text()
    assert f"| T-REX of obs, ranked by shuffled | {100 * rows['shuffled', 'obs']['accuracy']:.1f} |" in table
    assert f"| plain sum of Cos+Delta | {100 * rows['Cos+Delta', 'obs']['plain']:.1f} |" in table
    assert "| paper: ResNet, raw Cos | 84.9 | 84.9 |" in table
    html = (tmp_path / "out" / "report.html").read_text()
    assert all(f"micro: {i}, {r}, {w}" in html for r, i in rows for w in ("seen", "unseen"))
    written = {run: (run / "meta.json").stat().st_mtime_ns for run in (tmp_path / "out" / "runs").iterdir()}
    assert zest(*words)["rows"] == result["rows"]
    assert written == {run: (run / "meta.json").stat().st_mtime_ns for run in written}, "finished runs are found again"


def is_of(run: Path, row: dict[str, Any]) -> bool:
    """Whether a run is that of a row."""
    meta = json.loads((run / "meta.json").read_text())
    is_shuffled = meta["dataset"]["zest"]["relabel"]["shuffle"] is not None
    return (meta["config"]["inputs"], is_shuffled) == (row["inputs"], row["ranking"] == "shuffled")


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("shuffle = 0", "shufle = 0", "unknown key 'shufle'; did you mean 'shuffle'"),
        ("[inputs.obs]", "[inputs.pixels]", "inputs"),
        ("[inputs.obs]", '[inputs.obs]\nrun_dir = "here"', "'run_dir' is not for a recipe to set"),
        ("shuffle = 0", 'dataset = "a/b-v0"', "[rankings.'shuffled']: 'dataset' is not for a recipe to set"),
        ("snippet_len = 10", "snippet_len = 0", "snippet_len must be 1 to"),
    ],
)
def test_a_wrong_study_of_rewards_is_refused_before_anything_runs(
    old: str, new: str, complaint: str, tmp_path: Path
) -> None:
    assert LEARNED.count(old) == 1
    with pytest.raises(BadInput, match=re.escape(complaint)):
        read_reward_study(write(tmp_path, LEARNED.replace(old, new)))
