"""Evaluated runs → the report that compares them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from read_dataset import read
from tiny_dataset import COLLECTED

from zest_rl.data import reader
from zest_rl.data.reader import Dataset
from zest_rl.errors import BadInput
from zest_rl.evaluation.evaluate import EvaluationConfig, evaluate
from zest_rl.metrics import statistics
from zest_rl.report.comparison_page import compare, dataset_row, gain, learning_curve, method_row, return_curve
from zest_rl.report.episodes import paired_episodes
from zest_rl.report.goals import goal_panel, goal_scatter
from zest_rl.report.methods import Method, latest_evaluation, methods_of_runs
from zest_rl.report.sections import CAVEATS, DETAILS, EPISODES, GOALS, LEARNING_CURVES, RESULTS
from zest_rl.runtime.arrays import read_arrays, write_arrays
from zest_rl.simulation.videos import Video

CONFIG = EvaluationConfig(n_episodes=2, seed=11, rtg="constant")


@pytest.fixture(autouse=True)
def _short(short_videos: None) -> None:
    """Nobody looks at these videos."""


@pytest.fixture
def evaluated(trained: Path) -> Path:
    for name in ("bc-0", "bc-1", "dt-0"):
        evaluate(trained / name, CONFIG, n_workers=1)
    return trained


def edit(run: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    meta = json.loads((run / "meta.json").read_text())
    change(meta)
    (run / "meta.json").write_text(json.dumps(meta))
    return run


def scored_dataset(runs: Path) -> str:
    return str(json.loads((runs / "dt-0" / "meta.json").read_text())["dataset"]["id"])


def test_a_report_compares_methods_with_the_dataset_and_shows_goal_episodes_and_losses(evaluated: Path) -> None:
    methods = methods_of_runs([evaluated / name for name in ("bc-0", "bc-1", "dt-0")])
    report = compare("T", methods, source_id=COLLECTED, goals={"scene": scored_dataset(evaluated)}, caveats=["small"])
    assert [(row.method, row.kind, row.n_seeds, row.n_episodes) for row in report.items(RESULTS)] == [
        ("Demo", "dataset", 1, 4),
        ("BC", "method", 2, 4),
        ("DT on same-scene", "method", 1, 2),
    ]
    single, paired = report.items(EPISODES)[:6], report.items(EPISODES)[6:]
    assert [panel.title for panel in single] == [
        f"{method}: {which}" for method in ("BC", "DT on same-scene") for which in ("best", "median", "worst")
    ]
    assert all(panel.video.stat().st_size > 0 for panel in report.items(EPISODES))
    assert all(panel.scores is not None and len(panel.scores) == len(panel.gt_progress) for panel in single)
    clone, other = (latest_evaluation(evaluated / name) for name in ("bc-0", "dt-0"))
    gains = other.returns() - clone.returns()
    for panel, which, index in zip(paired, ("best", "median", "worst"), np.argsort(-gains)[[0, 1, 1]], strict=True):
        assert panel.title.startswith(f"BC (left, {clone.returns()[index]:.0f} %) beside DT on same-scene (right)")
        assert panel.title.endswith(f"{which} gain")
        assert panel.seed == clone.episodes[index].seed == other.episodes[index].seed
        np.testing.assert_array_equal(panel.gt_progress, other.traces["gt_reward"][index])
        assert panel.beside is not None
        np.testing.assert_array_equal(panel.beside[1], clone.traces["gt_reward"][index])
    assert [goal.name for goal in report.items(GOALS)] == ["scene"]
    curves = report.items(LEARNING_CURVES)
    assert [curve.name for curve in curves] == ["BC", "DT on same-scene"]
    assert curves[0].band is not None, "two seeds have a range"
    assert curves[1].band is None
    assert report.items(CAVEATS) == ("small",)
    data, clone, dt = report.items(RESULTS)
    difference = gain([methods[0].evaluations()], [methods[1].evaluations()])
    assert difference is not None
    assert report.summary.startswith(
        f"Trained on the same 4 episodes, which themselves reach {data.mean:.0f} % of the expert, DT on same-scene, "
        f"which learned from a picture's rewards, reaches {dt.mean:.0f} % and behaviour cloning {clone.mean:.0f} %: "
        f"{abs(difference.value):.1f} points {'more' if difference.value >= 0 else 'less'} from the same starts"
    )
    assert {"run bc-0", "run bc-1", "run dt-0"} <= dict(report.items(DETAILS)).keys()


def test_a_gain_is_paired_by_start_and_over_seeds(evaluated: Path) -> None:
    one, two, other = (latest_evaluation(evaluated / name) for name in ("bc-0", "bc-1", "dt-0"))
    by_seed = gain([[one, two]], [[other, other]])
    assert by_seed is not None
    assert by_seed.value == pytest.approx((other.returns() - (one.returns() + two.returns()) / 2).mean())
    assert gain([[one]], [[other]]) == statistics.bootstrap([other.returns() - one.returns()])
    assert gain([[one, one]], [[other]]) == gain([[one]], [[other]]), "unequally many seeds: their means"
    assert gain([[one]], [[replace(other, config=replace(other.config, seed=99))]]) is None


def test_a_row_sums_up_the_episodes_of_all_its_seeds(evaluated: Path) -> None:
    groups = [latest_evaluation(evaluated / name) for name in ("bc-0", "bc-1")]
    row = method_row(Method("BC", (), "control", "a note", 80.67), groups)
    values = np.concatenate([group.returns() for group in groups])
    assert (row.mean, row.iqm) == pytest.approx((values.mean(), float(statistics.iqm(values))))
    assert row.ci_low <= row.mean <= row.ci_high
    assert row.success_rate == np.mean([episode.success for group in groups for episode in group.episodes])
    assert (row.kind, row.note, row.paper_value) == ("control", "a note", 80.67)


def test_the_dataset_s_own_row_is_its_normalized_ground_truth(trained: Path) -> None:
    row = dataset_row(scored_dataset(trained), paper=81.19)
    truth = read(COLLECTED, Dataset.truth)
    assert row.mean == pytest.approx(np.mean([100 * episode.episode_return / 70 for episode in truth]))
    assert row.success_rate == np.mean([episode.success for episode in truth])
    assert (row.method, row.n_episodes, row.paper_value) == ("Demo", 4, 81.19)


def test_a_goal_is_judged_by_how_its_returns_rank_the_episodes(trained: Path) -> None:
    with reader.open_dataset(scored_dataset(trained)) as ds:
        scatter = goal_scatter("scene", ds)
        returns = [rewards.sum() for rewards in ds.rewards()]
        truth = [episode.episode_return for episode in ds.truth()]
        assert ds.record.relabel is not None
        panel = goal_panel("scene", ds.record.relabel, ds.path, scatter)
    np.testing.assert_allclose(scatter.y, returns, rtol=1e-5)
    np.testing.assert_allclose(scatter.x, truth, rtol=1e-5)
    assert scatter.spearman == pytest.approx(statistics.spearman(scatter.y, scatter.x).value)
    assert (len(panel.start), len(panel.goal), panel.n_episodes) == (1, 1, 4)
    assert not np.array_equal(panel.start[0], panel.goal[0])


def test_policies_are_shown_side_by_side_only_on_equal_starts(evaluated: Path) -> None:
    clone, other = (latest_evaluation(evaluated / name) for name in ("bc-0", "dt-0"))
    elsewhere = replace(other, config=replace(other.config, seed=99))
    videos: list[Video] = []

    def film(video: Video) -> Path:
        videos.append(video)
        return video.path

    assert [panel.video for panel in paired_episodes(("BC", clone), ("DT", other), film)] == [v.path for v in videos]
    assert len(videos) == 3
    assert all(video.beside is not None for video in videos)
    assert paired_episodes(("BC", clone), ("DT", elsewhere), film) == []


def test_a_return_curve_holds_the_snapshots_that_were_evaluated_in_every_run(trained: Path) -> None:
    runs = (trained / "bc-0", trained / "bc-1")
    method = Method("BC", runs, evaluation=CONFIG)
    for run in runs:
        evaluate(run, CONFIG, n_workers=1)
    assert return_curve(method) is None, "without snapshots there is one point only"
    own = ["snapshots", "metrics.csv", "tb"]
    for run, steps in zip(runs, ((1, 2), (1,)), strict=True):
        for step in steps:
            snapshot = shutil.copytree(run, run / "snapshots" / f"update-{step:09d}", ignore=lambda *_: own)
            edit(snapshot, lambda meta, step=step: meta.update(n_updates=step))  # type: ignore[misc]
            (stored,) = snapshot.glob("evaluations/*/result.json")
            (part,) = stored.parent.glob("parts/*.npz")
            arrays = read_arrays(part) or {}
            arrays["gt_reward"][:, -1] -= 10.0 * step
            write_arrays(part, arrays)
            result = json.loads(stored.read_text())
            for episode, rewards in zip(result["episodes"], arrays["gt_reward"], strict=True):
                episode["gt_return"] = float(rewards[1:].sum(dtype=np.float64))
            stored.write_text(json.dumps(result))
    evaluate(runs[0] / "snapshots" / "update-000000002", replace(CONFIG, seed=77), n_workers=1)
    evaluation = latest_evaluation(runs[0])
    fall = 100 * 10.0 / (evaluation.expert - evaluation.minimum)
    means = [latest_evaluation(run).returns().mean() for run in runs]
    for asked in (CONFIG, None):
        curve = return_curve(replace(method, evaluation=asked))
        assert curve is not None
        assert curve.steps.tolist() == [1, float(json.loads((runs[0] / "meta.json").read_text())["n_updates"])]
        np.testing.assert_allclose(curve.values, [np.mean(means) - fall, np.mean(means)], rtol=1e-5, atol=1e-4)
        assert curve.band is not None
        np.testing.assert_allclose(curve.band[0], [min(means) - fall, min(means)], rtol=1e-5, atol=1e-4)
    snapshot = runs[0] / "snapshots" / "update-000000001"
    report = compare("one policy on the way", methods_of_runs([snapshot]), source_id=None, goals={})
    assert [row.n_episodes for row in report.items(RESULTS)] == [2]
    assert report.items(LEARNING_CURVES) == (), "a snapshot has no log of its own"


def test_too_few_episodes_to_rank_are_no_failure(trained: Path) -> None:
    with reader.open_dataset(scored_dataset(trained)) as ds:
        two = replace(ds, groups={name: ds.groups[name] for name in list(ds.groups)[:2]})
        assert np.isnan(goal_scatter("scene", two).spearman)


def test_a_learning_curve_is_the_mean_of_the_logged_losses_with_their_range(trained: Path) -> None:
    runs = (trained / "bc-0", trained / "bc-1")
    curve = learning_curve(Method("BC", runs))
    assert curve is not None
    logs = [np.genfromtxt(run / "metrics.csv", delimiter=",", names=True) for run in runs]
    losses = np.stack([log["loss"] for log in logs])
    np.testing.assert_array_equal(curve.steps, logs[0]["update"])
    np.testing.assert_allclose(curve.values, losses.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(curve.band, [losses.min(axis=0), losses.max(axis=0)], rtol=1e-6)


# --- which runs are one method ----------------------------------------------------------------------------------------


def test_runs_that_differ_in_their_seed_alone_are_one_method(trained: Path) -> None:
    runs = [trained / name for name in ("dt-0", "bc-1", "gt-0", "bc-0")]
    assert methods_of_runs(runs) == (
        Method("DT on same-scene", (trained / "dt-0",)),
        Method("BC", (trained / "bc-1", trained / "bc-0")),
        Method("DT on ground truth", (trained / "gt-0",)),
    )


def test_other_differences_make_other_methods_and_are_named(trained: Path) -> None:
    edit(trained / "bc-1", lambda meta: meta.update(n_updates=99, config={**meta["config"], "top_fraction": 0.5}))
    other = edit(
        shutil.copytree(trained / "dt-0", trained / "dt-1"),
        lambda meta: meta.update(seed=1, data_sha256="f" * 64, dataset={**meta["dataset"], "id": "zest/other-v0"}),
    )
    names = [method.name for method in methods_of_runs([trained / "bc-0", trained / "bc-1", trained / "dt-0", other])]
    assert names[:2] == ["BC, top_fraction 1.0, n_updates 30", "BC, top_fraction 0.5, n_updates 99"]
    assert names[2].startswith("DT on same-scene, dataset zest/kitchen-micro-tiny-zest-")
    assert names[3] == "DT on same-scene, dataset zest/other-v0 (ffffffff)"


def test_the_same_training_twice_is_refused_as_it_is_no_second_seed(trained: Path) -> None:
    copy = shutil.copytree(trained / "bc-0", trained / "copy")
    with pytest.raises(BadInput, match=r"bc-0 and .*copy are the same training with the same seed"):
        methods_of_runs([trained / "bc-0", copy])


# --- which evaluation -------------------------------------------------------------------------------------------------


def test_the_newest_evaluation_is_shown_unless_one_is_asked_for(evaluated: Path) -> None:
    newer = replace(CONFIG, n_episodes=3)
    evaluate(evaluated / "bc-0", newer, n_workers=1)
    assert latest_evaluation(evaluated / "bc-0").config == newer
    methods = [Method("BC", (evaluated / "bc-0",), "control", evaluation=which) for which in (None, CONFIG, newer)]
    rows = [compare("T", [method], source_id=None, goals={}).items(RESULTS)[0] for method in methods]
    assert [row.n_episodes for row in rows] == [3, 2, 3]


def test_a_report_says_when_methods_did_not_meet_the_same_starts(evaluated: Path) -> None:
    evaluate(evaluated / "bc-0", replace(CONFIG, n_episodes=3), n_workers=1)
    methods = [Method("BC", (evaluated / "bc-0",), "control"), Method("DT", (evaluated / "dt-0",), "control")]
    report = compare("T", methods, source_id=None, goals={}, caveats=["small"])
    assert report.items(CAVEATS) == (
        "small",
        "The methods were not evaluated on the same starts, so their numbers are not paired "
        "(BC: 3 from seed 11; DT: 2 from seed 11).",
    )


def test_runs_of_two_tasks_are_refused(evaluated: Path) -> None:
    def of_other_task(meta: dict[str, Any]) -> None:
        meta["dataset"]["env_spec"] = meta["dataset"]["env_spec"].replace("micro", "knob2")

    edit(evaluated / "dt-0", of_other_task)
    methods = [Method(name, (evaluated / name,)) for name in ("bc-0", "dt-0")]
    with pytest.raises(BadInput, match="runs of one task, got knob2, micro; write one report per task"):
        compare("T", methods, source_id=None, goals={})


def test_a_run_without_evaluation_and_a_folder_that_is_no_run_say_what_to_do(trained: Path) -> None:
    with pytest.raises(BadInput, match=r"gt-0 holds no evaluation; run `zest evaluate .*gt-0` first"):
        compare("T", [Method("GT", (trained / "gt-0",))], source_id=None, goals={})
    with pytest.raises(BadInput, match="is not the folder of a training"):
        latest_evaluation(trained)
