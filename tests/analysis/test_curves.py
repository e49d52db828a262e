"""A film that is drawn, in every form that people have it in, scored by two pictures."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import matplotlib as mpl
import numpy as np
import pytest
from gymnasium import spaces
from matplotlib.figure import Figure
from minari_files import Recorded, write_minari
from PIL import Image, ImageDraw
from read_dataset import read

import zest_rl
from zest_rl.data.reader import Dataset
from zest_rl.errors import BadInput
from zest_rl.types import Frame

N_FRAMES = 6


def draw(opened: float) -> Frame:
    """A cupboard whose door slides from the left, where it covers an orange inside, to the right."""
    image = Image.new("RGB", (96, 64), "#cfd8dc")
    pen = ImageDraw.Draw(image)
    pen.rectangle((12, 12, 84, 52), fill="#4e342e")
    pen.ellipse((22, 22, 42, 42), fill="#ff9800")
    left = 14 + round(34 * opened)
    pen.rectangle((left, 12, left + 36, 52), fill="#90a4ae", outline="black")
    return np.array(image)


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    return np.stack([draw(opened) for opened in np.linspace(0, 1, N_FRAMES)])


@pytest.fixture
def folder(frames: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder: the film as a video and as pictures, the goal as pictures and as a folder."""
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    (tmp_path / "minari").mkdir()
    monkeypatch.chdir(tmp_path)
    imageio.mimwrite("film.mp4", list(frames), fps=4, codec="libx264", quality=10, macro_block_size=2)
    for path, frame in {"closed.png": frames[0], "open.png": frames[-1]}.items():
        Image.fromarray(frame).save(path)
    for name in ("film", "goal/init", "goal/goal"):
        Path(name).mkdir(parents=True)
    for i, frame in enumerate(frames):
        Image.fromarray(frame).save(f"film/{i}.png")
    Image.fromarray(frames[0]).save("goal/init/0.png")
    Image.fromarray(frames[-1]).save("goal/goal/0.png")
    return tmp_path


def relabeled(zest: Callable[..., dict[str, Any]], observations: Any, space: spaces.Space[Any], *words: str) -> Any:
    """Scores of the one episode of a dataset, as `zest relabel` writes them."""
    actions, rewards = np.zeros((N_FRAMES - 1, 1), np.float32), np.zeros(N_FRAMES - 1)
    episode = Recorded(observations, actions, rewards)
    dataset = write_minari("door/drawn-v0", [episode], space, spaces.Box(-1, 1, (1,), np.float32), jpeg_encoding=False)
    words = ("relabel", dataset, "--goal", "goal", "--n-workers", "1", *words)
    return read(zest(*words)["dataset"], Dataset.scores)[0]


def test_the_scores_of_an_array_are_those_that_relabel_writes(
    folder: Path, frames: np.ndarray, zest: Callable[..., dict[str, Any]]
) -> None:
    curve = zest_rl.score(frames, start="closed.png", goal="open.png")
    written = relabeled(zest, frames, spaces.Box(0, 255, frames.shape[1:], np.uint8))
    np.testing.assert_array_equal(curve.scores, written)
    assert (curve.scores.dtype, curve.scores[0], len(curve)) == (np.float32, 0, N_FRAMES)
    assert curve.scores[-1] == pytest.approx(1, abs=1e-5), "the last frame is the goal picture"
    assert (curve.times.tolist(), curve.unit) == (list(range(N_FRAMES)), "step")


def test_the_scores_of_a_video_are_those_that_relabel_writes(folder: Path, zest: Callable[..., dict[str, Any]]) -> None:
    curve = zest_rl.score("film.mp4", start="closed.png", goal="open.png")
    (folder / "films").mkdir()
    (folder / "film.mp4").rename(folder / "films" / "episode_0.mp4")
    observations = np.zeros((N_FRAMES, 1), np.float32)
    written = relabeled(zest, observations, spaces.Box(-1, 1, (1,), np.float32), "--frames", str(folder / "films"))
    np.testing.assert_array_equal(curve.scores, written)
    np.testing.assert_allclose(curve.times, np.arange(N_FRAMES) / 4)
    assert curve.unit == "s"


def test_a_film_and_a_goal_may_have_any_form(folder: Path, frames: np.ndarray) -> None:
    images = [Image.fromarray(frame) for frame in frames]
    expected = np.asarray(zest_rl.score(frames, "closed.png", "open.png"))
    for film, start, goal in (
        ("film", "closed.png", Path("open.png")),
        (images, images[0], images[-1]),
        (list(frames), frames[0], frames[-1]),
        (Path("film"), frames[:1], [images[-1]]),
        ([f"film/{i}.png" for i in range(N_FRAMES)], "goal/init", "goal/goal"),
        (frames, None, "open.png"),
        (frames, None, "goal"),
    ):
        np.testing.assert_array_equal(np.asarray(zest_rl.score(film, start=start, goal=goal)), expected)
    several = zest_rl.score(frames, start="closed.png", goal=frames[-2:])
    assert not np.allclose(several, expected), "scores are averaged over the goals"


