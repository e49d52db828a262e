"""LeRobot's folders as people have them, in part or damaged: told before anything is embedded."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import imageio_ffmpeg
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from fuzzing import outcome, with_memory
from lerobot_files import KEY, change_info, change_rows, store_pictures, write_lerobot
from rollouts import Episode

from zest_rl.errors import BadInput, Notice
from zest_rl.sources import Source, open_source
from zest_rl.sources.parquet import MAX_ROWS, read_table

LISTING, DATA = (f"{at}/chunk-000/file-000.parquet" for at in ("meta/episodes", "data"))
VIDEO = f"videos/{KEY}/chunk-000/file-000.mp4"
POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:" + "a" * 64 + "\nsize 123456\n"


@pytest.fixture(scope="module")
def whole(maze: list[Episode], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Episodes 0 and 1 in the first files, 2 in the second."""
    return write_lerobot(tmp_path_factory.mktemp("whole") / "pusht", maze)


@pytest.fixture
def root(whole: Path, tmp_path: Path) -> Path:
    return shutil.copytree(whole, tmp_path / "pusht")


def check(root: Path, **options: Any) -> Source:
    """What `zest relabel` reads before it embeds."""
    source = open_source(str(root), **options)
    source.trajectories.fingerprint()
    return source


@pytest.mark.parametrize("name", ["data_path", "video_path"])
@pytest.mark.parametrize(
    ("template", "message"),
    [
        ("../{chunk_index}", r"names the file '\.\./0', which is outside that folder"),
        ("/dev/zero", "names the file '/dev/zero', which is outside"),
        ("a/../../{file_index:03d}", "which is outside"),
        ("{chunk_index.__class__}", "may name chunk_index, file_index and video_key only"),
        ("{chunk_index:>3000000000}", "may name chunk_index, file_index and video_key only"),
        ("{chunk_index!r}", "may name chunk_index, file_index and video_key only"),
        ("{other}", "may name chunk_index, file_index and video_key only"),
        ("\0", "lacks"),
    ],
)
def test_paths_in_info_are_filled_in_plainly_and_stay_in_the_folder(
    root: Path, name: str, template: str, message: str
) -> None:
    change_info(root, lambda info: info.update({name: template}))
    with pytest.raises(BadInput, match=message):
        check(root)


def test_the_name_of_a_feature_cannot_lead_out_of_the_folder(root: Path) -> None:
    for name in ("../../x", "..", "a/b", "\x1b[2J"):
        shutil.copy(root / "meta" / "info.json", root / "info.json")
        change_info(root, lambda info, name=name: info["features"].update({name: info["features"].pop(KEY)}))
        with pytest.raises(BadInput, match="cannot be the name of a feature"):
            check(root)
        shutil.move(root / "info.json", root / "meta" / "info.json")


def test_a_device_in_place_of_a_file_is_refused_at_once(root: Path) -> None:
    for name in (DATA, VIDEO, LISTING):
        (root / name).rename(root / "kept")
        (root / name).symlink_to("/dev/zero")
        with pytest.raises(BadInput, match="is not a file"):
            check(root)
        (root / "kept").rename(root / name)


def test_the_cache_of_hugging_face_with_its_links_is_read(root: Path, whole: Path) -> None:
    (root.parent / "blobs").mkdir()
    for path in [path for path in root.rglob("*") if path.is_file()]:
        blob = root.parent / "blobs" / str(len(list((root.parent / "blobs").iterdir())))
        path.rename(blob)
        path.symlink_to(blob)
    assert check(root).trajectories.fingerprint() == check(whole).trajectories.fingerprint()


@pytest.mark.parametrize("name", [DATA, VIDEO, LISTING])
def test_a_git_lfs_pointer_is_told_as_one(root: Path, name: str) -> None:
    (root / name).write_text(POINTER)
    with pytest.raises(BadInput, match=r"file-000\.\w+ is a Git LFS pointer.*git lfs pull"):
        check(root)


def test_episodes_that_were_not_downloaded_are_named_and_the_others_offered(root: Path, maze: list[Episode]) -> None:
    (root / "data" / "chunk-000" / "file-001.parquet").unlink()
    with pytest.raises(
        BadInput,
        match=r"1 of the 3 episodes of .* are incomplete: episode 2 lacks data/chunk-000/file-001\.parquet; download "
        r"the dataset whole, or take what is there by --skip-incomplete: 2 episodes \(0, 1\)",
    ):
        check(root)
    with pytest.warns(Notice, match="episode 2 lacks .* they are left out"):
        source = check(root, skip_incomplete=True)
    assert list(source.trajectories.n_steps) == [len(episode.actions) for episode in maze[:2]]
    (root / DATA).unlink()
    with pytest.raises(BadInput, match=r"3 of the 3 episodes .* 0 episodes \(none\)"):
        check(root, skip_incomplete=True)


