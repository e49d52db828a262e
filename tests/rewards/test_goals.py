from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from zest_rl.data.images import read_image
from zest_rl.embedders import load_embedder
from zest_rl.errors import BadInput, Notice
from zest_rl.kitchen.tasks import TASKS, Task
from zest_rl.rewards.goals import VISUAL_TASKS_VARIABLE, GoalSpec, embed_goal, read_folder, read_free_goal, read_goal

MICRO = TASKS["micro"]
DRAWINGS = Path(__file__).parents[2] / "datasets" / "goals" / "micro"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A goal folder of the user's own, with one start and two goals."""
    for part, names in (("init", ["closed_flat.png"]), ("goal", ["open_flat.png", "open_sketch.png"])):
        (tmp_path / "goals" / part).mkdir(parents=True)
        for name in names:
            shutil.copy(DRAWINGS / part / name, tmp_path / "goals" / part)
    return tmp_path / "goals"


# --- pictures ---


def test_a_folder_gives_its_starts_and_goals_in_the_order_of_their_names(folder: Path) -> None:
    goal = read_goal(str(folder), MICRO)
    assert (goal.name, goal.is_text, goal.per_view) == (str(folder), False, False)
    assert len(goal.starts) == 1
    for picture, name in zip(goal.goals, ("open_flat.png", "open_sketch.png"), strict=True):
        np.testing.assert_array_equal(picture, read_image(DRAWINGS / "goal" / name))


def test_the_drawings_of_the_microwave_come_with_the_package() -> None:
    goal = read_goal("drawings", MICRO)
    assert (len(goal.starts), len(goal.goals)) == (3, 3)
    assert goal.fingerprint() == read_folder(DRAWINGS).fingerprint()


def test_a_task_without_drawings_is_refused_and_those_with_drawings_are_named() -> None:
    with pytest.raises(BadInput, match=r"no drawings of task 'toaster' \(only of .*micro.*\); give a folder"):
        read_goal("drawings", replace(MICRO, name="toaster"))


def test_every_file_of_a_goal_folder_that_is_left_out_is_named(folder: Path) -> None:
    plain = read_folder(folder)
    (folder / "goal" / "IMG_0001.HEIC").write_bytes(b"\0\0\0\x18ftypheic" + b"x" * 200)
    (folder / "goal" / "more").mkdir()
    (folder / "goal" / ".DS_Store").touch()
    with pytest.warns(Notice, match=r"goal: left out, .*: IMG_0001\.HEIC, more/; convert") as told:
        assert read_folder(folder).fingerprint() == plain.fingerprint()
    assert len(told) == 1


def test_a_folder_that_is_not_laid_out_as_a_goal_is_refused_with_what_it_holds(folder: Path) -> None:
    shutil.rmtree(folder / "init")
    with pytest.raises(BadInput, match=r"must hold init/ .* and goal/ .*has no init/, it holds goal$"):
        read_goal(str(folder), MICRO)
    (folder / "init").mkdir()
    with pytest.raises(BadInput, match=r"init holds no image, .*; it holds nothing: put"):
        read_goal(str(folder), MICRO)
    shutil.rmtree(folder / "goal")
    shutil.rmtree(folder / "init")
    with pytest.raises(BadInput, match=r"has no init/, it holds nothing"):
        read_goal(str(folder), MICRO)


def test_a_picture_instead_of_a_folder_is_refused() -> None:
    with pytest.raises(BadInput, match=r"must hold init/ .*open_flat.png is not a folder"):
        read_goal(str(DRAWINGS / "goal" / "open_flat.png"), MICRO)


def test_a_damaged_picture_is_refused_by_its_name(folder: Path) -> None:
    path = folder / "goal" / "open_sketch.png"
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(BadInput, match=r"open_sketch.png is damaged or cut off"):
        read_goal(str(folder), MICRO)


@pytest.mark.parametrize("spec", ["/no/such/folder", "drawing", "same_scene", "visual-tasks"])
def test_a_goal_that_is_nothing_known_is_refused_with_all_the_kinds(spec: str) -> None:
    expected = (
        rf"unknown goal '{spec}': .*'same-scene', 'toys', 'drawings', 'visual-tasks:real_imgs', "
        "'text', 'text:START -> GOAL'"
    )
    with pytest.raises(BadInput, match=expected):
        read_goal(spec, MICRO)


def test_the_scene_itself_gives_each_view_its_own_pair() -> None:
    before, after = np.random.default_rng(0).integers(0, 256, (2, 3, 8, 8, 3), dtype=np.uint8)
    goal = read_goal("same-scene", MICRO, (before, after))
    assert goal.per_view
    np.testing.assert_array_equal(goal.starts, before)
    np.testing.assert_array_equal(goal.goals, after)
    with pytest.raises(BadInput, match="'same-scene' needs frames of the scene"):
        read_goal("same-scene", MICRO)


# --- the Visual Tasks Dataset ---


@pytest.mark.parametrize("value", [None, ""])
def test_without_its_variable_the_visual_tasks_dataset_is_asked_for(
    value: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    if value is None:
        monkeypatch.delenv(VISUAL_TASKS_VARIABLE, raising=False)
    else:
        monkeypatch.setenv(VISUAL_TASKS_VARIABLE, value)
    with pytest.raises(BadInput, match="'visual-tasks:real_imgs' needs the environment variable ZEST_VISUAL_TASKS"):
        read_goal("visual-tasks:real_imgs", MICRO)


def test_a_variable_that_points_elsewhere_is_refused_with_the_folder_that_was_looked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VISUAL_TASKS_VARIABLE, str(tmp_path))
    with pytest.raises(BadInput, match=r"real_imgs/open_microwave is not a folder"):
        read_goal("visual-tasks:real_imgs", MICRO)


