"""Exports that run out of disk, or that two processes write at once: a file is whole or not there."""

from __future__ import annotations

import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import zest_rl.export
from zest_rl.errors import ZestError
from zest_rl.export import WRITERS, Format, export
from zest_rl.runtime import artifacts

if TYPE_CHECKING:
    from conftest import Disk

EXPORT_FAILED = r"the export could not be written: the (disk is full|writing process died \(SIG).*; nothing was left"


def write_without_checking_space(*args: Any) -> Any:
    """As the child process of an export, whose disk fills up after the space was checked."""
    artifacts.check_free_space = lambda folder, n_bytes: None
    return zest_rl.export._write(*args)


@pytest.mark.parametrize("to", WRITERS)
def test_a_disk_that_fills_up_while_exporting_is_an_error_of_this_process_and_leaves_nothing(
    to: Format, scored: str, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zest_rl.export, "_write", write_without_checking_space)
    disk.fill(4096)
    with pytest.raises(ZestError, match=EXPORT_FAILED):
        export(scored, to, disk.path / "out")
    assert {path.name for path in disk.path.iterdir()} == {"ballast"}


@pytest.mark.slow
@pytest.mark.parametrize("to", ["d4rl", "robomimic", "d3rlpy"])
def test_whatever_room_is_left_an_hdf5_file_is_whole_or_not_there(
    to: Format, scored: str, disk: Disk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zest_rl.export, "_write", write_without_checking_space)
    whole = export(scored, to, tmp_path / "whole")
    n_written = 0
    for n_pages in range(0, whole.n_bytes // 4096 + 8, 2):
        disk.fill(4096 * n_pages)
        with suppress(ZestError):
            written = export(scored, to, disk.path / "out")
            assert written.n_bytes == whole.n_bytes
            written.path.unlink()
            n_written += 1
        (disk.path / "ballast").unlink()
    assert 1 <= n_written <= 8


def test_an_export_for_which_there_is_no_room_is_refused_beforehand(scored: str, disk: Disk) -> None:
    with pytest.raises(ZestError, match="not enough disk space"):
        export(scored, "d4rl", disk.path / "out")
    assert {path.name for path in disk.path.iterdir()} == set()


def exporting(dataset_id: str, to: str, path: Path) -> subprocess.Popen[str]:
    code = "import sys; from pathlib import Path; from zest_rl import cli; sys.exit(cli.main(sys.argv[1:]))"
    words = ["export", dataset_id, "--to", to, "--output", str(path)]
    return subprocess.Popen([sys.executable, "-c", code, *words], stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize("to", ["npz", "torchrl"])
def test_of_two_exports_to_one_place_the_second_is_refused_and_harms_nothing(
    to: str, scored: str, tmp_path: Path
) -> None:
    both = [exporting(scored, to, tmp_path / "out") for _ in range(2)]
    messages = [process.communicate(timeout=120)[1] for process in both]
    assert sorted(process.returncode for process in both) == [0, 2]
    assert sum("exists; delete it, or choose another --output" in message for message in messages) == 1
    assert {path.name for path in tmp_path.glob("*out*")} == {"out"}