def test_an_episode_without_steps_is_named_and_can_be_skipped(root: Path) -> None:
    rows = pyarrow.parquet.read_table(root / LISTING).to_pylist()
    rows.append({**rows[-1], "episode_index": 3, "length": 0})
    pyarrow.parquet.write_table(pyarrow.Table.from_pylist(rows), root / LISTING)
    change_info(root, lambda info: info.update(total_episodes=4))
    with pytest.raises(BadInput, match="episode 3 has 0 steps"):
        check(root)
    with pytest.warns(Notice, match="episode 3 has 0 steps; they are left out"):
        assert len(check(root, skip_incomplete=True).trajectories.n_steps) == 3


def test_the_number_of_episodes_is_told_where_it_is_not_that_of_info(root: Path) -> None:
    change_info(root, lambda info: info.update(total_episodes=7))
    with pytest.warns(Notice, match=r"lists 3 episodes, but info\.json says 7; those that are listed are taken"):
        check(root)


def test_the_names_of_openpi_are_understood(root: Path, whole: Path) -> None:
    names = {"observation.state": "state", "action": "actions", KEY: "image"}
    change_info(
        root, lambda info: info.update(features={names.get(name, name): f for name, f in info["features"].items()})
    )
    (root / "videos" / KEY).rename(root / "videos" / "image")
    for path in root.rglob("*.parquet"):
        table = pyarrow.parquet.read_table(path)
        renamed = [names.get(name, name.replace(KEY, "image")) for name in table.column_names]
        pyarrow.parquet.write_table(table.rename_columns(renamed), path)
    source, expected = check(root), check(whole)
    assert list(source.frames.views) == ["image"]
    for ours, theirs in zip(source.trajectories.episodes(), expected.trajectories.episodes(), strict=True):  # type: ignore[attr-defined]
        assert list(ours.obs) == ["state"]
        np.testing.assert_array_equal(ours.obs["state"], theirs.obs["observation.state"])
        np.testing.assert_array_equal(ours.actions, theirs.actions)


def test_pictures_in_the_data_files_are_frames(root: Path, whole: Path, maze: list[Episode]) -> None:
    store_pictures(root, maze)
    for options in ({}, {"frames": [KEY]}):
        source = check(root, **options)
        assert source.trajectories.fingerprint() == check(whole).trajectories.fingerprint()
        for i, episode in enumerate(maze):
            np.testing.assert_array_equal([views[0] for views in source.frames.read(i)], episode.frames[:-1])
    assert len({check(root).frames.digest(i) for i in range(3)}) == 3
    change_rows(root / DATA, lambda row: row.pop(KEY))
    with pytest.raises(BadInput, match=f"file-000.parquet has no column '{KEY}', as info.json says"):
        check(root)


@pytest.mark.parametrize(
    ("stored", "message"),
    [
        ({"bytes": None, "path": "/etc/passwd"}, "of episode 0 in .* lacks a picture, or names a file elsewhere"),
        ("/etc/passwd", "of episode 0 in .* lacks a picture, or names a file elsewhere"),
        ({"bytes": b"%!PS-Adobe-3.0 EPSF-3.0", "path": ""}, "at step 0 of episode 0 in .* is not an image"),
    ],
)
def test_a_picture_in_a_data_file_that_is_none_is_named(
    root: Path, maze: list[Episode], stored: Any, message: str
) -> None:
    store_pictures(root, maze)
    change_rows(root / DATA, lambda row: row.update({KEY: stored}))
    with pytest.raises(BadInput, match=message):
        list(check(root).frames.read(0))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda row: row.update(action=[float("nan"), 0.0]),
            "action of episode 0 in .*file-000.parquet must be finite",
        ),
        (lambda row: row.update(action=None), "action of episode 0 in .* has no value|must hold numbers"),
        (lambda row: row.update(action=[0.0, None]), "has no value in a list"),
        (lambda row: row.update(action=[0.0] * (1 + row["frame_index"])), "must hold equally long lists"),
        (
            lambda row: row.update(action=[0.0] * (1 + row["episode_index"])),
            "holds 2 numbers per step, but 1 in the fi",
        ),
        (lambda row: row.update(action="left"), "must hold numbers or lists of them, got string"),
        (lambda row: row.update(action=[[0.0, 1.0]]), "must hold numbers or lists of them, got list"),
        (lambda row: row.pop("action"), "has no column 'action'"),
        (lambda row: row.update(episode_index="0"), "episode_index must be whole numbers"),
        (lambda row: row.update(episode_index=0), "has 10 rows of episode 0, but meta/episodes says 4"),
    ],
)
def test_a_column_that_is_not_what_it_should_be_is_named_with_file_and_episode(
    root: Path, change: Callable[[dict[str, Any]], object], message: str
) -> None:
    change_rows(root / DATA, change)
    with pytest.raises(BadInput, match=message):
        check(root)


