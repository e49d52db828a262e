from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from zest_rl.errors import BadInput, ZestError
from zest_rl.runtime import artifacts
from zest_rl.runtime.parallel import (
    Arrays,
    chunks,
    concatenate,
    map_jobs,
    n_cores,
    one_thread,
    read_arrays,
    write_arrays,
)

if TYPE_CHECKING:
    from conftest import Disk

# --- work that is sent to other processes -----------------------------------------------------------------------------


def draw(seed: int) -> Arrays:
    values = np.random.default_rng(seed).normal(size=(60, 60)).astype(np.float32)
    return {"values": values, "product": values @ values, "process": np.array([os.getpid()])}


def read_n_threads(folder: Path) -> Arrays:
    """Return the thread settings of this process; two such jobs are done by two processes."""
    import torch

    variables = [int(os.environ[name]) for name in ("MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS") if name in os.environ]
    return {"threads": np.array([torch.get_num_threads(), *variables]), **wait_for_two(folder)}


def refuse(seed: int) -> Arrays:
    raise BadInput(f"seed {seed} is refused")


def be_killed_elsewhere(parent: int) -> Arrays:
    """Return at once in the process `parent`; die in any other as the out-of-memory killer does it."""
    if os.getpid() != parent:
        os.kill(os.getpid(), signal.SIGKILL)
    return {"values": np.ones(3)}


def wait_for_two(folder: Path) -> Arrays:
    """Return when two processes have come here."""
    (folder / str(os.getpid())).touch()
    while len(list(folder.iterdir())) < 2:
        time.sleep(0.02)
    return {"process": np.array([os.getpid()])}


def beat(heart: Path) -> Arrays:
    """Append to a file for a minute."""
    for _ in range(1200):
        with heart.open("a") as file:
            file.write(".")
        time.sleep(0.05)
    return {"values": np.ones(1)}


class Shared:
    """Large, or so we say."""

    n_sent = 0

    def __reduce__(self) -> tuple[type[Shared], tuple[()]]:
        Shared.n_sent += 1
        return Shared, ()


def draw_once_all_others_are_drawn(shared: Shared, parent: int, folder: Path, seed: int) -> Arrays:
    """In the process `parent` wait until but one part is there; draw at once in any other."""
    deadline = time.monotonic() + 60
    while os.getpid() == parent and len(list(folder.glob("*.npz"))) < len(SEEDS) - 1 and time.monotonic() < deadline:
        time.sleep(0.02)
    return draw(seed)


def counted(calls: list[int]) -> Callable[[int], Arrays]:
    def work(seed: int) -> Arrays:
        calls.append(seed)
        return draw(seed)

    return work


def numbers(folder: Path) -> dict[str, bytes]:
    parts = {path.stem: read_arrays(path) for path in sorted(folder.glob("*.npz"))}
    return {name: part["values"].tobytes() + part["product"].tobytes() for name, part in parts.items() if part}


def processes(folder: Path) -> set[int]:
    return {int(part["process"][0]) for path in folder.glob("*.npz") if (part := read_arrays(path))}


SEEDS: Mapping[str, int] = {f"part-{seed}": seed for seed in range(4)}

# --- files ------------------------------------------------------------------------------------------------------------


def test_arrays_survive_the_way_to_disk_and_back(tmp_path: Path) -> None:
    arrays: dict[str, Any] = {"a": np.arange(6, dtype=np.uint8).reshape(2, 3), "b": np.array([True]), "c": np.zeros(0)}
    write_arrays(tmp_path / "deep/part.npz", arrays)
    got = read_arrays(tmp_path / "deep/part.npz")
    assert got is not None
    assert got.keys() == arrays.keys()
    for name, array in arrays.items():
        assert got[name].dtype == array.dtype
        np.testing.assert_array_equal(got[name], array)


def test_a_missing_file_reads_as_none(tmp_path: Path) -> None:
    assert read_arrays(tmp_path / "part.npz") is None


def test_no_damage_of_one_byte_makes_other_numbers_or_a_crash(tmp_path: Path) -> None:
    path = tmp_path / "part.npz"
    values = np.arange(4, dtype=np.float32)
    write_arrays(path, {"values": values})
    whole = path.read_bytes()
    n_damaged = 0
    for position in range(len(whole)):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 0x01]) + whole[position + 1 :])
        got = read_arrays(path)
        n_damaged += got is None
        assert not got or got["values"].tobytes() == values.tobytes()
        path.write_bytes(whole[:position])
        assert read_arrays(path) is None
    assert n_damaged > len(whole) / 2