@pytest.mark.data
@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_the_visual_tasks_dataset_has_pictures_of_every_task(
    visual_tasks: Path, monkeypatch: pytest.MonkeyPatch, task: Task
) -> None:
    monkeypatch.setenv(VISUAL_TASKS_VARIABLE, str(visual_tasks))
    goal = read_goal("visual-tasks:drawings", task)
    assert goal.name == "visual-tasks:drawings"
    assert all(frame.ndim == 3 and frame.std() > 0 for frame in (*goal.starts, *goal.goals))


# --- sentences ---


def test_sentences_are_split_into_starts_and_goals() -> None:
    goal = read_goal("text: closed microwave | shut oven ->open microwave ", MICRO)
    assert goal.is_text
    assert goal.starts == ("closed microwave", "shut oven")
    assert goal.goals == ("open microwave",)


@pytest.mark.parametrize(
    "spec", ["text:open microwave", "text:a -> b -> c", "text: -> open", "text:closed ->", "text:"]
)
def test_a_text_goal_needs_two_sides(spec: str) -> None:
    with pytest.raises(BadInput, match="must look like 'text:closed microwave -> open microwave', got"):
        read_goal(spec, MICRO)


def test_a_task_has_its_own_two_sentences() -> None:
    for task in TASKS.values():
        goal = read_goal("text", task)
        assert (goal.name, goal.starts, goal.goals) == ("text", (task.start_text,), (task.goal_text,))
    assert (
        read_goal("text", MICRO).fingerprint()
        == read_goal("text:closed microwave->open microwave", MICRO).fingerprint()
    )


def test_a_side_without_any_sentence_is_refused() -> None:
    with pytest.raises(BadInput, match="needs at least 1 start and 1 goal, got 0 and 1"):
        read_goal("text:| -> open", MICRO)


# --- identity ---


def test_the_fingerprint_is_of_the_content_whatever_files_and_folders_are_called(folder: Path, tmp_path: Path) -> None:
    fingerprint = read_folder(folder).fingerprint()
    copy = shutil.copytree(folder, tmp_path / "elsewhere")
    for part in ("init", "goal"):
        for i, path in enumerate(sorted((copy / part).iterdir())):
            Image.fromarray(read_image(path)).save(copy / part / f"{i}.bmp")
            path.unlink()
    assert read_folder(copy, "another name").fingerprint() == fingerprint

    picture = np.array(read_image(copy / "goal" / "1.bmp"))
    picture[0, 0, 0] ^= 1
    Image.fromarray(picture).save(copy / "goal" / "1.bmp")
    assert read_folder(copy).fingerprint() != fingerprint


def test_start_and_goal_views_and_sentences_each_make_another_goal() -> None:
    a, b = np.zeros((2, 4, 4, 3), np.uint8) + np.array([0, 1], np.uint8)[:, None, None, None]
    specs = [
        GoalSpec("", (a,), (b,)),
        GoalSpec("", (b,), (a,)),
        GoalSpec("", (a,), (b, b)),
        GoalSpec("", (a,), (b,), per_view=True),
        GoalSpec("", ("a",), ("b",)),
        GoalSpec("", ("b",), ("a",)),
    ]
    assert len({spec.fingerprint() for spec in specs}) == len(specs)
    assert GoalSpec("x", ("a",), ("b",)).fingerprint() == specs[4].fingerprint()


# --- embeddings ---


def test_pictures_are_embedded_one_row_each_and_in_their_order(folder: Path) -> None:
    embedder = load_embedder("efficientnet-lite0")
    goal = read_folder(folder)
    starts, goals = embed_goal(goal, embedder)
    assert (starts.shape, goals.shape) == ((1, embedder.dim), (2, embedder.dim))
    np.testing.assert_allclose(goals[1:], embedder.embed_images(goal.goals[1:]), atol=1e-4)  # type: ignore[arg-type]

    pair = GoalSpec("same-scene", (*goal.starts, *goal.starts), goal.goals, per_view=True)  # type: ignore[arg-type]
    starts, goals_per_view = embed_goal(pair, embedder)
    assert (starts.shape, goals_per_view.shape) == ((2, 1, embedder.dim), (2, 1, embedder.dim))
    np.testing.assert_allclose(goals_per_view[:, 0], goals, atol=1e-4)


def test_sentences_for_an_embedder_of_pictures_are_refused_and_one_that_reads_them_is_named() -> None:
    with pytest.raises(BadInput, match=r"reads images only; for sentences use one like open_clip:ViT-B-32/openai"):
        embed_goal(read_goal("text:closed microwave -> open microwave", MICRO), load_embedder("efficientnet-lite0"))


def test_another_robots_task_names_a_folder_of_the_visual_tasks_dataset(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VISUAL_TASKS_VARIABLE, str(folder.parent))
    goal = read_free_goal("visual-tasks:goals")
    assert (goal.name, len(goal.goals)) == ("visual-tasks:goals", 2)
    with pytest.raises(BadInput, match=r"must hold init/ .* it holds goals"):
        read_free_goal("visual-tasks:.")


@pytest.mark.parametrize("spec", ["~nobody-here/goals", "a sentence without its mark " * 300])
def test_what_names_no_folder_is_an_unknown_goal(spec: str) -> None:
    with pytest.raises(BadInput, match="unknown goal"):
        read_goal(spec, MICRO)
    with pytest.raises(BadInput, match="need a goal of their own"):
        read_free_goal(spec)
