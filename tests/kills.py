"""Work that is killed at its n-th operation on files, or message to another process, and done again.

``python kills.py SCENARIO FOLDER STRIDE`` kills it at every STRIDE-th operation. It prints the number of kills, and
those after which the work, done again, left something other than work that nothing cut.
"""

from __future__ import annotations

import itertools
import json
import multiprocessing
import os
import shutil
import signal
import socket
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

EVENTS = ("os.rename", "os.remove", "os.rmdir", "os.mkdir")
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC


@dataclass(frozen=True)
class Scenario:
    """What is done again and again."""

    work: Callable[[Path], Any]
    """Do the work in a folder."""
    result: Callable[[Path], Any]
    """What must not depend on kills."""
    prepare: Callable[[Path], None] = Path.mkdir
    n_processes: int = 1
    depth: int = 0
    """0: the process that works is killed, 1: the child that it starts."""


# --- counting and killing ---------------------------------------------------------------------------------------------

n_done, kill_at, depth, armed_depth, watched = 0, 0, 0, 0, ""


def step() -> None:
    """Count an operation, and die before the chosen one."""
    global n_done
    if depth == armed_depth:
        n_done += 1
        if n_done == kill_at:
            os.kill(os.getpid(), signal.SIGKILL)


def hook(event: str, arguments: tuple[Any, ...]) -> None:
    if not watched:
        return
    writes = event == "open" and isinstance(arguments[2], int) and arguments[2] & WRITES
    if (writes or event in EVENTS) and str(arguments[0]).startswith(watched):
        step()


