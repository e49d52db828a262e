"""Videos and folders of pictures beside a dataset without frames."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
from PIL import Image
from read_dataset import read
from rollouts import Episode, Run, expected_scores, write_blind

from zest_rl.data.reader import Dataset, open_dataset
from zest_rl.errors import BadInput, ZestError
from zest_rl.sources.recorded_frames import middle_view
from zest_rl.sources.videos import find_videos
from zest_rl.types import Frame


def write_video(path: Path, frames: list[Frame]) -> None:
    """H.264 as people have it."""
    imageio.mimwrite(path, frames, fps=10, codec="libx264", quality=9, macro_block_size=2)


def write_films_and_masks(folder: Path, episodes: list[Episode]) -> None:
    """``films`` as pictures, and ``masks`` that hide nothing."""
    for i, episode in enumerate(episodes):
        for name in ("films", "masks"):
            (folder / name / f"episode_{i}").mkdir(parents=True)
        for t, frame in enumerate(episode.frames):
            Image.fromarray(frame).save(folder / "films" / f"episode_{i}" / f"{t}.png")
            Image.new("L", frame.shape[1::-1]).save(folder / "masks" / f"episode_{i}" / f"{t}.png")


def test_folders_of_videos_and_of_pictures_are_views(
    maze: list[Episode], goal: Path, zest: Run, tmp_path: Path
) -> None:
    for i, episode in enumerate(maze):
        (tmp_path / "top" / f"episode_{i:03d}").mkdir(parents=True)
        for t, frame in enumerate(episode.frames):
            Image.fromarray(frame).save(tmp_path / "top" / f"episode_{i:03d}" / f"frame{t}.png")
        (tmp_path / "films").mkdir(exist_ok=True)
        write_video(tmp_path / "films" / f"episode_{i}.mp4", episode.frames)
    dataset = write_blind(maze)
    top = zest("relabel", dataset, "--goal", goal, "--frames", tmp_path / "top", "--n-workers", "1")
    for episode, scores in zip(maze, read(top["dataset"], Dataset.scores), strict=True):
        np.testing.assert_allclose(scores, expected_scores([episode.frames], goal), atol=1e-4)
    folders = [tmp_path / "top", tmp_path / "films"]
    both = zest("relabel", dataset, "--goal", goal, "--frames", *folders, "--n-workers", "1")
    assert both["views"] == ["top", "films"]
    films = [imageio.mimread(tmp_path / "films" / f"episode_{i}.mp4") for i in range(len(maze))]
    for episode, film, scores in zip(maze, films, read(both["dataset"], Dataset.scores), strict=True):
        np.testing.assert_allclose(scores, expected_scores([episode.frames, list(film)], goal), atol=1e-4)


@pytest.mark.parametrize("masks", [False, True])
def test_inspect_shows_what_lies_in_a_folder_as_long_as_it_is_what_was_scored(
    maze: list[Episode], goal: Path, zest: Run, tmp_path: Path, *, masks: bool
) -> None:
    write_films_and_masks(tmp_path, maze)
    words = ["--frames", tmp_path / "films", *(["--masks", tmp_path / "masks"] if masks else [])]
    made = zest("relabel", write_blind(maze), "--goal", goal, *words, "--n-workers", "1")["dataset"]

    def page() -> str:
        zest("inspect", made, "--output", tmp_path / "page.html")
        return (tmp_path / "page.html").read_text()

    shown = page()
    assert (shown.count('class="strip"'), shown.count("data:video/mp4")) == (2, 2)
    assert "Not shown" not in shown
    assert "All true returns are equal, so they rank nothing" in shown
    assert "Undefined: all returns, or all true ones, are equal." in shown
    Image.fromarray(maze[0].frames[0]).save(tmp_path / "films" / "episode_1" / "2.png")
    changed = page()
    assert "and the files there are not those that were scored" in changed
    shutil.rmtree(tmp_path / "films")
    gone = page()
    assert "which is not there" in gone
    for without in (changed, gone):
        assert "<h2>Not shown</h2>" in without
        assert 'class="strip"' not in without
        assert str(tmp_path) not in without


def test_a_curated_dataset_finds_the_films_of_its_episodes_among_those_of_all(
    maze: list[Episode], goal: Path, zest: Run, tmp_path: Path
) -> None:
    write_films_and_masks(tmp_path, maze)
    words = ["--goal", goal, "--frames", tmp_path / "films", "--masks", tmp_path / "masks", "--n-workers", "1"]
    scored = zest("relabel", write_blind(maze), *words)["dataset"]
    curated = zest("curate", scored, "--keep", "0.67", "--output", tmp_path / "table.csv")["dataset"]
    for made in (curated, zest("relabel", curated, *words)["dataset"]):
        with open_dataset(made) as ds:
            assert ds.record.curate is not None
            films = middle_view(ds)
            for i, number in enumerate(ds.record.curate.episodes):
                np.testing.assert_array_equal([frame for (frame,) in films.read(i)], maze[number].frames)
        assert len(read(made, Dataset.scores)) == 2
    shutil.rmtree(tmp_path / "films" / "episode_1")
    with open_dataset(curated) as ds, pytest.raises(ZestError, match="not those that were scored"):
        middle_view(ds)


def test_one_frame_may_be_missing_at_the_end_and_no_more(
    maze: list[Episode], goal: Path, zest: Run, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    dataset = write_blind(maze)
    words = ["relabel", dataset, "--goal", goal, "--frames", tmp_path / "films", "--n-workers", "1"]

    def leave(n_missing: int) -> None:
        shutil.rmtree(tmp_path / "films", ignore_errors=True)
        for i, episode in enumerate(maze):
            folder = tmp_path / "films" / f"episode_{i}"
            folder.mkdir(parents=True)
            for t, frame in enumerate(episode.frames[: len(episode.frames) - n_missing]):
                Image.fromarray(frame).save(folder / f"{t}.png")

    leave(1)
    scores = read(zest(*words)["dataset"], Dataset.scores)
    for episode, one in zip(maze, scores, strict=True):
        np.testing.assert_allclose(one[:-1], expected_scores([episode.frames[:-1]], goal), atol=1e-4)
        assert one[-1] == one[-2]
    leave(2)
    code, error = refusal(*words)
    assert code == 2
    assert "episode 0 has 4 actions, so it needs 5 frames (x_0 … x_T), or 4 without the last; got 3" in error
    shutil.rmtree(tmp_path / "films" / "episode_1")
    code, error = refusal(*words)
    assert (code, "1 are missing, the first is 1" in error) == (2, True)


def test_what_is_no_video_file_is_refused_before_it_is_hashed(tmp_path: Path) -> None:
    (tmp_path / "episode_0.mp4").symlink_to("/dev/zero")
    with pytest.raises(BadInput, match=r"episode_0\.mp4 is not a file"):
        find_videos([tmp_path], 1, "it")
    (tmp_path / "episode_0.mp4").unlink()
    (tmp_path / "episode_0.mp4").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    with pytest.raises(BadInput, match=r"episode_0\.mp4 is a Git LFS pointer"):
        find_videos([tmp_path], 1, "it")
