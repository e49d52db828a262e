"""Files that are none, that are no longer where they were, and names that lead elsewhere."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from zest_rl.errors import BadInput
from zest_rl.runtime.files import check_file, file_under, is_there, user_path

POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:" + "a" * 64 + "\nsize 123456\n"


def test_a_git_lfs_pointer_is_told_from_the_file_it_stands_for(tmp_path: Path) -> None:
    (tmp_path / "data.parquet").write_text(POINTER)
    with pytest.raises(BadInput, match=r"data\.parquet is a Git LFS pointer.*git lfs pull"):
        check_file(tmp_path / "data.parquet")


def test_what_is_no_regular_file_is_refused_without_waiting_for_it(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zeros").symlink_to("/dev/zero")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "empty").touch()
    for name in ("pipe", "zeros", "."):
        with pytest.raises(BadInput, match="is not a file"):
            check_file(tmp_path / name)
    for name in ("none", "loop", "\0", "x" * 9999, "\ud800"):
        with pytest.raises(BadInput, match="does not exist"):
            check_file(tmp_path / name)
    with pytest.raises(BadInput, match="is empty"):
        check_file(tmp_path / "empty")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_that_may_not_be_read_is_told_as_such(tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("x")
    (tmp_path / "secret").chmod(0)
    with pytest.raises(BadInput, match="secret may not be read; change its permissions"):
        check_file(tmp_path / "secret")


def test_the_home_folder_of_nobody_is_a_name_like_any_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert user_path("~/goals") == tmp_path / "goals"
    assert user_path("~nobody-here/goals") == Path("~nobody-here/goals")
    assert not any(map(is_there, (Path("x" * 9999), Path("\0"), tmp_path / "none")))
    assert is_there(tmp_path)


def test_a_name_in_data_cannot_leave_the_folder_of_the_data(tmp_path: Path) -> None:
    root = tmp_path / "data"
    root.mkdir()
    (tmp_path / "other").write_text("x")
    for name in ("../other", "a/../../other", str(tmp_path / "other"), "/dev/zero"):
        with pytest.raises(BadInput, match="which is outside that folder"):
            file_under(root, name)


def test_the_links_of_a_hugging_face_snapshot_are_followed(tmp_path: Path) -> None:
    root = tmp_path / "snapshots" / "main"
    (root / "data").mkdir(parents=True)
    (tmp_path / "blobs").mkdir()
    (tmp_path / "blobs" / "0a1b").write_text("rows")
    (root / "data" / "file.parquet").symlink_to("../../../blobs/0a1b")
    assert file_under(root, "data/file.parquet").read_text() == "rows"
