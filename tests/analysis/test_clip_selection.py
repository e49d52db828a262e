"""Clips: videos and picture folders made of rendered kitchen scenes, read, embedded and selected from."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest
from PIL import Image

from zest_rl import cli
from zest_rl.analysis.clip_selection import GOAL_SHARE, clip_pool, things_with
from zest_rl.analysis.clips import LABELS, OPENING, VIDEOS, Clip, embed_clips, folder_of_clips, something_something
from zest_rl.data.video import read_frames
from zest_rl.embedders import load_embedder
from zest_rl.errors import BadInput, ZestError
from zest_rl.kitchen.env import KitchenEnv
from zest_rl.kitchen.tasks import TASKS
from zest_rl.kitchen.views import Views
from zest_rl.rewards.scores import score_delta

N = 12
THINGS = {"oven": "micro", "drawer": "sdoor"}
"""Objects of the labels → what stands for them in the kitchen."""


@pytest.fixture(scope="module")
def openings() -> dict[str, list[list[np.ndarray]]]:
    """Three clips per object: its joint opens, seen from three sides."""
    start = KitchenEnv("micro").start_qpos
    clips: dict[str, list[list[np.ndarray]]] = {}
    for thing, name in THINGS.items():
        task = TASKS[name]
        with Views(name, n_views=3, size=64).renderer() as renderer:
            states = [renderer.scene.with_joint(start, task.joint, share * task.goal) for share in np.linspace(0, 1, N)]
            frames = np.stack([renderer.render(state) for state in states])
        clips[thing] = [list(frames[:, view]) for view in range(3)]
    return clips


@pytest.fixture
def root(openings: dict[str, list[list[np.ndarray]]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The clips as Something-Something V2 has them, beside labels of another action and another object."""
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "cache"))
    root = tmp_path / "ssv2"
    (root / VIDEOS).mkdir(parents=True)
    labels = []
    for thing, clips in openings.items():
        for clip in clips:
            name = str(1000 + len(labels))
            imageio.mimwrite(root / VIDEOS / f"{name}.webm", clip, fps=12, codec="libvpx-vp9", quality=9)
            labels.append({"id": name, "template": OPENING, "placeholders": [f"a kitchen {thing}"]})
    labels.append({"id": "1", "template": "Closing [something]", "placeholders": ["oven"]})
    labels.append({"id": "2", "template": OPENING, "placeholders": ["a bottle"]})
    labels.append({"id": "1000", "template": OPENING, "placeholders": ["a drawerful"]})
    labels.append({"id": "3", "template": OPENING, "placeholders": ["oven"]})  # its video was not downloaded
    (root / LABELS[0]).write_text(json.dumps(labels))
    (root / "something-something-v2-labels.json").write_text(json.dumps({OPENING: "46"}))
    return root


def test_a_folder_of_pictures_is_a_clip_too(openings: dict[str, list[list[np.ndarray]]], tmp_path: Path) -> None:
    folder = tmp_path / "oven" / "first"
    folder.mkdir(parents=True)
    for i, frame in enumerate(openings["oven"][0]):
        Image.fromarray(frame).save(folder / f"{i:03d}.png")
    assert folder_of_clips(tmp_path) == [Clip(folder, "oven")]


def test_the_clips_of_one_action_on_the_objects_are_found(root: Path) -> None:
    clips = something_something(root)
    assert [clip.thing for clip in clips] == ["oven"] * 3 + ["drawer"] * 3
    assert [clip.path.stem for clip in clips] == [str(1000 + i) for i in range(6)]
    assert [clip.thing for clip in something_something(root, things=("drawer",))] == ["drawer"] * 3


def test_an_object_has_several_names_in_labels(tmp_path: Path) -> None:
    names = {
        "my refrigerator": "fridge",
        "the fridge door": "fridge",
        "cardboard boxes": "box",
        "a laptop computer": "laptop",
        "Oven": "oven",
        "a microwave oven": None,
        "door": "door",
        "washing machine": "washing machine",
        "a doorbell": None,
    }
    (tmp_path / VIDEOS).mkdir()
    for i in range(len(names)):
        (tmp_path / VIDEOS / f"{i}.webm").touch()
    labels = [{"id": i, "template": OPENING, "placeholders": [name]} for i, name in enumerate(names)]
    (tmp_path / LABELS[0]).write_text(json.dumps(labels))
    found = {clip.path.stem: clip.thing for clip in something_something(tmp_path)}
    assert [found.get(str(i)) for i in range(len(names))] == list(names.values())


