from __future__ import annotations

import importlib.util
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from read_dataset import read

from zest_rl.data.reader import Dataset
from zest_rl.errors import BadInput, ZestError
from zest_rl.rewards.embeddings import WorkerEmbedder, shared_embedder
from zest_rl.runtime import ray_engine
from zest_rl.runtime.arrays import Arrays, read_arrays
from zest_rl.runtime.parallel import cached_jobs

N_JOBS = 5

# --- work that is sent to other processes -----------------------------------------------------------------------------


def draw(seed: int) -> Arrays:
    values = np.random.default_rng(seed).normal(size=(60, 60)).astype(np.float32)
    return {"product": values @ values, "process": np.array([os.getpid()])}


def refuse_the_last(seed: int) -> Arrays:
    if seed == N_JOBS - 1:
        raise BadInput(f"seed {seed} is refused")
    return draw(seed)


def die_always(seed: int) -> Arrays:
    os.kill(os.getpid(), signal.SIGKILL)
    return draw(seed)


def die_once(job: tuple[int, Path]) -> Arrays:
    """Die as the out-of-memory killer does it, the first time that this job is begun."""
    seed, folder = job
    begun = folder / str(seed)
    if not begun.exists():
        begun.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return draw(seed)


# --- tests ------------------------------------------------------------------------------------------------------------


JOBS = {f"part-{seed}": seed for seed in range(N_JOBS)}


def test_an_address_where_no_cluster_answers_is_named_and_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:9")
    with pytest.raises(ZestError, match=r"the Ray cluster at RAY_ADDRESS=127\.0\.0\.1:9 cannot be joined"):
        list(cached_jobs(draw, JOBS, tmp_path, engine="ray"))


@pytest.fixture(scope="module")
def cluster() -> Iterator[None]:
    """A Ray cluster of this machine that is there before zest_rl asks for one, and after."""
    import ray

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_worker_niceness", "0")  # other tests run beside these
        ray.init(
            address="local",
            num_cpus=2,
            include_dashboard=False,
            log_to_driver=False,
            logging_level="error",
            runtime_env={"env_vars": {"PYTHONPATH": os.pathsep.join(sys.path)}},  # the work is defined here
        )
        yield
        assert ray.is_initialized(), "a cluster that was there is not ended"
        ray.shutdown()


def products(folder: Path) -> dict[str, bytes]:
    parts = {path.stem: read_arrays(path) for path in sorted(folder.glob("*.npz"))}
    return {name: part["product"].tobytes() for name, part in parts.items() if part is not None}


@pytest.mark.usefixtures("cluster")
def test_ray_leaves_what_the_local_engine_leaves_and_does_nothing_twice(tmp_path: Path) -> None:
    list(cached_jobs(draw, JOBS, tmp_path / "here", n_workers=1))
    list(cached_jobs(draw, {"part-2": 2}, tmp_path / "ray", engine="ray"))
    before = (tmp_path / "ray/part-2.npz").stat().st_mtime_ns
    assert sorted(cached_jobs(draw, JOBS, tmp_path / "ray", engine="ray", n_workers=2)) == sorted(JOBS)
    assert products(tmp_path / "ray") == products(tmp_path / "here")
    assert (tmp_path / "ray/part-2.npz").stat().st_mtime_ns == before
    processes = {int(part["process"][0]) for path in tmp_path.glob("ray/*.npz") if (part := read_arrays(path))}
    assert os.getpid() not in processes


@pytest.mark.usefixtures("cluster")
def test_a_refusal_arrives_as_it_was_raised_and_what_was_done_is_kept(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="seed 4 is refused"):
        list(cached_jobs(refuse_the_last, JOBS, tmp_path / "parts", engine="ray", n_workers=1))
    assert products(tmp_path / "parts").keys() == JOBS.keys() - {"part-4"}


@pytest.mark.usefixtures("cluster")
def test_a_worker_that_is_killed_loses_nothing(tmp_path: Path) -> None:
    (tmp_path / "begun").mkdir()
    jobs = {name: (seed, tmp_path / "begun") for name, seed in JOBS.items() if seed < 2}
    list(cached_jobs(die_once, jobs, tmp_path / "parts", engine="ray", n_workers=1))
    list(cached_jobs(draw, {name: JOBS[name] for name in jobs}, tmp_path / "here", n_workers=1))
    assert len(list((tmp_path / "begun").iterdir())) == 2
    assert products(tmp_path / "parts") == products(tmp_path / "here")


@pytest.mark.usefixtures("cluster")
def test_a_job_that_kills_every_worker_ends_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_engine, "MAX_RETRIES", 0)
    with pytest.raises(ZestError, match=r"Ray could not finish the work .* run the same command again to go on"):
        list(cached_jobs(die_always, {"part-0": 0}, tmp_path, engine="ray", n_workers=1))


@pytest.mark.usefixtures("cluster")
def test_the_kitchen_is_relabeled_on_ray_to_the_same_rewards(
    collected: str, zest: Callable[..., dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["relabel", collected, "--views", "1", "--tolerance", "0.2"]
    on_ray = zest(*words, "--engine", "ray")
    expected = read(on_ray["dataset"], Dataset.scores)
    assert on_ray["n_distinct_states_embedded"] > 0
    assert zest(*words, "--engine", "local")["dataset"] == on_ray["dataset"]
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "another"))
    (tmp_path / "minari" / on_ray["dataset"]).rename(tmp_path / "away")
    here = zest(*words, "--engine", "local")
    assert here["dataset"] == on_ray["dataset"]
    for ours, theirs in zip(read(here["dataset"], Dataset.scores), expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.usefixtures("cluster")
def test_a_gpu_that_no_worker_has_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="the Ray cluster has no GPU; use cpu or auto"):
        list(cached_jobs(draw, JOBS, tmp_path, engine="ray", device="cuda"))


def test_a_gpu_cannot_be_chosen_by_its_number(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="each worker has one GPU, which it calls cuda, got device 'cuda:1'"):
        list(cached_jobs(draw, JOBS, tmp_path, engine="ray", device="cuda:1"))


def test_an_unknown_engine_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"unknown engine 'rya'; did you mean 'ray'\?"):
        list(cached_jobs(draw, JOBS, tmp_path, engine="rya"))  # type: ignore[arg-type]


def test_an_embedder_that_is_another_on_the_worker_is_refused() -> None:
    embedder = shared_embedder("efficientnet-lite0", "fp32", "cpu", "auto", "float32")
    assert WorkerEmbedder("efficientnet-lite0", "fp32", "cpu", "auto", "float32", embedder.cache_key).load() is embedder
    for other in (
        shared_embedder("efficientnet-lite0", "bf16", "cpu", "auto", "float32"),
        shared_embedder("efficientnet-lite0", "fp32", "cpu", "torch", "float32"),
    ):
        with pytest.raises(BadInput, match="is not that of the process that asked"):
            WorkerEmbedder("efficientnet-lite0", "fp32", "cpu", "auto", "float32", other.cache_key).load()


def test_without_ray_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(ray_engine.importlib.util, "find_spec", lambda name: None if name == "ray" else find(name))
    with pytest.raises(BadInput, match=r"pip install 'zest-rl\[ray\]'"):
        list(cached_jobs(draw, JOBS, tmp_path, engine="ray"))
