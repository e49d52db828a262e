"""Jobs on a Ray cluster: the other engine of `zest_rl.runtime.parallel`. Needs the extra ``ray``.

Each worker is a Ray actor: a process with one core, and a GPU of its own, for as long as there is work. Ray restarts
an actor that died and repeats its job. Results return to the calling process, which alone writes them. Ray Data, made
for tables, takes twice as long to start and returns the same arrays.
"""

from __future__ import annotations

import importlib.util
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from zest_rl.errors import BadInput, ZestError

Job = TypeVar("Job")
Result = TypeVar("Result")
MAX_RETRIES = 3
"""How often a job is repeated after its worker died."""
PASSED_VARIABLES = ("ZEST_", "MINARI_", "HF_", "TORCH_HOME", "MUJOCO_GL")
"""Prefixes of the environment variables that are passed to workers."""


class _Worker:
    """The class of the actors."""

    def __init__(self, work: Callable[[Any], Any], folder: str) -> None:
        self._work = work
        with suppress(FileNotFoundError):  # so that relative paths work, where this node has the folder
            os.chdir(folder)

    def start(self) -> None:
        """Return once the actor has started."""

    def do(self, name: str, job: Any) -> tuple[str, Any]:
        """Do a job; an error is returned as a result, so that Ray does not wrap it."""
        try:
            return name, self._work(job)
        except Exception as error:
            return name, error


def run_jobs(
    work: Callable[[Job], Result],
    jobs: Mapping[str, Job],
    *,
    n_workers: int | None = None,
    device: str = "cpu",
    stage: str = "the work",
) -> Iterator[tuple[str, Result]]:
    """Yield the name and the result of ``work(job)`` for every job, in the order in which they finish.

    The cluster is that of ``RAY_ADDRESS``, or of the caller's own ``ray.init``; else one is started on this machine
    until the work is done.

    There are at most `n_workers`, by default one per GPU, or one per core without GPUs. Unless `device` is ``cpu``,
    each worker has a GPU of its own where there are any.

    Raises:
        BadInput: Ray is not installed, or its workers lack the device.
        ZestError: the cluster cannot be joined, or a job's worker died repeatedly.
    """
    if importlib.util.find_spec("ray") is None:
        raise BadInput("engine 'ray' needs Ray: pip install 'zest-rl[ray]', or use engine 'local'")
    if ":" in device:
        raise BadInput(
            f"on Ray each worker has one GPU, which it calls cuda, got device {device!r}; use cuda, cpu or auto"
        )
    if not jobs:
        return
    import ray
    from ray.exceptions import RayError
    from ray.util import ActorPool

    with _cluster(n_workers):
        resources = ray.cluster_resources()  # type: ignore[no-untyped-call]
        n_gpus = 0 if device == "cpu" else int(resources.get("GPU", 0))
        if device == "cuda" and n_gpus == 0:
            raise BadInput("device 'cuda' is not there: the Ray cluster has no GPU; use cpu or auto")
        n_places = n_gpus or int(resources.get("CPU", 1))
        n_actors = min(n_workers or n_places, n_places, len(jobs))
        as_actor = ray.remote(num_cpus=1, num_gpus=min(n_gpus, 1), max_restarts=-1, max_task_retries=MAX_RETRIES)
        actor_class: Any = as_actor(_Worker)
        actors = [actor_class.remote(work, str(Path.cwd())) for _ in range(n_actors)]
        pool: Any = ActorPool(actors)
        try:
            for _ in actors:  # jobs go only to actors that have started: a busy cluster may lack room for some
                pool.submit(lambda actor, _: actor.start.remote(), None)
            for job in jobs.items():
                pool.submit(lambda actor, job: actor.do.remote(*job), job)
            while pool.has_next():
                if (done := pool.get_next_unordered()) is not None:
                    name, result = done
                    if isinstance(result, Exception):
                        raise result
                    yield name, result
        except RayError as error:
            raise ZestError(
                f"Ray could not finish {stage} ({type(error).__name__}: {error}); finished parts are kept, run the "
                "same command again to go on"
            ) from error
        finally:
            for actor in actors:
                ray.kill(actor)


@contextmanager
def _cluster(n_workers: int | None) -> Iterator[None]:
    """Join a cluster, or start one on this machine for as long as the context is open."""
    import ray

    if ray.is_initialized():
        yield
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # otherwise Ray reports usage to its makers
    settings = {name: value for name, value in os.environ.items() if name.startswith(PASSED_VARIABLES)}
    options: dict[str, Any] = {"runtime_env": {"env_vars": settings}, "log_to_driver": False, "logging_level": "error"}
    if address := os.environ.get("RAY_ADDRESS"):
        _join(address, options)
    else:
        os.environ.setdefault("RAY_worker_niceness", "0")  # as the local engine's processes; Ray's default is 15
        on_sigterm = signal.getsignal(signal.SIGTERM)
        ray.init(address="local", num_cpus=n_workers, include_dashboard=False, **options)
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, on_sigterm)  # Ray ends the process at once, without a word
    try:
        yield
    finally:
        ray.shutdown()


def _join(address: str, options: Mapping[str, Any]) -> None:
    import ray

    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        if port.isdecimal():  # where nothing answers, Ray itself would try for minutes
            socket.create_connection((host, int(port)), timeout=10).close()
        ray.init(address=address, **options)
    except (OSError, RuntimeError, ValueError) as error:  # a ConnectionError is an OSError
        raise ZestError(
            f"the Ray cluster at RAY_ADDRESS={address} cannot be joined ({error}); run the command on one of its nodes "
            "with the same version of Ray, or unset the variable to start a cluster on this machine"
        ) from error
