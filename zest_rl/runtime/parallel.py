"""Parallel jobs: one process per core, and one file per finished job, so that an interrupted run resumes.

`run_jobs` yields the results of jobs; `cached_jobs` writes them to disk and skips finished jobs.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, get_args

from numpy.typing import NDArray

from zest_rl.errors import BadInput, ZestError, nearest
from zest_rl.runtime import ray_engine
from zest_rl.runtime.arrays import Arrays, Layout, concatenate, read_arrays, write_arrays
from zest_rl.runtime.ray_engine import Job, Result

Engine = Literal["local", "ray"]
"""Processes of this machine, or workers of a Ray cluster (`zest_rl.runtime.ray_engine`)."""
_STARTING = threading.Lock()
WORKERS_PER_CORE, MAX_ACTORS = 16, 4096
"""Most workers of this machine, and of a cluster; more can only exhaust memory and process table."""
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def n_cores() -> int:
    """Return the number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def cause_of_death(exit_code: int | None) -> str:
    """Say what ended a child process that had not finished: the signal, and what usually sends it."""
    if exit_code is None or exit_code >= 0:
        return f"exit code {exit_code}"
    name = next((each.name for each in signal.Signals if each == -exit_code), f"signal {-exit_code}")
    if exit_code in (-signal.SIGSEGV, -signal.SIGBUS, -signal.SIGABRT, -signal.SIGILL, -signal.SIGFPE):
        return f"{name}: a native library crashed, such as GL, HDF5 or CUDA, often for want of memory or disk"
    return f"{name}: killed, or out of memory"


_INTERRUPTIONS = {signal.SIGINT, signal.SIGTERM}