def after(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that the hook does not see, and that is an operation, too."""

    def call(*arguments: Any, **options: Any) -> Any:
        if watched:
            step()
        return function(*arguments, **options)

    return call


def deeper() -> None:
    global depth
    depth += 1


def start(scenario: Scenario, folder: Path, rank: int, at: int) -> int:
    """Do the work in a fork that dies before its operation `at`; 0: never."""
    global n_done, kill_at, depth, armed_depth, watched
    process = os.fork()
    if process:
        return process
    n_done, kill_at, depth, armed_depth, watched = 0, at, 0, scenario.depth, str(folder)
    code = 1
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        if scenario.n_processes > 1:
            os.environ.update(RANK=str(rank), WORLD_SIZE=str(scenario.n_processes), MASTER_ADDR="127.0.0.1")
        scenario.work(folder)
        code = 0
    finally:
        os._exit(code)


def succeeds(scenario: Scenario, folder: Path, *, rank: int = 0, at: int = 0) -> bool:
    """Do the work in as many processes as it takes, of which that of `rank` is killed; tell whether all end well."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        os.environ["MASTER_PORT"] = str(free.getsockname()[1])
    processes = [start(scenario, folder, r, at if r == rank else 0) for r in range(scenario.n_processes)]
    _, status = os.waitpid(processes.pop(rank), 0)
    for process in processes:
        if status:
            os.kill(process, signal.SIGKILL)  # as torchrun does
        status |= os.waitpid(process, 0)[1]
    return not status


def names(folder: Path) -> list[str]:
    """Of all files, without locks and the files of TensorBoard, which are named by time."""
    files = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    return sorted(name for name in files if not name.endswith(".lock") and "/tb/" not in name)


def sweep(scenario: Scenario, root: Path, stride: int, rank: int = 0) -> dict[str, Any]:
    """Kill at every `stride`-th operation of a rank, until the work ends before the kill."""
    warm, whole, cut = root / "warm", root / "whole", root / "cut"
    scenario.prepare(warm)
    scenario.work(warm)  # imports what the forks then need not import
    scenario.prepare(whole)
    assert succeeds(scenario, whole), "uncut work fails"
    expected, files = scenario.result(whole), names(whole)
    n_kills, wrong = 0, []
    for at in itertools.count(1, stride):
        scenario.prepare(cut)
        if succeeds(scenario, cut, rank=rank, at=at):
            break
        n_kills += 1
        well = succeeds(scenario, cut, rank=rank)
        if not well or scenario.result(cut) != expected or names(cut) != files:
            wrong.append({"operation": at, "ended_well": well, "files": sorted(set(names(cut)) ^ set(files))})
        shutil.rmtree(cut)
    return {"kills": n_kills, "wrong": wrong}


# --- what is done -----------------------------------------------------------------------------------------------------


def hashes(folder: Path, pattern: str) -> dict[str, str]:
    from zest_rl.runtime.artifacts import hash_file

    return {path.relative_to(folder).as_posix(): hash_file(path) for path in sorted(folder.glob(pattern))}


def training(agent: str, n_processes: int = 1) -> Scenario:
    import torch.distributed as dist

    sys.path.insert(0, str(Path(__file__).parent / "training"))
    from test_loop import CONFIGS, make_episodes

    from zest_rl.training.loop import TrainingConfig, fit

    episodes = make_episodes()
    for name in ("all_reduce", "all_gather_object"):
        setattr(dist, name, after(getattr(dist, name)))

    def work(folder: Path) -> None:
        config = TrainingConfig(
            n_updates=5, seed=3, device="cpu", threads=1, checkpoint_every=2, log_every=2, snapshot_every=3
        )
        fit(agent, CONFIGS[agent], episodes, folder / "run", config, files={"scorer.bin": b"scorer"})

    def result(folder: Path) -> Any:
        rows = (folder / "run" / "metrics.csv").read_text().splitlines()
        return hashes(folder, "**/model.safetensors"), [row.rpartition(",")[0] for row in rows]

    return Scenario(work, result, n_processes=n_processes)


def small_dataset(folder: Path) -> str:
    """Leave the tiny dataset in a Minari root of its own."""
    from tiny_dataset import COLLECTED, collect_some

    os.environ["MINARI_DATASETS_PATH"] = str(folder / "minari")
    collect_some(COLLECTED, "micro", 2)
    return COLLECTED


def evaluation(root: Path) -> Scenario:
    from zest_rl.agents.bc import BCConfig
    from zest_rl.evaluation import evaluate as e
    from zest_rl.runtime import artifacts
    from zest_rl.training.loop import TrainingConfig
    from zest_rl.training.runs import train

    config = TrainingConfig(n_updates=2, device="cpu", threads=1)
    run = train("bc", small_dataset(root), BCConfig(hidden_size=16, n_layers=1), config, run_dir=root / "run")
    meta = artifacts.read_json(run / "meta.json")
    meta["dataset"]["env_spec"] = json.dumps(json.loads(meta["dataset"]["env_spec"]) | {"max_episode_steps": 3})
    artifacts.write_json(run / "meta.json", meta)
    e.EPISODES_PER_JOB = e.N_JOBS = 1
    asked = e.EvaluationConfig(n_episodes=2)
    e.N_JOBS = 2

    def result(folder: Path) -> Any:
        read = artifacts.read_json(e.evaluation_folder(folder, asked) / "result.json")
        return {key: read[key] for key in ("summary", "episodes", "parts")}

    return Scenario(lambda folder: e.evaluate(folder, asked, n_workers=1), result, partial(shutil.copytree, run))


def adoption(root: Path) -> Scenario:
    import torch

    from zest_rl.runtime import artifacts
    from zest_rl.training.adoption import adopt

    dataset = small_dataset(root)
    torch.jit.save(torch.jit.script(torch.nn.Linear(59, 9)), root / "policy.pt")

    def result(folder: Path) -> Any:
        meta = artifacts.read_json(folder / "run" / "meta.json")
        return hashes(folder, "run/policy/*"), {key: meta[key] for key in meta if key != "made_by"}

    return Scenario(lambda folder: adopt(f"torchscript:{root / 'policy.pt'}", dataset, run_dir=folder / "run"), result)


def collecting(depth: int) -> Scenario:
    from zest_rl.data.reader import Dataset, open_dataset
    from zest_rl.kitchen import behaviour, calibration
    from zest_rl.kitchen.collect import collect_dataset
    from zest_rl.kitchen.collect_config import CollectConfig

    calibration.N_REFERENCE, calibration.N_NOTHING, behaviour.EPISODES_PER_JOB, behaviour.HORIZON = 1, 1, 1, 50
    config = CollectConfig(task="micro", n_episodes=2, noise_max=0.5)
    fork_children()

    def places(folder: Path) -> None:
        os.environ.update(MINARI_DATASETS_PATH=str(folder / "minari"), ZEST_CACHE=str(folder / "cache"))

    def work(folder: Path) -> None:
        places(folder)
        collect_dataset(config, n_workers=1)

    def result(folder: Path) -> Any:
        places(folder)
        with open_dataset(config.dataset_id) as ds:
            return ds.fingerprint(), Dataset.describe(ds)

    return Scenario(work, result, depth=depth)


def pictures(folder: Path) -> None:
    """Leave two episodes of one action in robomimic's layout, pictures of their frames, and a goal."""
    import h5py
    import numpy as np
    from PIL import Image

    rng = np.random.default_rng(0)
    names = [f"films/episode_{i}/{t}.png" for i in range(2) for t in range(2)] + ["goal/init/0.png", "goal/goal/0.png"]
    for path in (folder / name for name in names):
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(rng.integers(0, 256, (16, 16, 3), dtype=np.uint8)).save(path)
    with h5py.File(folder / "some.hdf5", "w") as file:
        for i in range(2):
            file[f"data/demo_{i}/actions"], file[f"data/demo_{i}/obs/joints"] = np.zeros((1, 2)), np.zeros((1, 3))


def fork_children() -> None:
    """Fork child processes, because a spawned one would import everything again."""
    context = multiprocessing.get_context("fork")
    multiprocessing.get_context = lambda method=None: context  # type: ignore[assignment]


def relabeling(root: Path, depth: int) -> Scenario:
    from zest_rl.data import reader
    from zest_rl.rewards.relabel import relabel

    data = root / "data"
    pictures(data)
    fork_children()

    def places(folder: Path) -> None:
        os.environ.update(MINARI_DATASETS_PATH=str(folder / "minari"), ZEST_CACHE=str(folder / "cache"))

    def work(folder: Path) -> None:
        places(folder)
        relabel(str(data / "some.hdf5"), str(data / "goal"), frames=[str(data / "films")], n_workers=1, device="cpu")

    def result(folder: Path) -> Any:
        places(folder)
        (name,) = reader.list_datasets()
        with reader.open_dataset(name) as ds:
            return name, ds.fingerprint(), [rewards.tolist() for rewards in ds.rewards()]

    return Scenario(work, result, depth=depth)


def exporting(root: Path, to: Any, depth: int) -> Scenario:
    from zest_rl.export import export

    dataset = small_dataset(root)
    fork_children()

    def work(folder: Path) -> None:
        if not (folder / "out").exists():
            export(dataset, to, folder / "out")

    return Scenario(work, lambda folder: hashes(folder, "out/**/*.memmap"), depth=depth)


def main(scenario: str, folder: Path, stride: int) -> dict[str, Any]:
    import zest_rl.runtime.load_order  # noqa: F401  # isort: skip

    from zest_rl.runtime import artifacts

    artifacts.provenance = dict  # takes longer than the work
    os.fsync = after(lambda handle: None)  # only a machine that goes down needs it
    sys.addaudithook(hook)
    os.register_at_fork(after_in_child=deeper)
    kind, _, detail = scenario.partition(" ")
    if kind == "train":
        return sweep(training(detail), folder, stride)
    if kind == "torchrun":
        agent, rank = detail.split()
        return sweep(training(agent, n_processes=2), folder, stride, int(rank))
    if kind == "relabel":
        return sweep(relabeling(folder, int(detail)), folder, stride)
    if kind == "export":
        to, depth_of_kill = detail.split()
        return sweep(exporting(folder, to, int(depth_of_kill)), folder, stride)
    if kind == "collect":
        return sweep(collecting(int(detail)), folder, stride)
    return sweep({"evaluate": evaluation, "adopt": adoption}[kind](folder), folder, stride)


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]))))
