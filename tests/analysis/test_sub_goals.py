"""Episodes that reach several goals, performed in the real kitchen and rendered to pictures."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from zest_rl.analysis.sub_goals import SubGoalScores, rise_in_order
from zest_rl.cli import follow
from zest_rl.kitchen.env import KitchenEnv
from zest_rl.kitchen.tasks import TASKS
from zest_rl.kitchen.views import Views
from zest_rl.report.sub_goal_page import sub_goal_report

Zest = Callable[..., dict[str, Any]]
Refusal = Callable[..., tuple[int, str]]
DOORS = ("ldoor", "sdoor")


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "cache"))


def scored(scores: list[float]) -> SubGoalScores:
    return SubGoalScores("goal", np.array(scores, np.float32), (), np.zeros(0, np.intp))


def test_a_score_rises_when_it_is_half_way_to_its_highest() -> None:
    one = scored([0.0, 0.1, 0.5, 0.4, 0.9, 0.2])
    assert (one.rises_at, one.highest_at) == (2, 4)
    never = scored([0.0, -0.1, -0.2])
    assert (never.rises_at, never.highest_at) == (None, 0)
    assert not rise_in_order([never])
    assert not rise_in_order([never, one])
    assert rise_in_order([scored([0, 1, 0]), scored([0, 0, 1])])
    assert not rise_in_order([scored([0, 0, 1]), scored([0, 1, 0])])
    assert not rise_in_order([scored([0, 0, 1]), scored([0, 0, 1])]), "at once is not one after another"


@pytest.mark.parametrize("scores", [np.full(30, 0.2), np.random.default_rng(0).normal(0.1, 0.05, 60)])
def test_a_flat_curve_is_no_signal_rather_than_in_order(scores: np.ndarray) -> None:
    flat = scored([0.0, *scores])
    assert not flat.has_signal
    assert flat.rises_at is None
    page = sub_goal_report([flat], {})
    assert page.summary == "There is no signal, as no score tells anything of the next: goal no signal."
    result = {"sub_goals": {"goal": flat.as_json()}, "in_order": rise_in_order([flat]), "report": "follow.html"}
    assert follow.summary(result).splitlines()[1] == "in the order of the sub-goals: no signal"


def test_in_the_kitchen_the_similarity_to_each_task_rises_as_it_is_done(zest: Zest, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    result = zest(
        "follow",
        "kitchen",
        "knob3",
        "sdoor",
        "--views",
        "1",
        "--tolerance",
        "0.005",
        "--n-workers",
        "1",
        "--output",
        page,
    )
    assert result["in_order"] is True
    first, second = result["sub_goals"]["knob3"], result["sub_goals"]["sdoor"]
    assert first["done_at"] < second["rises_at"] <= second["done_at"] == len(second["scores"]) - 1
    assert 0 < first["rises_at"] <= first["done_at"]
    html = page.read_text()
    assert "Sub-goals" in html
    assert "rise one after another, in the order of the sub-goals" in html
    recipe = tmp_path / "doing.toml"
    recipe.write_text('verb = "follow kitchen"\ntasks = ["knob3", "sdoor"]\nviews = 1\ntolerance = 5e-3\n')
    again = zest("reproduce", recipe, "--n-workers", "1", "--output", tmp_path / "out")
    assert again["sub_goals"] == result["sub_goals"]
    kept = json.loads((tmp_path / "out" / "result.json").read_text())
    assert kept["sub_goals"] == result["sub_goals"]
    assert "torch" in kept["provenance"]["versions"]
    assert "Sub-goals" in (tmp_path / "out" / "report.html").read_text()


@pytest.fixture
def two_doors(tmp_path: Path) -> Path:
    """A folder of pictures in which the left door opens and then the sliding one; beside it what each alone gives."""
    start = KitchenEnv("ldoor").start_qpos
    with Views("ldoor", n_views=3, size=128).renderer() as renderer:

        def show(path: Path, *shares: float) -> None:
            state = start
            for door, share in zip(DOORS, shares, strict=True):
                state = renderer.scene.with_joint(state, TASKS[door].joint, share * TASKS[door].goal)
            path.parent.mkdir(exist_ok=True)
            Image.fromarray(renderer.render(state)[0]).save(path)

        steps = [(share, 0.0) for share in np.linspace(0, 1, 6)] + [(1.0, share) for share in np.linspace(0.2, 1, 5)]
        for i, shares in enumerate(steps):
            show(tmp_path / "clip" / f"{i}.png", *shares)
        show(tmp_path / "ldoor.png", 1.0, 0.0)
        show(tmp_path / "sdoor.png", 0.0, 1.0)
        for folder, shares in (("init", (0.0, 0.0)), ("goal", (0.0, 1.0))):
            (tmp_path / "spec").mkdir(exist_ok=True)
            show(tmp_path / "spec" / folder / "1.png", *shares)
    return tmp_path


def test_a_video_is_followed_by_pictures_of_its_sub_goals(
    two_doors: Path, zest: Zest, monkeypatch: pytest.MonkeyPatch
) -> None:
    page, clip = two_doors / "page.html", two_doors / "clip"
    words = ("follow", "video", clip, "--output", page, "--goals")
    result = zest(*words, two_doors / "ldoor.png", two_doors / "sdoor.png")
    assert list(result["sub_goals"]) == ["ldoor", "sdoor"]
    assert result["in_order"] is True
    left, sliding = (result["sub_goals"][door] for door in DOORS)
    assert left["rises_at"] <= 5 < sliding["rises_at"]
    assert left["scores"][5] == pytest.approx(1.0, abs=1e-3), "the frame is the goal picture"
    assert left["done_at"] is None
    assert zest(*words, two_doors / "sdoor.png", two_doors / "ldoor.png")["in_order"] is False
    monkeypatch.setenv("DOORS", str(two_doors))
    (two_doors / "doors.toml").write_text(
        'verb = "follow video"\nclip = "$DOORS/clip"\ngoals = ["$DOORS/ldoor.png", "$DOORS/sdoor.png"]\n'
    )
    again = zest("reproduce", two_doors / "doors.toml", "--output", two_doors / "out")
    assert again["sub_goals"] == result["sub_goals"]
    by_folder = zest(*words, two_doors / "spec")["sub_goals"]["spec"]
    assert by_folder["scores"] == sliding["scores"], "the folder holds the same two pictures"


@pytest.mark.parametrize(
    ("goals", "message"),
    [
        (["nothing.png"], "unknown sub-goal 'nothing.png': it is neither a picture, a folder"),
        (["ldoor.png", "ldoor.png"], "1 or more sub-goals, each once"),
        (["text:closed -> open"], "efficientnet-lite0 reads images only"),
    ],
)
def test_a_wrong_sub_goal_is_refused(
    two_doors: Path, refusal: Refusal, monkeypatch: pytest.MonkeyPatch, goals: list[str], message: str
) -> None:
    monkeypatch.chdir(two_doors)
    code, err = refusal("follow", "video", "clip", "--goals", *goals)
    assert code == 2
    assert message in err
    assert not (two_doors / "follow.html").exists()