def prepare_child() -> None:
    """Let SIGTERM end this child process of `starting_children`, and its parent's end, which nothing else would."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def starting_children() -> Iterator[None]:
    """Let processes started within the context use one core each, ignore Ctrl-C, and not run the caller's script again.

    With one core their results do not depend on the number of workers; set here and not in the child, because the
    libraries read it when they are loaded. A spawned process would import ``__main__``, which hangs if a script does
    its work there without ``if __name__ == "__main__"``; our jobs do not need that import. Ctrl-C is a signal to all
    processes of a terminal; it is this one that ends its children. SIGTERM waits, too, so that no child is started of
    which this process does not know yet; it is `prepare_child` that lets it through there.
    """
    resource_tracker.ensure_running()  # at its start it unblocks both signals
    with _STARTING, _interruptions_held_off():
        main = sys.modules["__main__"]
        before = {name: os.environ[name] for name in THREAD_VARIABLES if name in os.environ}
        os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = main
            for name in THREAD_VARIABLES:
                del os.environ[name]
            os.environ.update(before)


@contextmanager
def _interruptions_held_off() -> Iterator[None]:
    """Block both signals in processes that are started, and let those that come here wait for the end of the context.

    A signal that is blocked in one thread goes to another, of a library perhaps, and Python calls its handler then.
    """
    came: list[int] = []
    in_main = threading.current_thread() is threading.main_thread()  # which alone runs and sets handlers
    handlers = {n: signal.signal(n, lambda number, _: came.append(number)) for n in _INTERRUPTIONS if in_main}
    unblocked = signal.pthread_sigmask(signal.SIG_BLOCK, _INTERRUPTIONS)  # inherited by processes
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, unblocked)
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for arrived in came:
            signal.raise_signal(arrived)


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


def run_jobs(
    work: Callable[[Job], Result],
    jobs: Mapping[str, Job],
    *,
    n_workers: int | None = None,
    engine: Engine = "local",
    device: str = "cpu",
    stage: str = "the work",
) -> Iterator[tuple[str, Result]]:
    """Yield the name and the result of ``work(job)`` for every job, in the order in which they finish.

    A single local worker is this process; several are child processes with one thread each.

    Args:
        work: a module-level function, or a partial of one with the data that all jobs share (sent once per worker).
        jobs: name → job; jobs and results are picklable.
        n_workers: number of workers, default one per core.
        engine: local processes or Ray.
        device: of the work; Ray assigns GPUs by it.
        stage: what is done, for the message when a worker died.

    Raises:
        BadInput: `n_workers` is below 1 or too large, or there is no such engine.
        ZestError: a worker died (out of memory, killed, a crash of a native library).
    """
    if engine not in get_args(Engine):
        raise BadInput(f"unknown engine {engine!r}; {nearest(engine, get_args(Engine))}")
    most = WORKERS_PER_CORE * n_cores() if engine == "local" else MAX_ACTORS
    if n_workers is not None and not (n_workers >= 1 and min(n_workers, len(jobs)) <= most):
        raise BadInput(
            f"the number of workers must be between 1 and {most} here, got {n_workers}; leave it out for one per core"
        )
    if engine == "ray":
        yield from ray_engine.run_jobs(work, jobs, n_workers=n_workers, device=device, stage=stage)
    elif (n_processes := min(n_workers or n_cores(), len(jobs))) > 1:
        yield from _run_in_pool(work, jobs, n_processes, stage)
    else:
        for name, job in jobs.items():
            yield name, work(job)


_WORK: list[Callable[[Any], Any]] = []
"""Of this worker process."""


def _start_worker(work: Callable[[Any], Any]) -> None:
    prepare_child()
    _WORK.append(work)


def _do(job: Any) -> Any:
    return _WORK[0](job)


def _run_in_pool(
    work: Callable[[Job], Result], jobs: Mapping[str, Job], n_processes: int, stage: str
) -> Iterator[tuple[str, Result]]:
    waiting = iter(jobs.items())
    running: dict[Future[Result], str] = {}  # at most one per process: a pool finishes every job submitted to it
    context = multiprocessing.get_context("spawn")  # fork is unsafe beside torch's and the GL library's threads
    others, workers = set(multiprocessing.active_children()), set[BaseProcess]()
    with ProcessPoolExecutor(n_processes, context, _start_worker, (work,)) as pool:
        try:
            while True:
                with starting_children():  # submitting starts them
                    for name, job in itertools.islice(waiting, n_processes - len(running)):
                        running[pool.submit(_do, job)] = name
                workers |= set(multiprocessing.active_children()) - others
                if not running:
                    return
                done = next(as_completed(running))
                yield running.pop(done), done.result()
        except BrokenProcessPool as error:
            for worker in workers:
                worker.join(10)  # the pool's own thread, which may be waiting for it, else hides the code
            codes = [worker.exitcode for worker in workers]
            others_end = -signal.SIGTERM  # as the pool ends those that are left
            first = next((code for code in codes if code not in (None, 0, others_end)), others_end)
            raise ZestError(
                f"a worker process died in {stage} before all of {len(jobs)} parts were done "
                f"({cause_of_death(first)}); finished parts are kept, run the same command again to go on"
            ) from error
        except (KeyboardInterrupt, GeneratorExit):
            for worker in set(multiprocessing.active_children()) - others:  # the pool would wait for their jobs
                worker.kill()
            raise


def cached_jobs(
    work: Callable[[Job], Arrays],
    jobs: Mapping[str, Job],
    folder: Path,
    *,
    n_workers: int | None = None,
    engine: Engine = "local",
    device: str = "cpu",
    stage: str = "the work",
    layout: Callable[[Job], Layout] | None = None,
) -> Iterator[str]:
    """Write the arrays of ``work(job)`` to ``folder/NAME.npz`` for every job, and yield its name when they are there.

    Finished jobs are skipped. Arguments are those of `run_jobs`; a job's name must identify its content, and the work
    must depend on nothing else. Local workers write their results, so that nothing is lost with this process; workers
    of a cluster may have other disks, so this process writes.

    `layout` returns the arrays that a job's file must hold: then the folder is a cache, whose damaged files are made
    again. Without it files of versions that wrote no digests are finished, too: they belong to runs, which keep them.

    Raises:
        BadInput: as in `run_jobs`.
        ZestError: a worker died; finished jobs are kept.
    """
    missing = {}
    for name, job in jobs.items():
        if _read_part(folder, name, None if layout is None else layout(job)) is None:
            missing[name] = (name, job)
        else:
            yield name
    do = partial(_do_named, work, None if engine == "ray" else folder)
    for name, arrays in run_jobs(do, missing, n_workers=n_workers, engine=engine, device=device, stage=stage):
        if arrays is not None:
            write_arrays(folder / f"{name}.npz", arrays)
        yield name


def _do_named(work: Callable[[Job], Arrays], folder: Path | None, named: tuple[str, Job]) -> Arrays | None:
    """Do a job; write its arrays to the folder, or return them if there is none."""
    name, job = named
    arrays = work(job)
    if folder is None:
        return arrays
    write_arrays(folder / f"{name}.npz", arrays)
    return None


def chunks(n: int, size: int) -> list[range]:
    """Split ``range(n)`` into ranges of at most `size`."""
    return [range(start, min(start + size, n)) for start in range(0, n, size)]


def read_parts(
    folder: Path, names: Iterable[str], layouts: Mapping[str, Layout] | None = None
) -> dict[str, NDArray[Any]]:
    """Read the files of `cached_jobs` for these jobs, joined along the first axis; `layouts` by name, or none.

    Raises:
        ZestError: a part is missing or damaged.
    """
    parts = {name: _read_part(folder, name, None if layouts is None else layouts[name]) for name in names}
    if missing := [name for name, part in parts.items() if part is None]:
        raise ZestError(f"parts of {folder} are missing or damaged ({', '.join(missing)}); run the command again")
    return concatenate([part for part in parts.values() if part is not None])


def _read_part(folder: Path, name: str, layout: Layout | None) -> dict[str, NDArray[Any]] | None:
    return read_arrays(folder / f"{name}.npz", layout, undigested=layout is None)
