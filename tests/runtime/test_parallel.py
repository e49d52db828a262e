from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from zest_rl.errors import BadInput, ZestError
from zest_rl.runtime.arrays import Arrays, read_arrays
from zest_rl.runtime.parallel import (
    MAX_ACTORS,
    WORKERS_PER_CORE,
    Engine,
    cached_jobs,
    chunks,
    n_cores,
    one_thread,
    prepare_child,
    run_jobs,
    starting_children,
)

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


def be_killed_after_the_first(parent: int, folder: Path, seed: int) -> Arrays:
    """Die as the out-of-memory killer does it when a part is there, but not in the process `parent`."""
    if os.getpid() != parent and list(folder.glob("*.npz")):
        os.kill(os.getpid(), signal.SIGKILL)
    return draw(seed)


def be_ended_by(number: int, seed: int) -> None:
    os.kill(os.getpid(), number)


def wait_to_be_ended() -> None:
    prepare_child()
    time.sleep(600)


def wait_for_two(folder: Path) -> Arrays:
    """Return when two processes have come here."""
    (folder / str(os.getpid())).touch()
    while len(list(folder.iterdir())) < 2:
        time.sleep(0.02)
    return {"process": np.array([os.getpid()])}


def beat(heart: Path) -> Arrays:
    """Append to a file for a minute."""
    for _ in range(1200):
        with heart.open("a", encoding="utf-8") as file:
            file.write(".")
        time.sleep(0.05)
    return {"values": np.ones(1)}


class Shared:
    """Large, or so we say."""

    n_sent = 0

    def __reduce__(self) -> tuple[type[Shared], tuple[()]]:
        Shared.n_sent += 1
        return Shared, ()


def draw_with(shared: Shared, seed: int) -> Arrays:
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

# --- jobs in this process ---------------------------------------------------------------------------------------------


def test_finished_parts_are_not_done_again_and_are_still_reported(tmp_path: Path) -> None:
    calls: list[int] = []
    assert list(cached_jobs(counted(calls), {"part-0": 0, "part-1": 1}, tmp_path, n_workers=1)) == ["part-0", "part-1"]
    assert list(cached_jobs(counted(calls), SEEDS, tmp_path, n_workers=1)) == list(SEEDS)
    assert calls == [0, 1, 2, 3]


def test_a_damaged_part_is_done_again(tmp_path: Path) -> None:
    calls: list[int] = []
    list(cached_jobs(counted(calls), SEEDS, tmp_path, n_workers=1))
    before = numbers(tmp_path)
    damaged = tmp_path / "part-2.npz"
    damaged.write_bytes(damaged.read_bytes()[:-100])
    list(cached_jobs(counted(calls), SEEDS, tmp_path, n_workers=1))
    assert calls == [0, 1, 2, 3, 2]
    assert numbers(tmp_path) == before


def test_a_failing_job_keeps_the_parts_before_it(tmp_path: Path) -> None:
    def work(seed: int) -> Arrays:
        return refuse(seed) if seed == 2 else draw(seed)

    with pytest.raises(BadInput, match="seed 2 is refused"):
        list(cached_jobs(work, SEEDS, tmp_path, n_workers=1))
    assert numbers(tmp_path).keys() == {"part-0", "part-1"}


# --- jobs in other processes ------------------------------------------------------------------------------------------


def test_two_processes_leave_the_same_numbers_as_one(tmp_path: Path) -> None:
    assert list(cached_jobs(draw, SEEDS, tmp_path / "one", n_workers=1)) == list(SEEDS)
    assert sorted(cached_jobs(draw, SEEDS, tmp_path / "two", n_workers=2)) == sorted(SEEDS)
    assert numbers(tmp_path / "two") == numbers(tmp_path / "one")
    assert numbers(tmp_path / "one").keys() == SEEDS.keys()
    assert processes(tmp_path / "one") == {os.getpid()}, "one worker is this process"
    assert os.getpid() not in processes(tmp_path / "two")