@pytest.mark.parametrize("name", LABELS)
def test_labels_are_found_where_any_release_has_them(root: Path, name: str) -> None:
    (root / name).parent.mkdir(exist_ok=True)
    (root / LABELS[0]).rename(root / name)
    assert len(something_something(root)) == 6


def test_clips_are_embedded_once(root: Path) -> None:
    clips, embedder = something_something(root)[:2], load_embedder("efficientnet-lite0")
    done: list[None] = []
    first = embed_clips(clips, embedder, 4, on_progress=lambda *_: done.append(None))
    np.testing.assert_allclose(first[0], embedder.embed_images(read_frames(clips[0].path, 4)), atol=1e-4)
    assert len(done) == 2
    copies = [Clip(clip.path.rename(root / VIDEOS / f"moved-{clip.path.name}"), "oven") for clip in clips]

    n_embedded = []

    class Counting:
        cache_key, dim = embedder.cache_key, embedder.dim

        def embed_images(self, frames: Any) -> Any:
            n_embedded.append(len(frames))
            return embedder.embed_images(frames)

    again = embed_clips(copies, Counting(), 4)  # type: ignore[arg-type]
    np.testing.assert_array_equal(again, first)
    assert n_embedded == [1], "to compare"


def test_a_cache_with_the_embeddings_of_other_clips_is_refused(root: Path, tmp_path: Path) -> None:
    clips, embedder = something_something(root)[:2], load_embedder("efficientnet-lite0")
    embed_clips(clips, embedder, 4)
    one, other = (tmp_path / "cache/clips").glob("*.npz")
    one.replace(tmp_path / "kept")
    other.rename(one)
    (tmp_path / "kept").rename(other)
    with pytest.raises(ZestError, match="clips are not those that this machine computes"):
        embed_clips(clips, embedder, 4)


def test_candidates_are_the_frames_of_the_other_clips() -> None:
    clips = [Clip(Path(str(i)), thing) for i, thing in enumerate("aaabb")]
    embeddings = [np.full((5, 2), 10 * i, np.float32) + np.arange(5, dtype=np.float32)[:, None] for i in range(5)]
    narrow = clip_pool(clips, embeddings, "a", left_out=1)
    assert set(narrow.clip) == {0, 2}
    assert len(narrow.embeddings) == 8, "x_0 is no candidate"
    np.testing.assert_array_equal(narrow.starts[:, 0], 10 * narrow.clip)
    assert round(5 * GOAL_SHARE) == 1
    np.testing.assert_array_equal(narrow.satisfies, narrow.embeddings[:, 0] % 10 == 4)
    other = clip_pool(clips, embeddings, "a", left_out=1, diverse=True, same_context=False)
    assert set(other.clip) == {0, 2, 3, 4}
    assert (other.starts[:, 0] != 10 * other.clip).all()
    assert set(other.starts[:, 0] / 10) <= {0, 2, 3, 4}
    assert set(other.clip[other.satisfies]) == {0, 2}, "the end of another object is no goal"
    elsewhere = clip_pool(clips, embeddings, "a", left_out=1, same_context=False)
    np.testing.assert_array_equal(elsewhere.starts[:, 0], 20 - 10 * elsewhere.clip)  # of the other one of two
    action = clip_pool(clips, embeddings, "a", diverse=True, any_thing=True)
    assert set(action.clip[action.satisfies]) == {0, 1, 2, 3, 4}, "the end of another object shows the action"
    assert set(clip_pool(clips, embeddings, "b").clip) == {3, 4}, "the goal is not one of these clips"
    assert things_with(clips, 3) == ["a"]
    assert things_with(clips, 2) == ["a", "b"]


