"""From a recording to a report in other environments than the kitchen, by the commands that a user types."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded_robots import record

from zest_rl.cli.report import summary
from zest_rl.runtime import artifacts

Run = Callable[..., dict[str, Any]]
SMALL = ("--n-updates", 5, "--hidden-size", 16, "--n-layers", 1, "--device", "cpu", "--threads", 1)
ENVIRONMENTS = {
    "AdroitHandDoor-v1": (),
    "FetchPush-v4": (),
    "FetchReach-v4": ("--show-robot", "--look-at", "robot0:gripper_link"),
    "PointMaze_UMaze-v3": ("--show-robot",),
    "Hopper-v5": ("--show-robot", "--look-at", "torso"),
}
"""Environment → what is to be seen of it: by default the object; without one, the robot that acts."""
PUSHED = {"AdroitHandDoor-v1": "door_hinge", "FetchPush-v4": "object0:joint"}


@pytest.fixture(autouse=True)
def _places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "cache"))
    (tmp_path / "minari").mkdir()
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_an_environment_goes_from_a_recording_to_a_report(env_id: str, zest: Run, tmp_path: Path) -> None:
    record(env_id, "some/robot-v0", pushed=PUSHED.get(env_id))
    scored = zest(
        "relabel", "some/robot-v0", "--goal", "episode:0", "--views", 1, "--n-workers", 1, *ENVIRONMENTS[env_id]
    )
    inspected = zest("inspect", scored["dataset"], "--n-workers", 1)
    assert "spearman" in inspected["datasets"][scored["dataset"]]["figures"], "its own rewards judge"
    trained = zest("train", "rvs", scored["dataset"], *SMALL)
    assert trained["next"].startswith("zest evaluate")
    words = ("--n-episodes", 2, "--horizon", 4, "--n-workers", 1)
    evaluated = zest("evaluate", trained["run"], *words)
    assert evaluated.keys() & {"return", "normalized_return"} == {"return"}, "there are no references"
    assert ("success" in evaluated) == (env_id != "Hopper-v5")
    assert evaluated["mean_length"] == 4
    assert all(Path(video).stat().st_size > 500 for video in evaluated["videos"].values())
    assert evaluated["videos"].keys() == {"best", "median", "worst"}
    result = artifacts.read_json(Path(evaluated["result"]))
    assert all(episode["zest_return"] is not None for episode in result["episodes"]), "it was scored online"
    reported = zest("report", trained["run"], "--output", tmp_path / "report.html")
    assert reported["rows"].keys() == {"Demo", "RVS on episode:0"}
    assert np.isfinite(list(reported["rows"].values())).all()
    assert (reported["success"]["RVS on episode:0"] is None) == (env_id == "Hopper-v5")
    assert "return" in summary(reported)
    assert "of the expert" not in summary(reported), "there are no references"
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Returns are sums of the environment's own rewards" in page
    assert "ormalized return" not in page
    assert page.count("<video") == 3