@pytest.mark.parametrize("n_workers", [1, 2])
def test_jobs_without_a_cache_yield_their_results_by_name_and_leave_no_file(
    n_workers: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    results = dict(run_jobs(draw, SEEDS, n_workers=n_workers))
    assert results.keys() == SEEDS.keys()
    for name, seed in SEEDS.items():
        np.testing.assert_array_equal(results[name]["product"], draw(seed)["product"])
    assert not list(tmp_path.iterdir())


def test_what_the_jobs_share_is_sent_to_each_worker_once_and_not_with_each_job(tmp_path: Path) -> None:
    Shared.n_sent = 0
    list(cached_jobs(partial(draw_with, Shared()), SEEDS, tmp_path / "two", n_workers=2))
    assert Shared.n_sent == 2
    list(cached_jobs(draw, SEEDS, tmp_path / "one", n_workers=1))
    assert numbers(tmp_path / "two") == numbers(tmp_path / "one")


def test_workers_use_one_thread_each_and_this_process_keeps_its_setting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    (tmp_path / "present").mkdir()
    list(cached_jobs(read_n_threads, dict.fromkeys("ab", tmp_path / "present"), tmp_path, n_workers=2))
    parts = [read_arrays(path) or {} for path in tmp_path.glob("*.npz")]
    assert [list(part["threads"]) for part in parts] == [[1, 1, 1], [1, 1, 1]]
    assert os.environ["OMP_NUM_THREADS"] == "2"
    assert "MKL_NUM_THREADS" not in os.environ


def test_a_script_needs_no_main_guard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "import sys; from pathlib import Path; from zest_rl.runtime.parallel import cached_jobs\n"
        "from test_parallel import draw\n"
        "print('begun')\n"
        "list(cached_jobs(draw, {str(i): i for i in range(4)}, Path(sys.argv[1]), n_workers=2))\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
    command = [sys.executable, str(script), str(tmp_path)]
    assert subprocess.run(command, timeout=60, capture_output=True, text=True).stdout == "begun\n"
    assert len(list(tmp_path.glob("*.npz"))) == 4


def test_a_killed_worker_is_a_clear_error_and_finished_parts_are_kept(tmp_path: Path) -> None:
    work = partial(be_killed_after_the_first, os.getpid(), tmp_path)
    with pytest.raises(ZestError, match=r"a worker process died .*finished parts are kept, run the same command again"):
        list(cached_jobs(work, SEEDS, tmp_path, n_workers=2))
    finished = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")}
    assert 1 <= len(finished) <= 3
    list(cached_jobs(work, SEEDS, tmp_path, n_workers=1))
    assert {path: path.stat().st_mtime_ns for path in finished} == finished
    assert len(list(tmp_path.glob("*.npz"))) == 4


@pytest.mark.parametrize(
    ("number", "cause"),
    [
        (signal.SIGSEGV, "SIGSEGV: a native library crashed"),
        (signal.SIGKILL, "SIGKILL: killed, or out of memory"),
        (signal.SIGTERM, "SIGTERM: killed, or out of memory"),
        (signal.SIGRTMIN + 1, rf"signal {signal.SIGRTMIN + 1}: killed"),
    ],
)
def test_the_message_of_a_dead_worker_names_stage_and_signal(number: int, cause: str) -> None:
    with pytest.raises(ZestError, match=rf"a worker process died in drawing before .* \({cause}"):
        list(run_jobs(partial(be_ended_by, number), SEEDS, n_workers=2, stage="drawing"))


@pytest.mark.parametrize("n_workers", [0, -1, 100_000, 10**14])
@pytest.mark.parametrize("engine", ["local", "ray"])
def test_more_workers_than_any_machine_has_are_refused_before_one_is_started(n_workers: int, engine: Engine) -> None:
    jobs = {str(seed): seed for seed in range(max(MAX_ACTORS, WORKERS_PER_CORE * n_cores()) + 1)}
    with pytest.raises(BadInput, match=rf"workers must be between 1 and \d+ here, got {n_workers}; leave it out"):
        list(run_jobs(draw, jobs, n_workers=n_workers, engine=engine))


def test_more_workers_than_the_cores_could_bear_are_as_many_as_there_are_jobs() -> None:
    assert [name for name, _ in run_jobs(draw, {"part-0": 0}, n_workers=100_000)] == ["part-0"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_waits_until_the_child_that_is_being_started_is_known(number: signal.Signals) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before, child = (
        signal.signal(number, interrupt),
        multiprocessing.get_context("spawn").Process(target=wait_to_be_ended),
    )
    try:
        with pytest.raises(KeyboardInterrupt), starting_children():  # noqa: PT012
            os.kill(os.getpid(), number)
            child.start()
    finally:
        signal.signal(number, before)
    assert child.pid is not None
    child.terminate()
    child.join()
    assert child.exitcode == -signal.SIGTERM, "which was not held off in the child"


def test_an_error_of_a_worker_arrives_as_what_it_is(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"seed \d is refused"):
        list(cached_jobs(refuse, SEEDS, tmp_path, n_workers=2))


def test_work_that_cannot_be_sent_is_an_error_and_no_wait(tmp_path: Path) -> None:
    with pytest.raises(Exception, match=r"(?i)pickle|local object"):
        list(cached_jobs(counted([]), SEEDS, tmp_path, n_workers=3))


@pytest.mark.parametrize("end", [os.kill, os.killpg], ids=["killed", "interrupted"])
def test_workers_end_with_a_command_that_is_killed_or_interrupted(
    end: Callable[[int, signal.Signals], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hearts = [tmp_path / "heart-0", tmp_path / "heart-1"]
    code = (
        "import sys; from pathlib import Path; from zest_rl.runtime.parallel import cached_jobs\n"
        "from test_parallel import beat\n"
        "folder = Path(sys.argv[1])\n"
        "list(cached_jobs(beat, {str(i): folder / f'heart-{i}' for i in range(5)}, folder, n_workers=2))"
    )
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
    command = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], start_new_session=True)
    deadline = time.monotonic() + 60
    while not all(heart.exists() for heart in hearts) and time.monotonic() < deadline:
        time.sleep(0.05)
    end(command.pid, signal.SIGKILL if end is os.kill else signal.SIGINT)  # Ctrl-C is a signal to all processes
    command.wait(timeout=20)
    time.sleep(0.5)
    beats = [heart.stat().st_size for heart in hearts]
    time.sleep(0.5)
    assert [heart.stat().st_size for heart in hearts] == beats
    assert set(tmp_path.iterdir()) == set(hearts), "no other job was begun"


# --- small pieces -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "size"), [(0, 3), (1, 3), (3, 3), (7, 3), (5, 100)])
def test_chunks_cover_everything_once_and_in_order(n: int, size: int) -> None:
    parts = chunks(n, size)
    assert [i for part in parts for i in part] == list(range(n))
    assert all(0 < len(part) <= size for part in parts)


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