def test_every_second_frame_has_its_own_time(folder: Path) -> None:
    curve = zest_rl.score("film.mp4", goal="open.png", stride=2)
    np.testing.assert_allclose(curve.times, [0, 0.5, 1])
    np.testing.assert_array_equal(curve, zest_rl.score("film.mp4", goal="open.png").scores[::2])


def test_a_picture_in_memory_is_seen_as_the_same_picture_in_a_file(folder: Path, frames: np.ndarray) -> None:
    clear = Image.fromarray(frames[-1]).convert("RGBA")
    clear.putalpha(Image.linear_gradient("L").resize(clear.size))
    grey = Image.fromarray(frames[-1][..., 0].astype(np.uint16) * 257)
    turned = Image.fromarray(np.rot90(frames[-1]))
    exif = Image.Exif()
    exif[0x0112] = 6  # the camera was held upright
    clear.save("clear.png")
    grey.save("grey.png")
    turned.save("turned.jpg", exif=exif)
    for path in ("clear.png", "grey.png", "turned.jpg"):
        in_memory = zest_rl.score(frames, goal=Image.open(path))
        np.testing.assert_array_equal(in_memory, np.asarray(zest_rl.score(frames, goal=path)), err_msg=path)


def test_a_curve_is_drawn_written_and_shown_in_notebooks(folder: Path) -> None:
    mpl.use("agg")
    curve = zest_rl.score("film.mp4", start="closed.png", goal="open.png")
    assert re.fullmatch(
        r"Curve of film.mp4: 6 scores, first 0.000, last 0.9\d\d, highest 0.9\d\d at 1.25 s", repr(curve)
    )
    ax = curve.plot()
    np.testing.assert_array_equal(ax.lines[0].get_xydata(), np.stack([curve.times, curve.scores], axis=1))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time, s", "ZeST score")
    given = Figure().subplots()
    assert curve.plot(given) is given

    with curve.to_csv("scores.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["s", "score"]
    np.testing.assert_array_equal(np.array([row["score"] for row in rows], np.float32), curve.scores)

    html = curve._repr_html_()
    assert html.count("<svg") == 1
    assert [part.split("<")[0] for part in html.split("<figcaption>")[1:]] == [
        "start", "goal", "first frame", "last frame",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"film": "gone.mp4"}, "gone.mp4 does not exist; check the path"),
        ({"film": "goal/goal"}, r"a film must have at least 2 frames, .* got 1 .*; give the frames of an episode"),
        ({"film": []}, "a film must have at least 2 frames, got 0"),
        (
            {"film": np.zeros((4, 8, 8, 3))},
            r"\(T, H, W, 3\) and dtype uint8 .* got shape \(4, 8, 8, 3\) and dtype float64",
        ),
        ({"film": np.zeros((4, 3, 8, 8), np.uint8)}, r"got shape \(4, 3, 8, 8\) and dtype uint8; put channels last"),
        ({"film": np.zeros((8, 8, 3), np.uint8)}, r"got shape \(8, 8, 3\)"),
        ({"film": 7}, "a film must be a video file, a folder of pictures, .* got int"),
        ({"film": ["closed.png", 7]}, r"frame 1 must be a file, a PIL image, or an array .*, got int"),
        ({"film": "film", "stride": 9}, "got 1 with stride 9"),
        ({"stride": 0}, "stride must be at least 1, got 0"),
        ({"goal": None}, "a score needs a goal, got none; give goal='open.png'"),
        ({"goal": "closed.png"}, "start and goal must differ, but both have the same picture; give"),
        ({"start": None, "goal": "closed.png"}, "without a start, it is the first frame of the film"),
        (
            {"goal": "opne.png"},
            "the goal 'opne.png' does not exist; give a picture, a folder of pictures, or a sentence",
        ),
        ({"goal": np.zeros((8, 8), np.uint8)}, r"the goal must be a file, .* got shape \(8, 8\) and dtype uint8"),
        ({"goal": [np.zeros((8, 8), np.uint8)]}, r"picture 0 of the goal must be a file"),
        ({"goal": Image.new("F", (8, 8))}, "the goal is a PIL image of mode F, which is not read; convert it to RGB"),
        ({"goal": "text:open"}, "must both be pictures or both sentences, but only the goal is a sentence"),
        ({"start": "text:closed", "goal": "text:closed"}, "both have the same sentence"),
        (
            {"start": "text:closed", "goal": "text:open"},
            "is a sentence, but embedder 'efficientnet-lite0' reads pictures",
        ),
        ({"start": None, "goal": "text:open"}, "a text goal must look like"),
        ({"features": "detla"}, "unknown features 'detla'; did you mean 'delta'"),
    ],
)
def test_what_cannot_be_scored_is_refused(
    folder: Path, frames: np.ndarray, change: dict[str, Any], message: str
) -> None:
    with pytest.raises(BadInput, match=message):
        zest_rl.score(**({"film": frames, "start": "closed.png", "goal": "open.png"} | change))
