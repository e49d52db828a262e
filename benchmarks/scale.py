"""Relabeling up to 200,000 frames: CPU time per frame, memory and frames per second; and a killed worker.

Frames are 64×64 renderings of the kitchen, as JPEG in Minari datasets with episodes of 1000. No two episodes are equal,
and embeddings are kept by episode, so every frame is embedded.

- CPU time per frame of 1,000 to 200,000 frames, in one process that has started and relabeled before: what a dataset of
  two frames takes there is subtracted. It must not depend on the number of frames by more than a tenth. The network is
  one random matrix on shrunken frames, so that what is measured is reading, hashing, caching, scoring and writing.
- All 200,000 frames by one process, two, and Ray's workers. Memory is the proportional set size of the command and all
  its children (shared pages are counted once), sampled every 0.1 s.
- 2,000 of these frames go through the embedded default, for the speed that a user sees.
- One of two processes is killed on the way; finished episodes must be kept, and be left alone by the next command.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

MEMORY_LIMIT = 2.0
"""GiB."""
FLATNESS = 1.1
"""Largest cost of a frame by the smallest."""
SIDE, STEPS = 64, 999
N_EPISODES = {"two frames": 1, "1,000": 1, "2,000": 2, "10,000": 10, "40,000": 40, "100,000": 100, "200,000": 200}
"""Of the datasets, which go by their number of frames."""
REPEATS = {"1,000": 5, "10,000": 2, "100,000": 1, "200,000": 1}
"""How often the CPU time of a dataset is measured; the least counts."""
FEW, SOME, MANY = "2,000", "40,000", "200,000"
SMALL = ("--embedder", "matrix:1280", "--precision", "fp32")
"""The network of `install_network`."""
NETWORK = """
import torch
from torchvision.transforms.functional import pil_to_tensor
from zest_rl.embedders.networks import Network

def build(dim):
    torch.manual_seed(0)
    module = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(8), torch.nn.Flatten(), torch.nn.Linear(192, int(dim)))
    return Network(module, lambda image: pil_to_tensor(image) / 255, module)
"""


def make_frames() -> np.ndarray:
    """Render (N, SIDE, SIDE, 3) uint8 of two episodes of the kitchen from several sides, more than an episode shows."""
    from zest_rl.kitchen.behaviour import Behaviour, rollout
    from zest_rl.kitchen.views import Views

    behaviour = Behaviour("micro", "expert")
    states = np.concatenate([rollout(behaviour, index)["qpos"].reshape(101, -1) for index in range(2)])
    renderer = Views("micro", n_views=8, size=SIDE, robot=True).shared_renderer()
    return np.concatenate([renderer.render(state) for state in states])


def dataset(n_frames: str) -> str:
    """Return the id of the dataset with so many frames."""
    return f"bench/frames-{n_frames.replace(',', '').replace(' ', '-')}-v0"


def write_data(frames: np.ndarray, dataset_id: str, n_episodes: int, n_steps: int = STEPS) -> None:
    """Leave a dataset of such frames in the Minari root."""
    import minari
    from gymnasium import spaces
    from minari.data_collector import EpisodeBuffer

    def buffer(episode: int) -> EpisodeBuffer:
        shown = (np.arange(n_steps + 1) + 7 * episode) % len(frames)
        return EpisodeBuffer(
            id=episode,
            observations={
                "camera": np.roll(frames[shown], episode % SIDE, axis=2),
                "joints": np.zeros((n_steps + 1, 7), np.float32),
            },
            actions=np.zeros((n_steps, 7), np.float32),
            rewards=np.zeros(n_steps),
            terminations=np.zeros(n_steps, bool),
            truncations=np.arange(n_steps) == n_steps - 1,
        )

    space = {"camera": spaces.Box(0, 255, frames.shape[1:], np.uint8), "joints": spaces.Box(-1, 1, (7,), np.float32)}
    minari.create_dataset_from_buffers(
        dataset_id,
        [buffer(episode) for episode in range(n_episodes)],
        observation_space=spaces.Dict(space),
        action_space=spaces.Box(-1, 1, (7,), np.float32),
    )


def install_network(site: Path) -> None:
    """Leave a package that registers the small network, for this process and those that it starts."""
    info = site / "matrix-1.0.dist-info"
    info.mkdir(parents=True)
    (site / "matrix_network.py").write_text(NETWORK, encoding="utf-8")
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: matrix\nVersion: 1.0\n", encoding="utf-8")
    (info / "entry_points.txt").write_text("[zest_rl.embedders]\nmatrix = matrix_network:build\n", encoding="utf-8")
    sys.path.insert(0, str(site))
    os.environ["PYTHONPATH"] = os.pathsep.join([str(site), *filter(None, [os.environ.get("PYTHONPATH")])])


def cpu_seconds() -> float:
    """Return the CPU time of this process and of its children that have ended."""
    return sum(os.times()[:4])


def processes_of(root: int) -> list[int]:
    """Return a process and all below it."""
    parents = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:
                continue  # it is gone
    found = [root]
    for process in found:
        found += [child for child, parent in parents.items() if parent == process]
    return found


def memory_of(processes: list[int]) -> float:
    """Return the proportional set size of processes, GiB."""
    total = 0
    for process in processes:
        try:
            lines = Path(f"/proc/{process}/smaps_rollup").read_text(encoding="utf-8").splitlines()
        except OSError:
            continue
        total += sum(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return total / 2**20


@contextmanager
def relabeling(dataset_id: str, *words: str) -> Iterator[subprocess.Popen[str]]:
    """Start `zest relabel`."""
    command = [sys.executable, "-c", "import sys; from zest_rl.cli import main; sys.exit(main())", "relabel"]
    command += [dataset_id, "--goal", "goal", *words, "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def measure(n_frames: str, cache: str, *words: str) -> dict[str, Any]:
    """Relabel with an empty cache; return frames per second, memory, and the CPU time of all but Ray's processes."""
    os.environ["ZEST_CACHE"] = cache
    start, cpu, peak = time.monotonic(), cpu_seconds(), 0.0
    with relabeling(dataset(n_frames), *words) as process:
        while process.poll() is None:
            peak = max(peak, memory_of(processes_of(process.pid)))
            time.sleep(0.1)
        out, err = process.communicate()
    seconds, cpu = time.monotonic() - start, cpu_seconds() - cpu
    if process.returncode:
        raise RuntimeError(err)
    result = json.loads(out)
    shutil.rmtree(result["path"])  # the next way to make it starts anew
    shutil.rmtree(cache)  # a gigabyte
    found = {
        "seconds": round(seconds, 1),
        "frames_per_s": round(result["n_frames"] / seconds, 1),
        "cpu_seconds": round(cpu, 1),
        "peak_gib": round(peak, 2),
    }
    print(n_frames, *words, found, file=sys.stderr, flush=True)  # the whole takes long
    return found


