"""Work in chunks: one process per core, one file per finished chunk, so that a cut run goes on where it stopped."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import sys
import threading
import zipfile
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from types import ModuleType
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from zest_rl.errors import BadInput, ZestError, nearest
from zest_rl.runtime import artifacts, ray_engine
from zest_rl.runtime.ray_engine import Arrays, Job

Engine = Literal["local", "ray"]
_STARTING = threading.Lock()
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def n_cores() -> int:
    """Return the number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def die_with_parent() -> None:
    """End this child process as soon as its parent is gone, be it killed: nobody else would end it."""
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def starting_children() -> Iterator[None]:
    """Let processes that are started within the context use one core each, and not run the caller's script again.

    With one core their results do not depend on the number of workers, and none waits for another; set here and not in
    the child, as the libraries read it when they are loaded. A spawned process would import ``__main__``, which hangs
    when a script does its work there without ``if __name__ == "__main__"``; what we send it needs no such import.
    """
    with _STARTING:
        main, before = sys.modules["__main__"], {name: os.environ.get(name) for name in THREAD_VARIABLES}
        os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = main
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch on one thread within the context: its results depend on the number of threads in the last digits."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


DAMAGED = (OSError, ValueError, EOFError, RuntimeError, zipfile.BadZipFile)
"""What reading a damaged ``.npz`` file may raise; RuntimeError: damaged zip flags."""


def read_arrays(path: Path) -> dict[str, NDArray[Any]] | None:
    """Read an ``.npz`` file whole, or return None when it is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except DAMAGED:
        return None


def read_array(path: Path, name: str) -> NDArray[Any] | None:
    """Read one array of an ``.npz`` file, or return None when it is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return np.asarray(file[name])
    except (*DAMAGED, KeyError):
        return None


def write_arrays(path: Path, arrays: Arrays) -> None:
    """Write an ``.npz`` file atomically."""
    artifacts.check_free_space(path.parent, sum(array.nbytes for array in arrays.values()))
    with artifacts.atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **dict(arrays))


def counted(
    on_progress: Callable[[int, int], None] | None, total: int, n_done: int = 0
) -> Callable[[str], None] | None:
    """Return what `map_jobs` may call after each job, to tell `on_progress` of (jobs done, jobs in all)."""
    if on_progress is None:
        return None
    numbers = itertools.count(n_done + 1)
    return lambda _: on_progress(next(numbers), total)


_WORK: list[Callable[[Any], Arrays]] = []
"""Of this worker process."""


def _start_worker(work: Callable[[Any], Arrays]) -> None:
    die_with_parent()
    _WORK.append(work)


def _run_job(job: Any, path: Path) -> None:
    """Do a job in a worker process."""
    write_arrays(path, _WORK[0](job))


def map_jobs(
    work: Callable[[Job], Arrays],
    jobs: Mapping[str, Job],
    folder: Path,
    *,
    n_workers: int | None = None,
    engine: Engine = "local",
    device: str = "cpu",
    on_done: Callable[[str], None] | None = None,
) -> None:
    """Leave the arrays of ``work(job)`` in ``folder/NAME.npz`` for every job; what is there already is not done again.

    Args:
        work: a module-level function, or a partial of one with what all jobs share (it is sent to each worker process
            once); it must depend on nothing but that and its job.
        jobs: name → job. The name must identify the job's content.
        folder: where results are left.
        n_workers: number of processes, default one per core; this process is one of them.
        engine: processes of this machine, or workers of a Ray cluster (`zest_rl.runtime.ray_engine`).
        device: what the work runs on; Ray gives its workers GPUs by it.
        on_done: called with the name of each job when its file is there, also for those found finished.

    Raises:
        BadInput: `n_workers` is below 1, or there is no such engine.
        ZestError: a worker process died (out of memory, killed). What was finished is kept.
    """
    if n_workers is not None and n_workers < 1:
        raise BadInput(f"the number of workers must be at least 1, got {n_workers}; leave it out for one per core")
    if engine not in get_args(Engine):
        raise BadInput(f"unknown engine {engine!r}; {nearest(engine, get_args(Engine))}")
    missing = []
    for name in jobs:
        if read_arrays(folder / f"{name}.npz") is None:
            missing.append(name)
        elif on_done is not None:
            on_done(name)
    run = _run_on_ray if engine == "ray" else _run_here
    with closing(run(work, {name: jobs[name] for name in missing}, folder, n_workers, device)) as done:
        for name in done:
            if on_done is not None:
                on_done(name)