def test_a_pickle_in_an_npz_file_is_never_opened(tmp_path: Path) -> None:
    np.savez(tmp_path / "part.npz", values=np.array([{"a": 1}], dtype=object))
    assert read_arrays(tmp_path / "part.npz") is None


def test_a_full_disk_leaves_the_old_part_and_no_half_of_the_new_one(
    disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = disk.path / "part.npz"
    with pytest.raises(ZestError, match="not enough disk space"):
        write_arrays(path, {"values": np.ones(3)})
    monkeypatch.setattr(artifacts, "check_free_space", lambda folder, n_bytes: None)
    write_arrays(path, {"values": np.ones(3)})
    with pytest.raises(ZestError, match="No space left on device"):
        write_arrays(path, {"values": np.ones(2_000_000)})
    np.testing.assert_array_equal((read_arrays(path) or {})["values"], np.ones(3))
    assert [p.name for p in disk.path.iterdir()] == ["part.npz"]


# --- jobs in this process ---------------------------------------------------------------------------------------------


def test_finished_parts_are_not_done_again_and_are_still_reported(tmp_path: Path) -> None:
    calls: list[int] = []
    done: list[str] = []
    map_jobs(counted(calls), {"part-0": 0, "part-1": 1}, tmp_path, n_workers=1, on_done=done.append)
    map_jobs(counted(calls), SEEDS, tmp_path, n_workers=1, on_done=done.append)
    assert calls == [0, 1, 2, 3]
    assert done == ["part-0", "part-1", *SEEDS]


def test_a_damaged_part_is_done_again(tmp_path: Path) -> None:
    calls: list[int] = []
    map_jobs(counted(calls), SEEDS, tmp_path, n_workers=1)
    before = numbers(tmp_path)
    damaged = tmp_path / "part-2.npz"
    damaged.write_bytes(damaged.read_bytes()[:-100])
    map_jobs(counted(calls), SEEDS, tmp_path, n_workers=1)
    assert calls == [0, 1, 2, 3, 2]
    assert numbers(tmp_path) == before


def test_a_failing_job_keeps_the_parts_before_it(tmp_path: Path) -> None:
    def work(seed: int) -> Arrays:
        return refuse(seed) if seed == 2 else draw(seed)

    with pytest.raises(BadInput, match="seed 2 is refused"):
        map_jobs(work, SEEDS, tmp_path, n_workers=1)
    assert numbers(tmp_path).keys() == {"part-0", "part-1"}


# --- jobs in other processes ------------------------------------------------------------------------------------------


def test_two_processes_leave_the_same_numbers_as_one(tmp_path: Path) -> None:
    done: list[str] = []
    map_jobs(draw, SEEDS, tmp_path / "one", n_workers=1)
    map_jobs(draw, SEEDS, tmp_path / "two", n_workers=2, on_done=done.append)
    assert numbers(tmp_path / "two") == numbers(tmp_path / "one")
    assert numbers(tmp_path / "one").keys() == SEEDS.keys()
    assert processes(tmp_path / "one") == {os.getpid()}
    assert sorted(done) == sorted(SEEDS)


def test_what_the_jobs_share_is_sent_to_a_worker_once_and_not_with_each_job(tmp_path: Path) -> None:
    Shared.n_sent = 0
    work = partial(draw_once_all_others_are_drawn, Shared(), os.getpid(), tmp_path / "two")
    map_jobs(work, SEEDS, tmp_path / "two", n_workers=2)
    assert Shared.n_sent == 1
    map_jobs(draw, SEEDS, tmp_path / "one", n_workers=1)
    assert numbers(tmp_path / "two") == numbers(tmp_path / "one")


def test_workers_use_one_thread_each_and_this_process_keeps_its_setting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    (tmp_path / "present").mkdir()
    map_jobs(read_n_threads, dict.fromkeys("ab", tmp_path / "present"), tmp_path, n_workers=2)
    parts = [read_arrays(path) or {} for path in tmp_path.glob("*.npz")]
    (worker,) = (part for part in parts if part["process"] != os.getpid())
    assert list(worker["threads"]) == [1, 1, 1]
    assert os.environ["OMP_NUM_THREADS"] == "2"
    assert "MKL_NUM_THREADS" not in os.environ


def test_this_process_is_one_of_the_workers(tmp_path: Path) -> None:
    (tmp_path / "present").mkdir()
    map_jobs(wait_for_two, dict.fromkeys("ab", tmp_path / "present"), tmp_path, n_workers=2)
    assert os.getpid() in processes(tmp_path)
    assert len(processes(tmp_path)) == 2


def test_a_script_needs_no_main_guard(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "import sys; from pathlib import Path; from zest_rl.runtime.parallel import map_jobs\n"
        "from test_parallel import draw\n"
        "print('begun')\n"
        "map_jobs(draw, {str(i): i for i in range(4)}, Path(sys.argv[1]), n_workers=2)\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    command = [sys.executable, str(script), str(tmp_path)]
    assert subprocess.run(command, env=environment, timeout=60, capture_output=True, text=True).stdout == "begun\n"
    assert len(list(tmp_path.glob("*.npz"))) == 4


def test_a_killed_worker_is_a_clear_error_and_finished_parts_are_kept(tmp_path: Path) -> None:
    jobs = dict.fromkeys("abcd", os.getpid())
    with pytest.raises(ZestError, match=r"a worker process died .*finished parts are kept, run the same command again"):
        map_jobs(be_killed_elsewhere, jobs, tmp_path, n_workers=2)
    finished = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert 1 <= len(finished) <= 3
    map_jobs(be_killed_elsewhere, jobs, tmp_path, n_workers=1)
    assert {path: path.stat().st_mtime_ns for path in finished} == finished
    assert len(list(tmp_path.iterdir())) == 4


def test_an_error_of_a_worker_arrives_as_what_it_is(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"seed \d is refused"):
        map_jobs(refuse, SEEDS, tmp_path, n_workers=2)


def test_work_that_cannot_be_sent_is_an_error_and_no_wait(tmp_path: Path) -> None:
    with pytest.raises(Exception, match=r"(?i)pickle|local object"):
        map_jobs(counted([]), SEEDS, tmp_path, n_workers=3)


def test_workers_end_with_a_killed_command(tmp_path: Path) -> None:
    hearts = [tmp_path / "heart-0", tmp_path / "heart-1"]
    code = (
        "import sys; from pathlib import Path; from zest_rl.runtime.parallel import map_jobs\n"
        "from test_parallel import beat\n"
        "folder = Path(sys.argv[1])\n"
        "map_jobs(beat, {str(i): folder / f'heart-{i}' for i in range(2)}, folder, n_workers=2)"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    command = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], env=environment)
    deadline = time.monotonic() + 60
    while not all(heart.exists() for heart in hearts) and time.monotonic() < deadline:
        time.sleep(0.05)
    command.send_signal(signal.SIGKILL)
    command.wait()
    time.sleep(0.5)
    beats = [heart.stat().st_size for heart in hearts]
    time.sleep(0.5)
    assert [heart.stat().st_size for heart in hearts] == beats


# --- small pieces -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "size"), [(0, 3), (1, 3), (3, 3), (7, 3), (5, 100)])
def test_chunks_cover_everything_once_and_in_order(n: int, size: int) -> None:
    parts = chunks(n, size)
    assert [i for part in parts for i in part] == list(range(n))
    assert all(0 < len(part) <= size for part in parts)


def test_parts_are_joined_along_the_first_axis() -> None:
    joined = concatenate([{"a": np.ones((2, 3)), "b": np.zeros(2)}, {"a": np.zeros((1, 3)), "b": np.ones(1)}])
    assert joined["a"].shape == (3, 3)
    np.testing.assert_array_equal(joined["b"], [0, 0, 1])


def test_torch_runs_on_one_thread_within_the_context_and_as_before_after_a_failure() -> None:
    import torch

    def fail() -> None:
        with one_thread():
            assert torch.get_num_threads() == 1
            raise RuntimeError("cut")

    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with pytest.raises(RuntimeError, match="cut"):
            fail()
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_there_is_at_least_one_core() -> None:
    assert 1 <= n_cores() <= (os.cpu_count() or 1)