def test_the_verb_judges_the_frames_that_score_highest(root: Path, zest: Callable[..., dict[str, Any]]) -> None:
    words = ("select", "footage", root, "--n-frames", N, "--top", 4)
    narrow = zest(*words)
    assert set(narrow["objects"]) == set(THINGS)
    assert narrow["n_clips"] == 6
    for row in narrow["objects"].values():
        assert (row["n_clips"], row["n_goals"]) == (3, 3)
        assert row["goal_frame_ratio"] == pytest.approx(2 / 11)
        assert row["top_n_success"]["ci95"][0] <= row["top_n_success"]["value"] <= row["top_n_success"]["ci95"][1]
    embedder = load_embedder("efficientnet-lite0")
    clips = [embedder.embed_images(read_frames(root / VIDEOS / f"{1000 + i}.webm", N)) for i in range(3)]
    shares = []
    for goal in range(3):
        scored = [
            (score_delta(clip, clips[goal][:1], clips[goal][-1:])[t], t >= N - 2)
            for i, clip in enumerate(clips)
            for t in range(1, N)
            if i != goal
        ]
        shares.append(np.mean([reached for _, reached in sorted(scored, reverse=True)[:4]]))
    assert narrow["objects"]["oven"]["top_n_success"]["value"] == pytest.approx(np.mean(shares))
    diverse = zest(*words, "--pool", "all", "--context", "different")
    assert diverse["mean"]["goal_frame_ratio"] == pytest.approx(4 / 55)
    assert {row["top"] for row in diverse["objects"].values()} == {4}
    assert diverse["settings"]["context"] == "different"
    many = zest(*words[:-1], 25)
    assert {row["top"] for row in many["objects"].values()} == {4}, "two clips, of which two frames each reach the goal"


@pytest.fixture
def rendered(openings: dict[str, list[list[np.ndarray]]], tmp_path: Path) -> Path:
    """One clip per object, as pictures by object: the same as the first video of each."""
    for thing, clips in openings.items():
        folder = tmp_path / "rendered" / thing / "clip"
        folder.mkdir(parents=True)
        for i, frame in enumerate(clips[0]):
            Image.fromarray(frame).save(folder / f"{i}.png")
    return tmp_path / "rendered"


def test_other_clips_specify_the_goals(root: Path, rendered: Path, zest: Callable[..., dict[str, Any]]) -> None:
    words = ("select", "footage", root, "--goals", rendered, "--n-frames", N, "--top", 4)
    result = zest(*words)
    embedder = load_embedder("efficientnet-lite0")
    (goal,) = embed_clips([Clip(rendered / "oven" / "clip", "oven")], embedder, N)
    videos = embed_clips([clip for clip in something_something(root) if clip.thing == "oven"], embedder, N)
    scored = [
        (score, t >= N - 2)
        for clip in videos
        for t, score in enumerate(score_delta(clip, goal[:1], goal[-1:]))
        if t > 0
    ]
    share = np.mean([reached for _, reached in sorted(scored, reverse=True)[:4]])
    row = result["objects"]["oven"]
    assert (row["n_clips"], row["n_goals"]) == (3, 1), "no clip is left out: the goal is none of them"
    assert row["top_n_success"]["value"] == pytest.approx(share)
    (root / VIDEOS / "1000.webm").unlink()
    assert set(zest(*words)["objects"]) == set(THINGS), "two clips are enough"
    shutil.rmtree(rendered / "drawer")
    assert set(zest(*words)["objects"]) == {"oven"}


def test_an_action_is_found_in_the_clips_of_whatever_object(root: Path, zest: Callable[..., dict[str, Any]]) -> None:
    words = ("select", "footage", root, "--n-frames", N, "--top", 4, "--pool", "all")
    goals, actions = zest(*words), zest(*words, "--ask", "actions")
    for thing in THINGS:
        goal, action = goals["objects"][thing], actions["objects"][thing]
        assert goal["goal_frame_ratio"] == pytest.approx(4 / 55)
        assert action["goal_frame_ratio"] == pytest.approx(10 / 55)
        assert action["top_n_success"]["value"] >= goal["top_n_success"]["value"]