def costs_per_frame(cache: str) -> dict[str, float]:
    """Return the CPU time per frame in ms by the number of frames, without what a command takes for two frames."""
    from zest_rl.rewards.relabel import relabel

    def cpu_of(n_frames: str) -> float:
        os.environ["ZEST_CACHE"] = cache
        before = cpu_seconds()
        relabeled = relabel(dataset(n_frames), "goal", embedder=SMALL[1], precision="fp32", n_workers=1)
        seconds = cpu_seconds() - before
        shutil.rmtree(relabeled.path)
        shutil.rmtree(cache)
        print(f"{n_frames}: {seconds:.2f} s of CPU in one process", file=sys.stderr, flush=True)
        return seconds

    cpu_of("two frames")  # starts everything
    fixed = min(cpu_of("two frames") for _ in range(3))
    least = {n_frames: min(cpu_of(n_frames) for _ in range(n_times)) for n_frames, n_times in REPEATS.items()}
    return {n_frames: round((seconds - fixed) / N_EPISODES[n_frames], 3) for n_frames, seconds in least.items()}


def kill_a_worker(cache: str, *words: str) -> dict[str, Any]:
    """Kill one of two processes when some episodes are done, run the command again; count what it still embeds."""
    os.environ["ZEST_CACHE"] = cache

    def n_done() -> int:
        return len(list(Path(cache).rglob("frames/*/*.npz")))

    with relabeling(dataset(SOME), *words) as process:
        while n_done() < N_EPISODES[SOME] // 4 and process.poll() is None:
            time.sleep(0.1)
        before = n_done()
        worker = next(
            p
            for p in processes_of(process.pid)
            if "spawn_main" in Path(f"/proc/{p}/cmdline").read_text(encoding="utf-8")
        )
        os.kill(worker, signal.SIGKILL)
        _, err = process.communicate()
    kept, said = n_done(), err.strip().splitlines()[-1]
    with relabeling(dataset(SOME), *words) as process:
        out, _ = process.communicate()
    again = json.loads(out)
    shutil.rmtree(again["path"])
    return {
        "said": said,
        "done_before": before,
        "kept": kept,
        "then_embedded": again["n_episodes_embedded"],
        "nothing_lost": kept >= before and again["n_episodes_embedded"] == N_EPISODES[SOME] - kept,
    }


def run() -> dict[str, Any]:
    """Measure."""
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as scratch:
        os.chdir(scratch)
        os.environ["MINARI_DATASETS_PATH"] = f"{scratch}/minari"
        Path("minari").mkdir()
        frames = make_frames()
        for part, frame in (("init", frames[0]), ("goal", frames[-8])):
            Path("goal", part).mkdir(parents=True)
            Image.fromarray(frame).save(f"goal/{part}/0.png")
        install_network(Path(scratch, "site"))
        for name, n_episodes in N_EPISODES.items():
            write_data(frames, dataset(name), n_episodes, STEPS if name != "two frames" else 1)
        ways: dict[str, tuple[str, ...]] = {
            "1 process": ("--n-workers", "1"),
            "2 processes": ("--n-workers", "2"),
            "Ray, 2 workers": ("--engine", "ray", "--n-workers", "2"),
        }
        found["small network, two frames"] = measure("two frames", f"{scratch}/cache", *SMALL, *ways["1 process"])
        costs = costs_per_frame(f"{scratch}/cache")
        found |= {f"CPU ms per frame, {n_frames} frames": cost for n_frames, cost in costs.items()}
        for network, n_frames, chosen in (("default", FEW, ()), ("small", MANY, SMALL)):
            for name, words in ways.items():
                key = f"{network} network, {n_frames} frames, {name}"
                found[key] = measure(n_frames, f"{scratch}/cache", *chosen, *words)
        found["a killed worker"] = kill_a_worker(f"{scratch}/cache", *SMALL, *ways["2 processes"])
        most = max(each["peak_gib"] for each in found.values() if isinstance(each, dict) and "peak_gib" in each)
        is_flat = max(costs.values()) <= FLATNESS * min(costs.values())
        found["passed"] = most < MEMORY_LIMIT and is_flat and found["a killed worker"]["nothing_lost"]
    return found