def _run_on_ray(
    work: Callable[[Job], Arrays], jobs: Mapping[str, Job], folder: Path, n_workers: int | None, device: str
) -> Generator[str, None, None]:
    with closing(ray_engine.run_jobs(work, jobs, n_workers=n_workers, device=device)) as results:
        for name, arrays in results:
            write_arrays(folder / f"{name}.npz", arrays)
            yield name


def _run_here(
    work: Callable[[Job], Arrays], jobs: Mapping[str, Job], folder: Path, n_workers: int | None, device: str
) -> Generator[str, None, None]:
    """Do all jobs in this process and ``n_workers - 1`` others; the work chooses its device itself."""
    n_workers = min(n_workers or n_cores(), len(jobs))
    paths = {name: folder / f"{name}.npz" for name in jobs}
    todo = deque(jobs)
    finished: SimpleQueue[tuple[str, BaseException | None]] = SimpleQueue()

    def take() -> str | None:
        """Return the next job that nobody has begun; other threads take from the same list."""
        try:
            return todo.popleft()
        except IndexError:
            return None

    def submit() -> None:
        """Give the next job to another process, and when it is done another one, and so on."""
        if (name := take()) is None:
            return
        try:
            pool.submit(_run_job, jobs[name], paths[name]).add_done_callback(partial(go_on, name))
        except BrokenProcessPool as error:
            finished.put((name, error))

    all_started = threading.Event()

    def go_on(name: str, future: Future[None]) -> None:
        if future.exception() is None:
            all_started.wait()  # a process that is started from here would be outside of `starting_children`
            submit()
        finished.put((name, future.exception()))

    context = multiprocessing.get_context("spawn")  # fork is unsafe beside torch's and the GL library's threads
    with ProcessPoolExecutor(
        max(n_workers - 1, 1), mp_context=context, initializer=_start_worker, initargs=(work,)
    ) as pool:
        with starting_children():  # submitting starts them
            for _ in range(n_workers - 1):
                submit()
        all_started.set()
        try:
            for _ in jobs:
                if finished.empty() and (own := take()) is not None:
                    write_arrays(paths[own], work(jobs[own]))
                    finished.put((own, None))
                name, error = finished.get()
                if error is not None:
                    raise error
                yield name
        except BrokenProcessPool as error:
            raise ZestError(
                f"a worker process died before all of {len(jobs)} parts were done (killed, or out of memory); "
                "finished parts are kept, run the same command again to go on"
            ) from error
        finally:
            todo.clear()


def chunks(n: int, size: int) -> list[range]:
    """Split ``range(n)`` into ranges of at most `size`."""
    return [range(start, min(start + size, n)) for start in range(0, n, size)]


def read_parts(folder: Path, names: Iterable[str]) -> dict[str, NDArray[Any]]:
    """Join what `map_jobs` left for these jobs along the first axis.

    Raises:
        ZestError: a part is missing or damaged.
    """
    parts = {name: read_arrays(folder / f"{name}.npz") for name in names}
    found = [part for part in parts.values() if part is not None]
    if len(found) < len(parts):
        gone = [name for name, part in parts.items() if part is None]
        raise ZestError(f"parts of {folder} are missing or damaged ({', '.join(gone)}); run the command again")
    return concatenate(found)


def concatenate(parts: Sequence[Arrays]) -> dict[str, NDArray[Any]]:
    """Join equally named arrays of several parts along the first axis."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