@pytest.mark.parametrize("pool", [(), ("--pool", "all", "--context", "different")])
def test_actions_among_one_object_or_against_another_start_are_refused(
    root: Path, refusal: Callable[..., tuple[int, str]], pool: tuple[str, ...]
) -> None:
    code, err = refusal("select", "footage", root, "--ask", "actions", *pool)
    assert code == 2
    assert "give --pool all" in err


def test_a_study_of_real_video_is_one_call(
    root: Path, rendered: Path, tmp_path: Path, zest: Callable[..., dict[str, Any]],
    refusal: Callable[..., tuple[int, str]], monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    output = tmp_path / "out"
    monkeypatch.setenv("ZEST_FOOTAGE", str(root))
    monkeypatch.delenv("ZEST_RENDERED", raising=False)
    words = ("reproduce", "eval/footage_actions_rendered.toml", "--output", output)
    code, err = refusal(*words)
    assert code == 2
    assert "$ZEST_RENDERED names an environment variable that is not set" in err
    assert not output.exists()
    monkeypatch.setenv("ZEST_RENDERED", str(rendered))
    (rendered / "oven" / "again").symlink_to(rendered / "oven" / "clip")
    code, err = refusal(*words)
    assert code == 2
    assert "no object has 2 clips in" in err, "one rendered clip leaves none to select from"
    (rendered / "oven" / "more").symlink_to(rendered / "oven" / "clip")
    result = zest(*words)
    assert [row["name"] for row in result["rows"]] == [
        f"folder $ZEST_{folder}, goals $ZEST_{goals}"
        for folder in ("FOOTAGE", "RENDERED")
        for goals in ("FOOTAGE", "RENDERED")
    ]
    assert [set(row["tasks"]) for row in result["rows"]] == [set(THINGS), set(THINGS), {"oven"}, {"oven"}]
    alone = zest("select", "footage", root, "--goals", rendered, "--ask", "actions", "--pool", "all")
    assert result["rows"][1]["tasks"] == alone["objects"]
    table = (output / "table.md").read_text()
    for line in (
        "| | oven | drawer | mean |",
        "at random, pool all, $ZEST_RENDERED, $ZEST_FOOTAGE",
        "| paper: ASDD, S2R, CLIP | 30.0 | 35.0",
    ):
        assert line in table
    assert str(tmp_path) not in table
    assert "Action selection among real and rendered clips" in (output / "report.html").read_text()


def test_an_object_with_few_clips_is_left_out_and_named(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (root / VIDEOS / "1005.webm").unlink()
    words = ["select", "footage", str(root), "--n-frames", "4", "--top", "1"]
    assert cli.main(words) == 0
    out, err = capsys.readouterr()
    assert "'drawer' is left out: it needs 2 clips to choose from" in err
    assert "oven" in out
    assert "drawer" not in out
    (root / VIDEOS / "1000.webm").unlink()
    assert cli.main(words) == 2
    err = capsys.readouterr().err
    assert "no object has 2 clips in" in err
    assert "left out: 'oven', 'drawer'" in err


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda root: (root / VIDEOS / "1000.webm").write_bytes(b"no video"), r"1000\.webm cannot be read as a video"),
        (lambda root: (root / VIDEOS / "1000.webm").write_bytes(b""), r"1000\.webm is empty"),
        (lambda root: (root / LABELS[0]).write_text("{"), "is not a list of labels"),
        (lambda root: (root / LABELS[0]).write_text("[" * 100_000), "is not a list of labels"),
        (
            lambda root: (root / LABELS[0]).write_text(
                json.dumps([{"id": "../../other", "template": "Opening [something]", "placeholders": ["a door"]}])
            ),
            r"'\.\./\.\./other\.webm' is no file name",
        ),
        (lambda root: (root / LABELS[0]).write_text("[]"), "no clip is of 'Opening"),
        (lambda root: (root / LABELS[0]).unlink(), "as Something-Something V2 does"),
    ],
)
def test_what_cannot_be_read_is_refused_by_name(root: Path, spoil: Callable[[Path], object], message: str) -> None:
    spoil(root)
    with pytest.raises(BadInput, match=message):
        read_frames(something_something(root)[0].path, 4)


def test_a_folder_without_clips_is_refused(tmp_path: Path) -> None:
    for root in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(BadInput, match="must hold a folder per object"):
            folder_of_clips(root)
