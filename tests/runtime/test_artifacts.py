from __future__ import annotations

import json
import os
import platform
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from zest_rl.errors import ZestError
from zest_rl.runtime import artifacts

if TYPE_CHECKING:
    from conftest import Disk

WRITERS = {
    "file": lambda folder: artifacts.write_bytes(folder / "a.bin", b"new"),
    "folder": lambda folder: artifacts.staged_folder(folder / "a").__enter__(),
    "lock": lambda folder: artifacts.lock(folder / "a").__enter__(),
}


def names(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")}


def start(code: str, *arguments: object) -> subprocess.Popen[str]:
    """Run Python code in a process of its own; it has written "ready" when this returns."""
    process = subprocess.Popen(
        [
            sys.executable,
            "-c",
            f"import os, sys, time\nfrom pathlib import Path\nfrom zest_rl.runtime import artifacts\n{code}",
        ]
        + [str(argument) for argument in arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


# --- hashes -----------------------------------------------------------------------------------------------------------


def test_bytes_and_files_have_their_sha256(tmp_path: Path) -> None:
    known = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    (tmp_path / "abc").write_bytes(b"abc")
    assert artifacts.hash_bytes(b"abc") == known == artifacts.hash_file(tmp_path / "abc")


def test_the_hash_of_json_sees_content_and_not_the_order_of_keys() -> None:
    assert artifacts.hash_json({"a": 1, "b": [1, 2]}) == artifacts.hash_json({"b": [1, 2], "a": 1})
    assert artifacts.hash_json({"a": 1}) != artifacts.hash_json({"a": "1"})
    assert artifacts.hash_json([1, 2]) != artifacts.hash_json([2, 1])


def test_the_hash_of_arrays_sees_type_shape_order_and_values_but_not_memory_layout() -> None:
    array = np.arange(6, dtype=np.float32).reshape(2, 3)
    digest = artifacts.hash_arrays(array)
    assert digest == artifacts.hash_arrays(np.asfortranarray(array))
    others: list[Any] = [array.view(np.int32), array.reshape(3, 2), array + 1, array[::-1]]
    assert len({digest, *(artifacts.hash_arrays(other) for other in others)}) == 5
    assert artifacts.hash_arrays(array, array + 1) != artifacts.hash_arrays(array + 1, array)


# --- files ------------------------------------------------------------------------------------------------------------


def test_a_file_is_written_with_its_folder_and_nothing_beside_it(tmp_path: Path) -> None:
    artifacts.write_bytes(tmp_path / "deep/er/a.bin", b"new")
    assert (tmp_path / "deep/er/a.bin").read_bytes() == b"new"
    assert names(tmp_path / "deep/er") == {"a.bin"}


def test_a_failure_while_writing_leaves_the_old_file_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")

    def write_half() -> None:
        with artifacts.atomic_path(path) as temporary:
            temporary.write_bytes(b"ne")
            assert path.read_bytes() == b"old"
            raise RuntimeError("cut")

    with pytest.raises(RuntimeError, match="cut"):
        write_half()
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == {"a.bin"}


def test_a_process_killed_while_writing_leaves_the_old_file_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    process = start(
        """
with artifacts.atomic_path(Path(sys.argv[1])) as temporary:
    temporary.write_bytes(b"ne")
    print("ready", flush=True)
    time.sleep(60)""",
        path,
    )
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert path.read_bytes() == b"old"
    artifacts.write_bytes(path, b"new")
    assert path.read_bytes() == b"new"
    assert names(tmp_path) == {"a.bin"}, "what was half written is removed by the next write"


WRITE_SLOWLY = """
with artifacts.atomic_path(Path(sys.argv[1])) as temporary:
    temporary.write_bytes(b"ne")
    print("ready", flush=True)
    sys.stdin.readline()
    temporary.write_bytes(b"new")"""


def test_a_file_that_another_process_is_writing_is_left_to_it(tmp_path: Path) -> None:
    process = start(WRITE_SLOWLY, tmp_path / "a.bin")
    artifacts.write_bytes(tmp_path / "b.bin", b"other")
    artifacts.write_bytes(tmp_path / "a.bin", b"mine")
    process.communicate("\n")
    assert process.returncode == 0
    assert (tmp_path / "a.bin").read_bytes() == b"new"
    assert names(tmp_path) == {"a.bin", "b.bin"}


def test_what_a_process_of_another_machine_left_is_removed_after_a_day(tmp_path: Path) -> None:
    process = start(WRITE_SLOWLY, tmp_path / "a.bin")
    (left,) = tmp_path.iterdir()
    process.kill()
    process.wait()
    elsewhere = left.rename(left.with_name(left.name.replace(artifacts._machine(), "0123abcd")))
    artifacts.write_bytes(tmp_path / "b.bin", b"")
    assert elsewhere.exists(), "nobody here knows whether that process is alive"
    os.utime(elsewhere, (0, 0))
    artifacts._remove_stale.cache_clear()  # as in another process
    artifacts.write_bytes(tmp_path / "b.bin", b"")
    assert names(tmp_path) == {"b.bin"}


def test_a_file_of_another_machine_that_is_renamed_at_the_same_time_is_no_error(tmp_path: Path) -> None:
    renamed = tmp_path / ".a.bin.0123abcd-7-0123abcd.tmp"
    renamed.touch()
    (entry,) = os.scandir(tmp_path)
    renamed.unlink()
    assert not artifacts._is_stale(entry)


def test_a_name_with_a_number_that_no_process_has_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / f".a.bin.{artifacts._machine()}-{10**30}-0123abcd.tmp").touch()
    artifacts.write_bytes(tmp_path / "b.bin", b"")
    assert len(names(tmp_path)) == 2


def test_machines_of_one_name_are_told_apart() -> None:
    boot = Path("/proc/sys/kernel/random/boot_id").read_text()
    namespace = str(Path("/proc/self/ns/pid").readlink())
    assert artifacts._machine() == artifacts.hash_json([platform.node(), namespace, boot])[:8]


def test_a_folder_is_scanned_once_by_a_process_however_many_files_it_writes(tmp_path: Path) -> None:
    artifacts._remove_stale.cache_clear()
    for i in range(5):
        artifacts.write_bytes(tmp_path / f"{i}.bin", b"")
    assert artifacts._remove_stale.cache_info()[:2] == (4, 1)


@pytest.mark.parametrize(
    ("umask", "file", "folder"), [(0o022, 0o644, 0o755), (0o002, 0o664, 0o775), (0o077, 0o600, 0o700)]
)
def test_files_and_folders_have_the_permissions_that_the_umask_leaves(
    tmp_path: Path, umask: int, file: int, folder: int
) -> None:
    before = os.umask(umask)
    try:
        artifacts.write_json(tmp_path / "deep/a.json", {})
        with artifacts.lock(tmp_path / "run"), artifacts.staged_folder(tmp_path / "run") as staging:
            (staging / "sub").mkdir()
    finally:
        os.umask(before)
    modes = {name: (tmp_path / name).stat().st_mode & 0o777 for name in names(tmp_path)}
    assert modes == {"deep": folder, "deep/a.json": file, "run": folder, "run/sub": folder}


def test_json_survives_the_way_to_disk_and_back(tmp_path: Path) -> None:
    value = {"a": [1, 2.5, None, True], "β": {"c": "d"}}
    artifacts.write_json(tmp_path / "a.json", value)
    assert artifacts.read_json(tmp_path / "a.json") == value


def test_json_that_cannot_be_written_leaves_the_old_file_alone(tmp_path: Path) -> None:
    artifacts.write_json(tmp_path / "a.json", {"a": 1})
    with pytest.raises(ValueError, match="not JSON compliant"):
        artifacts.write_json(tmp_path / "a.json", {"a": float("nan")})
    assert artifacts.read_json(tmp_path / "a.json") == {"a": 1}
    assert names(tmp_path) == {"a.json"}


def test_a_missing_json_file_asks_for_the_stage_before(tmp_path: Path) -> None:
    with pytest.raises(ZestError, match=r"meta.json does not exist; was the stage before this one run"):
        artifacts.read_json(tmp_path / "meta.json")


@pytest.mark.parametrize("content", [b'{"a": 1', b"\xff\xfe", b""])
def test_a_damaged_json_file_is_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "meta.json").write_bytes(content)
    with pytest.raises(ZestError, match=r"meta.json (cannot be read as JSON|is empty)"):
        artifacts.read_json(tmp_path / "meta.json")


# --- folders ----------------------------------------------------------------------------------------------------------


def test_a_staged_folder_appears_whole_and_at_once(tmp_path: Path) -> None:
    final = tmp_path / "deep/run"
    with artifacts.staged_folder(final) as staging:
        (staging / "sub").mkdir()
        (staging / "sub/a").write_text("a")
        assert not final.exists()
    assert names(tmp_path / "deep") == {"run", "run/sub", "run/sub/a"}


def test_a_failure_while_staging_leaves_nothing(tmp_path: Path) -> None:
    def build() -> None:
        with artifacts.staged_folder(tmp_path / "run") as staging:
            (staging / "a").write_text("a")
            raise RuntimeError("cut")

    with pytest.raises(RuntimeError, match="cut"):
        build()
    assert names(tmp_path) == set()


def test_what_a_killed_process_staged_is_no_part_of_the_next_try(tmp_path: Path) -> None:
    process = start(
        """
with artifacts.staged_folder(Path(sys.argv[1])) as staging:
    (staging / "stale").write_text("half")
    print("ready", flush=True)
    time.sleep(60)""",
        tmp_path / "run",
    )
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "run").exists()
    with artifacts.staged_folder(tmp_path / "run") as staging:
        (staging / "fresh").write_text("whole")
    assert names(tmp_path) == {"run", "run/fresh"}


