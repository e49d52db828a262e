"""Relabeling 200,000 frames: memory and frames per second of one process, two, and Ray's workers; and a killed worker.

Frames are 64×64 renderings of the kitchen, as JPEG in a Minari dataset of 200 episodes. No two episodes are equal, and
embeddings are kept by episode, so every frame is embedded.

- All 200,000 go through timm's smallest transformer (0.4 million random weights, from a file), so that what is measured
  is reading, hashing, preprocessing, caching, scoring and writing. Memory is the proportional set size of the command
  and all its children (shared pages are counted once), sampled every 0.1 s.
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
SIDE, STEPS = 64, 999
MANY, SOME, FEW = 200, 40, 2
SMALL = "test_vit"


def make_frames() -> np.ndarray:
    """Render (N, SIDE, SIDE, 3) uint8 of two episodes of the kitchen from several sides, more than an episode shows."""
    from zest_rl.kitchen.behaviour import Behaviour, rollout
    from zest_rl.kitchen.views import Views

    behaviour = Behaviour("micro", "expert")
    states = np.concatenate([rollout(behaviour, index)["qpos"].reshape(101, -1) for index in range(2)])
    renderer = Views("micro", n_views=8, size=SIDE, robot=True).shared_renderer()
    return np.concatenate([renderer.render(state) for state in states])


def write_data(frames: np.ndarray, dataset_id: str, n_episodes: int) -> None:
    """Leave a dataset of such frames in the Minari root."""
    import minari
    from gymnasium import spaces
    from minari.data_collector import EpisodeBuffer

    def buffer(episode: int) -> EpisodeBuffer:
        shown = (np.arange(STEPS + 1) + 7 * episode) % len(frames)
        return EpisodeBuffer(
            id=episode,
            observations={
                "camera": np.roll(frames[shown], episode % SIDE, axis=2),
                "joints": np.zeros((STEPS + 1, 7), np.float32),
            },
            actions=np.zeros((STEPS, 7), np.float32),
            rewards=np.zeros(STEPS),
            terminations=np.zeros(STEPS, bool),
            truncations=np.arange(STEPS) == STEPS - 1,
        )

    space = {"camera": spaces.Box(0, 255, frames.shape[1:], np.uint8), "joints": spaces.Box(-1, 1, (7,), np.float32)}
    minari.create_dataset_from_buffers(
        dataset_id,
        [buffer(episode) for episode in range(n_episodes)],
        observation_space=spaces.Dict(space),
        action_space=spaces.Box(-1, 1, (7,), np.float32),
    )


def write_network(path: Path) -> None:
    """Leave the small network's weights in a file."""
    import timm
    import torch
    from safetensors.torch import save_file

    torch.manual_seed(0)
    save_file(timm.create_model(SMALL, pretrained=False).state_dict(), path)


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


def measure(dataset_id: str, cache: str, *words: str) -> dict[str, Any]:
    """Relabel with an empty cache; return frames per second and memory."""
    os.environ["ZEST_CACHE"] = cache
    start, peak = time.monotonic(), 0.0
    with relabeling(dataset_id, *words) as process:
        while process.poll() is None:
            peak = max(peak, memory_of(processes_of(process.pid)))
            time.sleep(0.1)
        out, err = process.communicate()
    seconds = time.monotonic() - start
    if process.returncode:
        raise RuntimeError(err)
    result = json.loads(out)
    shutil.rmtree(result["path"])  # the next way to make it starts anew
    found = {
        "frames": result["n_frames"],
        "seconds": round(seconds, 1),
        "frames_per_s": round(result["n_frames"] / seconds, 1),
        "peak_gib": round(peak, 2),
    }
    print(*words, found, file=sys.stderr, flush=True)  # the whole takes most of an hour
    return found


def kill_a_worker(dataset_id: str, cache: str, *words: str) -> dict[str, Any]:
    """Kill one of two processes when some episodes are done, run the command again; count what it still embeds."""
    os.environ["ZEST_CACHE"] = cache

    def n_done() -> int:
        return len(list(Path(cache).rglob("frames/*/*.npz")))

    with relabeling(dataset_id, *words) as process:
        while n_done() < SOME // 4 and process.poll() is None:
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
    with relabeling(dataset_id, *words) as process:
        out, _ = process.communicate()
    again = json.loads(out)
    shutil.rmtree(again["path"])
    return {
        "said": said,
        "done_before": before,
        "kept": kept,
        "then_embedded": again["n_episodes_embedded"],
        "nothing_lost": kept >= before and again["n_episodes_embedded"] == SOME - kept,
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
        write_network(Path("small.safetensors"))
        write_data(frames, "bench/many-v0", MANY)
        write_data(frames, "bench/some-v0", SOME)
        write_data(frames, "bench/few-v0", FEW)
        small = ("--embedder", f"timm:{SMALL}@{scratch}/small.safetensors", "--precision", "fp32")
        ways: dict[str, tuple[str, ...]] = {
            "1 process": ("--n-workers", "1"),
            "2 processes": ("--n-workers", "2"),
            "Ray, 2 workers": ("--engine", "ray", "--n-workers", "2"),
        }
        for name, words in ways.items():
            found[f"small network, {name}"] = measure("bench/many-v0", f"{scratch}/many {name}", *small, *words)
        for name, words in ways.items():
            found[f"default network, {name}"] = measure("bench/few-v0", f"{scratch}/few {name}", *words)
        found["a killed worker"] = kill_a_worker("bench/some-v0", f"{scratch}/killed", *small, *ways["2 processes"])
        most = max(found[f"small network, {name}"]["peak_gib"] for name in ("1 process", "2 processes"))
        found["passed"] = most < MEMORY_LIMIT and found["a killed worker"]["nothing_lost"]
    return found