def test_a_column_of_other_values_or_with_two_of_its_name_is_refused(root: Path) -> None:
    table = pyarrow.parquet.read_table(root / DATA)
    at = table.column_names.index("action")
    encoded = table.set_column(at, "action", pyarrow.array(["left"] * len(table)).dictionary_encode())
    double = table.append_column("action", table["action"])
    empty = table.set_column(at, "action", pyarrow.array([[]] * len(table), pyarrow.list_(pyarrow.float32())))
    for damaged, message in (
        (encoded, "must hold numbers or lists of them, got dict"),
        (double, "has 2 columns 'action'"),
        (empty, r"must hold equally long lists, of 1 number at least, got lengths \[0\]"),
    ):
        pyarrow.parquet.write_table(damaged, root / DATA)
        with pytest.raises(BadInput, match=message):
            check(root)


def test_a_file_that_does_not_fit_in_memory_is_not_called_damaged(tmp_path: Path) -> None:
    zeros = pyarrow.chunked_array([np.zeros(10**6)] * 50)
    pyarrow.parquet.write_table(pyarrow.table({"action": zeros}), tmp_path / "great.parquet")

    def read() -> None:
        pyarrow.set_memory_pool(pyarrow.system_memory_pool())  # the usual one keeps room
        with_memory(10**8, lambda: read_table(tmp_path / "great.parquet", ["action"], MAX_ROWS))

    end = outcome(read)
    assert (end.kind, "great.parquet needs more memory than there is" in end.detail) == ("refused", True), end


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda row: row.update(length=10**12), "episode_index is 0, length 1000000000000"),
        (lambda row: row.update(length=10**6), r"has 10 rows, but meta/episodes lists 2000000 of them"),
        (lambda row: row.update(length=None), "is not that of a LeRobot v3.0 dataset"),
        (lambda row: row.update({f"videos/{KEY}/from_timestamp": float("nan")}), "from_timestamp is nan"),
        (
            lambda row: row.update({f"videos/{KEY}/from_timestamp": 10.0}),
            "has no frame for step 0 of episode 0, at 10.000",
        ),
        (lambda row: row.update({f"videos/{KEY}/from_timestamp": 0.3}), "has no frame for step 1 of episode 2, at"),
        (lambda row: row.update({"data/file_index": "../x"}), "is not that of a LeRobot v3.0 dataset"),
        (lambda row: row.pop("length"), "has no column 'length'"),
    ],
)
def test_what_the_listing_says_is_compared_with_the_files(
    root: Path, change: Callable[[dict[str, Any]], object], message: str
) -> None:
    change_rows(root / LISTING, change)
    with pytest.raises(BadInput, match=message):
        check(root)


@pytest.mark.parametrize(
    "change",
    [
        lambda info: info.update(fps=0),
        lambda info: info.update(fps="fast"),
        lambda info: info.update(fps=float("inf")),
        lambda info: info.update(features=[1]),
        lambda info: info["features"].update(action=3),
        lambda info: info["features"]["action"].update(shape="wide"),
        lambda info: info.update(total_episodes=[]),
    ],
)
def test_info_of_other_types_is_refused(root: Path, change: Callable[[dict[str, Any]], object]) -> None:
    change_info(root, change)
    with pytest.raises(BadInput, match=r"is not that of a LeRobot v3\.0 dataset \(.* in info\.json\)"):
        check(root)


def test_a_video_that_lacks_a_frame_is_refused_rather_than_shifted(root: Path) -> None:
    frames = imageio.mimread(root / VIDEO)
    imageio.mimwrite(root / VIDEO, frames[:-1], fps=10, macro_block_size=2)
    with pytest.raises(
        BadInput, match=rf"{KEY}.*file-000\.mp4 has no frame for step 5 of episode 1, at 0\.900 s: 9 frames"
    ):
        check(root)
    imageio.mimwrite(root / VIDEO, frames, fps=9, macro_block_size=2)
    with pytest.raises(BadInput, match=r"has no frame for step . of episode 1, .* info\.json says 10 per second"):
        check(root)


def test_times_that_drift_and_a_video_that_starts_late_show_the_same_frames(root: Path, whole: Path) -> None:
    expected = [list(check(whole).frames.read(i)) for i in range(3)]
    drift = {f"videos/{KEY}/from_timestamp": 0.03}
    change_rows(root / LISTING, lambda row: row.update({name: row[name] + by for name, by in drift.items()}))
    words = ["-v", "error", "-i", root / VIDEO, "-c", "copy", "-output_ts_offset", "0.5", root / "late.mp4"]
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), *words], check=True)
    (root / "late.mp4").replace(root / VIDEO)
    source = check(root)
    for i, frames in enumerate(expected):
        np.testing.assert_array_equal(list(source.frames.read(i)), frames)


def test_a_folder_of_any_name_is_read_in_any_locale(root: Path) -> None:
    folder, plain = (
        root.rename(root.parent / "кухня データ"),
        {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"},
    )
    code = (
        "import sys; from zest_rl.sources import open_source; source = open_source(sys.argv[1]); "
        "print(source.trajectories.fingerprint(), len(list(source.frames.read(0))))"
    )
    words = [sys.executable, "-c", code, str(folder)]
    done = subprocess.run(words, env=os.environ | plain, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [check(folder).trajectories.fingerprint(), "4"]