def test_a_folder_that_is_there_already_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run/old").write_text("old")
    with (
        pytest.raises(ZestError, match=r"cannot write .*run: .*not empty; nothing was left behind"),
        artifacts.staged_folder(tmp_path / "run") as staging,
    ):
        (staging / "new").write_text("new")
    assert names(tmp_path) == {"run", "run/old"}


# --- locks ------------------------------------------------------------------------------------------------------------

HOLD = """
with artifacts.lock(Path(sys.argv[1])):
    print("ready", flush=True)
    time.sleep(float(sys.argv[2]))
    Path(sys.argv[1]).write_text("done")"""


def test_a_lock_makes_the_second_process_wait_for_the_first(tmp_path: Path) -> None:
    target = tmp_path / "run"
    process = start(HOLD, target, 0.7)
    assert not target.exists()
    with artifacts.lock(target):
        assert target.read_text() == "done"
    assert process.wait() == 0


def test_a_killed_process_frees_its_lock(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    process = start(HOLD, tmp_path / "run", 600)
    process.send_signal(signal.SIGKILL)
    process.wait()
    with artifacts.lock(tmp_path / "run"):
        assert capfd.readouterr().err == "", "nobody waited"


WAIT = """
print("ready", flush=True)
with artifacts.lock(Path(sys.argv[1])): print("held", flush=True)"""


def test_who_waits_for_a_lock_says_so_names_the_file_and_can_be_interrupted(tmp_path: Path) -> None:
    target = tmp_path / "run"
    with artifacts.lock(target):
        process = start(WAIT, target)
        assert process.stderr is not None
        said = process.stderr.readline()
        assert f"waiting for {tmp_path}/.run.lock, which another command holds until {target} is written\n" in said
        process.send_signal(signal.SIGINT)
        out, err = process.communicate()
    assert out == ""
    assert err.endswith("KeyboardInterrupt\n")


WITHOUT_LOCKS = """
import errno, fcntl
def flock(handle, operation): raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))
fcntl.flock = flock
"""


def test_a_file_system_without_locks_is_called_that(tmp_path: Path) -> None:
    code = f"{WITHOUT_LOCKS}print('ready', flush=True)\nwith artifacts.lock(Path(sys.argv[1])): pass"
    _, err = start(code, tmp_path / "run").communicate()
    assert f"the file system of {tmp_path} has no file locks (No locks available), without which two commands" in err
    assert "could write run at once; choose a folder on another file system, or mount this one with locks" in err


def test_locks_of_different_artifacts_do_not_meet(tmp_path: Path) -> None:
    with artifacts.lock(tmp_path / "a"), artifacts.lock(tmp_path / "b"):
        assert names(tmp_path) == {".a.lock", ".b.lock"}
    assert names(tmp_path) == set()


def test_of_nested_locks_the_outermost_deletes_the_file(tmp_path: Path) -> None:
    with artifacts.lock(tmp_path / "a"):
        with artifacts.lock(tmp_path / "a"):
            pass
        assert names(tmp_path) == {".a.lock"}
    assert names(tmp_path) == set()


COUNT = """
print("ready", flush=True)
for _ in range(30):
    with artifacts.lock(Path(sys.argv[1])):
        n = int(Path(sys.argv[1]).read_text())
        Path(sys.argv[1]).write_text(str(n + 1))"""


def test_processes_that_take_turns_never_hold_a_lock_at_once_though_each_deletes_its_file(tmp_path: Path) -> None:
    target = tmp_path / "count"
    target.write_text("0")
    processes = [start(COUNT, target) for _ in range(2)]
    assert [process.wait() for process in processes] == [0, 0]
    assert target.read_text() == "60"
    assert names(tmp_path) == {"count"}


# --- places that cannot be written to ---------------------------------------------------------------------------------


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_a_place_below_a_regular_file_is_refused(tmp_path: Path, write: Any) -> None:
    (tmp_path / "file").write_text("text")
    with pytest.raises(ZestError, match=r"cannot write .*/file/a.*; choose a folder that can be written to"):
        write(tmp_path / "file")
    assert names(tmp_path) == {"file"}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_a_read_only_place_is_refused(disk: Disk, write: Any) -> None:
    disk.make_read_only()
    with pytest.raises(ZestError, match=r"cannot write .*Read-only file system; choose a folder that can be written"):
        write(disk.path)
    assert names(disk.path) == set()


@pytest.mark.parametrize("variable", artifacts.FOLDERS)
def test_the_variable_that_chooses_a_read_only_place_is_named(
    disk: Disk, variable: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(variable, str(disk.path))
    disk.make_read_only()
    for write in WRITERS.values():
        with pytest.raises(ZestError, match=rf"Read-only file system; set {variable} to a folder that can be written"):
            write(disk.path / "below")


def test_a_full_disk_leaves_the_old_file_and_no_half_of_the_new_one(disk: Disk) -> None:
    artifacts.write_bytes(disk.path / "a.bin", b"old")
    disk.fill(free=500_000)
    with pytest.raises(ZestError, match=r"cannot write .*a\.bin: No space left on device"):
        artifacts.write_bytes(disk.path / "a.bin", bytes(1_000_000))
    assert (disk.path / "a.bin").read_bytes() == b"old"
    assert names(disk.path) == {"a.bin", "ballast"}


def test_a_disk_that_fills_up_while_staging_leaves_no_folder(disk: Disk) -> None:
    with (
        pytest.raises(ZestError, match=r"cannot write .*run: No space left on device; nothing was left behind"),
        artifacts.staged_folder(disk.path / "run") as staging,
    ):
        (staging / "a").write_bytes(bytes(20_000_000))
    assert names(disk.path) == set()


def test_free_space_is_checked_with_head_room_before_anything_is_written(disk: Disk) -> None:
    with pytest.raises(ZestError, match=r"not enough disk space at .*disk: 65 MB needed, 8 MB free; free some or"):
        artifacts.check_free_space(disk.path / "not/yet/there", 2**20)
    assert names(disk.path) == set()


def test_free_space_that_suffices_is_no_error(tmp_path: Path) -> None:
    artifacts.check_free_space(tmp_path, 1)
    with pytest.raises(ZestError, match="not enough disk space"):
        artifacts.check_free_space(tmp_path, 10**18)


# --- where things are, and where they came from -----------------------------------------------------------------------


def test_the_cache_is_where_the_environment_says_and_is_not_made_by_asking(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "cache"))
    assert artifacts.cache_dir() == tmp_path / "cache"
    monkeypatch.setenv("ZEST_CACHE", "")
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    assert artifacts.cache_dir() == tmp_path / ".cache/zest_rl"
    assert names(tmp_path) == set()


def test_an_account_without_a_home_folder_is_told_which_variables_to_set(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    for variable in artifacts.FOLDERS:
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(Path, "home", no_home)
    with pytest.raises(ZestError, match="no home folder; set HOME, or each of MINARI_DATASETS_PATH and ZEST_CACHE, to"):
        artifacts.cache_dir()


def test_provenance_names_versions_and_command_and_is_json(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["/home/me/venv/bin/zest", "collect", "--task", "micro", "--noise-max", "0.5"])
    facts = json.loads(json.dumps(artifacts.provenance()))
    assert facts["command"] == "zest collect --task micro --noise-max 0.5"
    assert {"zest-rl", "numpy", "minari", "mujoco", "torch"} <= facts["versions"].keys()
    assert facts["versions"]["numpy"] == np.__version__
    assert facts["python"] == ".".join(map(str, sys.version_info[:3]))


@pytest.mark.parametrize(
    ("word", "kept"),
    [
        ("/home/me/goals", "…/goals"),
        ("--goal=/home/me/my goals/door", "--goal=…/door"),
        ("/goals", "…/goals"),
        ("moco:/home/me/weights.pth", "moco:…/weights.pth"),
        ("open_clip:ViT-B-32@/home/me/weights.pth", "open_clip:ViT-B-32@…/weights.pth"),
        ("zest/kitchen-micro-noisy-v0", "zest/kitchen-micro-noisy-v0"),
        ("eval/demo.toml", "eval/demo.toml"),
        ("~/goals", "~/goals"),
        ("text:closed microwave -> open microwave", "text:closed microwave -> open microwave"),
        ("https://example.org/a/b", "https://example.org/a/b"),
    ],
)
def test_provenance_holds_no_path_of_this_machine(monkeypatch: pytest.MonkeyPatch, word: str, kept: str) -> None:
    monkeypatch.setattr(sys, "argv", ["/home/me/venv/bin/zest", "relabel", word])
    assert artifacts.provenance()["command"] == f"zest relabel {kept}"
    assert "/home/me" not in json.dumps(artifacts.provenance())


def test_the_git_revision_is_that_of_the_source_tree_or_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "zest_rl/runtime/artifacts.py"
    monkeypatch.setattr(artifacts, "__file__", str(package))
    assert artifacts.git_revision() is None
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b.c", "-C", str(tmp_path)]
    subprocess.run([*git, "init", "-q"], check=True)
    package.parent.mkdir(parents=True)
    package.write_text("1")
    subprocess.run([*git, "add", "."], check=True)
    subprocess.run([*git, "commit", "-qm", "first"], check=True)
    clean = artifacts.git_revision()
    assert clean is not None
    assert re.fullmatch("[0-9a-f]{12}", clean)
    package.write_text("2")
    assert artifacts.git_revision() == f"{clean}-dirty"


@pytest.mark.parametrize("kind", ["datasets", "train", "eval"])
def test_recipes_come_with_the_package(kind: str) -> None:
    assert list(artifacts.shipped(kind).glob("**/*.toml"))
