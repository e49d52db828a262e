from __future__ import annotations

import os
from pathlib import Path

import pytest

from zest_rl.errors import Notice, ZestError
from zest_rl.runtime.cache import cache_folder, check_private


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "deep/cache"))
    return tmp_path / "deep/cache"


@pytest.mark.parametrize("umask", [0o000, 0o002, 0o022, 0o077])
def test_a_cache_is_made_for_its_owner_alone_whatever_the_umask(root: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        assert cache_folder("frames", "abc") == root / "frames/abc" == cache_folder("frames", "abc")
    finally:
        os.umask(before)
    assert {path.stat().st_mode & 0o777 for path in (root, *root.rglob("*"))} == {0o700}


@pytest.mark.parametrize("below", ["", "frames", "frames/abc"])
@pytest.mark.parametrize("mode", [0o777, 0o702])
def test_a_cache_that_everybody_can_write_to_is_refused_with_what_to_type(root: Path, below: str, mode: int) -> None:
    cache_folder("frames", "abc")
    (root / below).chmod(mode)
    with pytest.raises(
        ZestError, match=rf"everybody can write to the cache .* \(mode {mode:o}\).*: chmod -R go-w {root / below}"
    ):
        cache_folder("frames", "abc")
    (root / below).chmod(mode & 0o755)
    cache_folder("frames", "abc")


def test_a_cache_that_its_group_could_write_to_becomes_this_user_s_alone_and_one_notice_says_so(root: Path) -> None:
    cache_folder("frames", "abc")
    folders = [root, root / "frames", root / "frames/abc"]
    for folder in folders:
        folder.chmod(0o775)
    with pytest.warns(Notice, match=rf"the cache {root}, which its group could write to, is yours alone now") as told:
        cache_folder("frames", "abc")
    assert len(told) == 1
    assert [folder.stat().st_mode & 0o777 for folder in folders] == [0o700] * 3


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder away")
def test_a_cache_of_someone_else_is_refused(root: Path) -> None:
    os.chown(cache_folder("frames"), 12345, -1)
    with pytest.raises(ZestError, match=r"frames belongs to user 12345 and not to you .*set ZEST_CACHE to a folder of"):
        cache_folder("frames", "abc")


def test_a_cache_that_cannot_be_made_names_the_variable(root: Path) -> None:
    root.parent.mkdir()
    root.write_text("a file")
    with pytest.raises(ZestError, match=r"cache .*cache cannot be used: File exists; set ZEST_CACHE to a folder of"):
        cache_folder("frames")


def test_a_home_that_others_may_read_is_private_enough(root: Path) -> None:
    root.mkdir(parents=True, mode=0o755)
    check_private(root)
