"""What a GPU gives: ``python -m benchmarks gpu``; with ``--device cpu`` a short dry run of the same on the CPU.

Needs no network: episodes are those of the scripted expert, goals are the toys, weights are the installed ones (of
ViT-B/32 random ones, since speed does not depend on their values). Takes about four minutes on one GPU and five cores.

- rendering: frames per second of one process, and which GL renderer drew them.
- embedding: pictures per second of the package and of the networks alone by precision, batch and mode; how far the
  vectors are from the CPU's in fp32, and the direction of their changes within a scene, which rewards are made of.
- relabeling: the whole of `relabel_source` on an empty cache by 1, 2 and all processes that share the card.
- training: updates per second of BC and the Decision Transformer on both devices, one training and two at once; and
  how far the losses of a training without dropout in fp32 are from the CPU's.
- evaluation: the Decision Transformer with online scores, its network on either device.

Every part tells the most memory that was taken on the card. A part that fails is reported, and the others go on.
"""

from __future__ import annotations

import csv
import json
import os
import platform
import shutil
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks._networks_alone import NETWORKS, pictures_per_s
from zest_rl.agents import get_agent
from zest_rl.data.reader import dataset_path
from zest_rl.data.writer import write_dataset
from zest_rl.embedders import DEFAULT_EMBEDDER, Precision, load_embedder
from zest_rl.errors import BadInput
from zest_rl.evaluation.evaluate import EvaluationConfig, evaluate
from zest_rl.kitchen.behaviour import Behaviour, recordings, run_behaviour
from zest_rl.kitchen.env import HORIZON, env_spec
from zest_rl.kitchen.views import Views, distinct_states
from zest_rl.rewards.relabel import relabel_source
from zest_rl.rewards.scorer import ScorerConfig
from zest_rl.runtime.gl import select_gl_backend
from zest_rl.runtime.parallel import n_cores, run_jobs
from zest_rl.sources.kitchen import kitchen_source
from zest_rl.training.loop import TrainingConfig
from zest_rl.training.runs import train
from zest_rl.types import FloatArray, Frame

FP32_TOLERANCE = 1e-5
"""Largest distance of an embedding from the CPU's, in units of its length."""
LOSS_TOLERANCE = 1e-3
"""Largest relative difference of a loss from the CPU's, over a whole curve."""
DATASET = "zest/kitchen-micro-{n}-v0"
CONFIG = ScorerConfig("toys")
AGENTS = ("bc", "dt")
PRECISIONS: tuple[Precision, ...] = ("fp32", "bf16")


@dataclass(frozen=True)
class Sizes:
    """How much is done."""

    views: Views
    n_few: int = 12
    """Episodes that one and two processes relabel."""
    n_many: int = 64
    """Episodes that all processes relabel, and that policies are trained on."""
    n_frames: int = 512
    """Frames that are embedded, a multiple of all batches."""
    n_reference: int = 64
    """Those of them that the CPU embeds, too."""
    batches: tuple[int, ...] = (8, 64, 512)
    seconds: float = 0.1
    """Of each measurement of a network alone."""
    n_updates: dict[str, int] = field(default_factory=lambda: {"bc": 600, "dt": 500})
    n_cpu_updates: dict[str, int] = field(default_factory=lambda: {"bc": 100, "dt": 100})
    n_curve: int = 100
    """Updates of the trainings whose losses are compared."""
    n_episodes: int = 25
    """Of an evaluation."""


FULL = Sizes(Views("micro", n_views=8))
DRY_RUN = Sizes(
    Views("micro", n_views=1), n_few=1, n_many=2, n_frames=8, n_reference=8, batches=(8,), seconds=0.0,
    n_updates={"bc": 4, "dt": 4}, n_cpu_updates={"bc": 4, "dt": 4}, n_curve=4, n_episodes=2,
)  # fmt: skip


@dataclass(frozen=True)
class Setting:
    """Where and how much is measured, and what one part leaves for the next."""

    device: torch.device
    sizes: Sizes
    folder: Path
    """Of datasets, caches and runs; it is removed at the end."""
    states: NDArray[np.float64]
    """Distinct states of all episodes."""
    relabeled: list[str] = field(default_factory=list)
    """Ids of what `relabeling` wrote, the largest last."""

    @property
    def has_gpu(self) -> bool:
        """Whether this is no dry run."""
        return self.device.type == "cuda"

    def render(self) -> tuple[list[Frame], float]:
        """Return `n_frames` frames, and the seconds that drawing them took."""
        views = self.sizes.views
        views.render(self.states[0])  # the first frame pays for the GL context
        start = time.perf_counter()
        frames = [
            frame for state in self.states[: self.sizes.n_frames // views.n_drawn] for frame in views.render(state)
        ]
        return frames, time.perf_counter() - start

    @contextmanager
    def empty_cache(self) -> Iterator[None]:
        """Give the commands within an empty cache."""
        before = os.environ["ZEST_CACHE"]
        os.environ["ZEST_CACHE"] = tempfile.mkdtemp(dir=self.folder)
        try:
            yield
        finally:
            os.environ["ZEST_CACHE"] = before


@contextmanager
def peak_memory(device: torch.device) -> Iterator[dict[str, float]]:
    """Yield a dictionary that gets the most memory of the card in use meanwhile, by all processes, in GiB."""
    peak: dict[str, float] = {}
    if device.type != "cuda":
        yield peak
        return
    ended, most = threading.Event(), [0]

    def watch() -> None:
        while not ended.wait(0.05):
            free, total = torch.cuda.mem_get_info(device)
            most[0] = max(most[0], total - free)

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield peak
    finally:
        ended.set()
        watcher.join()
        peak["peak_gib"] = round(most[0] / 2**30, 2)


def machine(device: torch.device) -> dict[str, Any]:
    """Describe what is measured on."""
    names = ("model name", "Hardware")
    lines = (line.partition(":") for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines())
    about: dict[str, Any] = {
        "cpu": next((value.strip() for name, _, value in lines if name.strip() in names), platform.machine()),
        "n_cores": n_cores(),
        "python": platform.python_version(),
        "torch": torch.__version__,
    }
    if device.type == "cuda":
        card = torch.cuda.get_device_properties(device)
        about |= {
            "gpu": card.name,
            "gpu_gib": round(card.total_memory / 2**30, 1),
            "cudnn": torch.backends.cudnn.version(),
        }
    return about


# -------------------------------------------------------------------------------------------------------- rendering


def rendering(setting: Setting) -> dict[str, Any]:
    """Measure frames per second of one process."""
    frames, seconds = setting.render()
    from OpenGL import GL  # not before the renderer, which chooses PyOpenGL's platform

    renderer = GL.glGetString(GL.GL_RENDERER).decode()
    return {"backend": select_gl_backend(), "renderer": renderer, "frames_per_s": round(len(frames) / seconds, 1)}


# -------------------------------------------------------------------------------------------------------- embedding


def embedding(setting: Setting) -> dict[str, Any]:
    """Measure pictures per second of the package and of networks alone, and how far vectors are from the CPU's."""
    frames, _ = setting.render()
    few, n_views = frames[: setting.sizes.n_reference], setting.sizes.views.n_drawn
    reference = load_embedder(DEFAULT_EMBEDDER, device="cpu", precision="fp32").embed_images(few)
    found: dict[str, Any] = {}
    for precision in PRECISIONS:
        embedder = load_embedder(DEFAULT_EMBEDDER, device=str(setting.device), precision=precision, batch_size=8)
        found[f"{precision}_against_cpu"] = differences(embedder.embed_images(few), reference, n_views)
        start = time.perf_counter()
        embedder.embed_images(frames)
        found[f"{precision}_pictures_per_s"] = round(len(frames) / (time.perf_counter() - start), 1)
    for name in NETWORKS if setting.has_gpu else [DEFAULT_EMBEDDER]:
        rates = pictures_per_s(NETWORKS[name](), frames, setting.device, setting.sizes.batches, setting.sizes.seconds)
        found[f"{name}_alone_pictures_per_s"] = rates
    return found | {"passed": found["fp32_against_cpu"]["relative_error"] <= FP32_TOLERANCE}


def differences(vectors: FloatArray, reference: FloatArray, n_views: int) -> dict[str, float]:
    """Return the largest distance in units of the length, and cosines of the changes since the first state."""

    def changes(rows: FloatArray) -> FloatArray:
        by_view = rows.reshape(-1, n_views, rows.shape[1])
        return (by_view[1:] - by_view[:1]).reshape(-1, rows.shape[1])

    off = np.linalg.norm(vectors - reference, axis=1) / np.linalg.norm(reference, axis=1)
    ours, theirs = changes(vectors), changes(reference)
    lengths = np.linalg.norm(ours, axis=1) * np.linalg.norm(theirs, axis=1)
    cosines = (ours * theirs).sum(axis=1)[lengths > 0] / lengths[lengths > 0]
    return {
        "relative_error": float(off.max()),
        "smallest_cosine_of_changes": float(cosines.min()),
        "median_cosine_of_changes": float(np.median(cosines)),
    }


# ------------------------------------------------------------------------------------------------------- relabeling


def relabeling(setting: Setting) -> dict[str, Any]:
    """Measure frames per second of whole relabels on an empty cache, by the number of processes."""
    sizes = setting.sizes
    found: dict[str, Any] = {}
    workers = sorted({(1, sizes.n_few), (2, sizes.n_few), (n_cores(), sizes.n_many)})
    for n_workers, n_episodes in workers:
        with setting.empty_cache():
            relabel_once(setting, n_workers, n_episodes, found)
    return found


def relabel_once(setting: Setting, n_workers: int, n_episodes: int, found: dict[str, Any]) -> None:
    """Relabel a dataset and add what was measured; keep the result of the large one."""
    dataset_id, views = DATASET.replace("{n}", str(n_episodes)), setting.sizes.views
    done: list[float] = []
    start = time.perf_counter()
    made = relabel_source(
        kitchen_source(dataset_id, views),
        CONFIG,
        device=str(setting.device),
        n_workers=n_workers,
        on_progress=lambda *_: done.append(time.perf_counter()),
    )
    seconds = time.perf_counter() - start
    drawn = made.n_embedded * views.n_drawn
    warm = min(n_workers, len(done) - 1)  # the first part of each process waits for its start
    rate = (len(done) - warm) / len(done) * drawn / (done[-1] - done[warm - 1]) if warm else float("nan")
    found[f"{n_workers}_processes"] = {
        "episodes": n_episodes,
        "frames_of_the_dataset_and_views": made.n_frames * views.n_drawn,
        "frames_drawn_and_embedded": drawn,
        "seconds": round(seconds, 2),
        "frames_per_s": round(drawn / seconds, 1),
        "frames_per_s_once_started": round(rate, 1),
    }
    if n_episodes == setting.sizes.n_many:
        setting.relabeled.append(made.dataset_id)
    else:
        shutil.rmtree(dataset_path(made.dataset_id))  # the next one does the same


# --------------------------------------------------------------------------------------------------------- training


@dataclass(frozen=True)
class TrainJob:
    """One training."""

    agent: str
    dataset_id: str
    device: str
    n_updates: int
    run: Path
    exact: bool = False
    """Without dropout, in fp32, so that its losses are the same on any device."""

    def metrics(self) -> list[dict[str, float]]:
        """Train, or read what was logged before."""
        config = get_agent(self.agent).config(**({"dropout": 0.0, "amp": "fp32"} if self.exact else {}))
        options = TrainingConfig(n_updates=self.n_updates, device=self.device, log_every=max(1, self.n_updates // 20))
        train(self.agent, self.dataset_id, config, options, run_dir=self.run)
        with (self.run / "metrics.csv").open(encoding="utf-8") as file:
            return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]

    def updates_per_s(self) -> float:
        """Return the median over the rows after the first, which holds the start."""
        rows = self.metrics()
        return round(statistics.median(row["updates_per_s"] for row in rows[1:]), 1)


def training(setting: Setting) -> dict[str, Any]:
    """Measure updates per second on both devices, alone and two at once, and compare the losses."""
    sizes, device = setting.sizes, str(setting.device)
    found: dict[str, Any] = {}
    worst = 0.0
    for agent in AGENTS:

        def job(name: str, where: str, n_updates: int, exact: bool = False, agent: str = agent) -> TrainJob:
            return TrainJob(agent, setting.relabeled[-1], where, n_updates, setting.folder / f"{agent}-{name}", exact)

        alone = job("gpu", device, sizes.n_updates[agent])
        pair = {name: job(name, device, sizes.n_updates[agent]) for name in ("first", "second")}
        curves = [
            np.array([row["loss"] for row in job(f"curve-{where}", where, sizes.n_curve, True).metrics()])
            for where in (device, "cpu")
        ]
        worst = max(worst, float(np.max(np.abs(curves[0] / curves[1] - 1))))
        found[agent] = {
            "updates_per_s": alone.updates_per_s(),
            "updates_per_s_of_two_at_once": dict(run_jobs(TrainJob.updates_per_s, pair, n_workers=2)),
            "updates_per_s_on_the_cpu": job("cpu", "cpu", sizes.n_cpu_updates[agent]).updates_per_s(),
            "losses": [round(float(loss), 6) for loss in curves[0]],
            "losses_on_the_cpu": [round(float(loss), 6) for loss in curves[1]],
        }
    return found | {"largest_relative_difference_of_losses": worst, "passed": worst <= LOSS_TOLERANCE}


# ------------------------------------------------------------------------------------------------------- evaluation


def evaluation(setting: Setting) -> dict[str, Any]:
    """Measure environment steps per second of the Decision Transformer with online scores, start-up included."""
    run, found = setting.folder / "dt-gpu", {}
    for device in dict.fromkeys((str(setting.device), "cpu")):
        with setting.empty_cache():
            start = time.perf_counter()
            result = evaluate(run, EvaluationConfig(n_episodes=setting.sizes.n_episodes), device=device)
            seconds = time.perf_counter() - start
        found[f"policy_on_{device}"] = {
            "seconds": round(seconds, 2),
            "steps_per_s": round(setting.sizes.n_episodes * HORIZON / seconds, 1),
            "normalized_return": round(float(result.returns().mean()), 2),
        }
        shutil.rmtree(result.folder)  # the next one does the same
    return found


# -------------------------------------------------------------------------------------------------------------- run

PARTS = (rendering, embedding, relabeling, training, evaluation)


def collect(sizes: Sizes) -> NDArray[np.float64]:
    """Leave two datasets of the scripted expert in the Minari root; return their distinct states."""
    episodes = run_behaviour(Behaviour("micro", "expert", noise_max=1.0), sizes.n_many)
    for n in (sizes.n_few, sizes.n_many):
        write_dataset(
            DATASET.replace("{n}", str(n)),
            recordings({name: array[:n] for name, array in episodes.items()}),
            env_spec=env_spec("micro").to_json(),
            ref_min_score=0.0,
            ref_max_score=70.0,
            algorithm_name="scripted expert with uniform action noise",
            description="episodes for a benchmark",
            zest={"collect": {"asked": {"task": "micro"}}},
        )
    return distinct_states(np.concatenate(list(episodes["qpos"])), sizes.views)


def measure(device: torch.device) -> dict[str, Any]:
    """Run all parts in a temporary folder; each prints its results, in case that the last one does not end."""
    sizes = FULL if device.type == "cuda" else DRY_RUN
    result: dict[str, Any] = {"dry_run": device.type != "cuda", "machine": machine(device), "passed": True}
    before = {name: os.environ.get(name) for name in ("MINARI_DATASETS_PATH", "ZEST_CACHE")}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ.update(MINARI_DATASETS_PATH=str(folder / "minari"), ZEST_CACHE=str(folder / "cache"))
        try:
            setting = Setting(device, sizes, folder, collect(sizes))
            for part in PARTS:
                start = time.monotonic()
                with peak_memory(device) as peak:
                    try:
                        found = part(setting)
                    except Exception as error:  # the minutes of a GPU are few: the other parts go on
                        found = {"error": f"{type(error).__name__}: {error}", "passed": False}
                result[part.__name__] = found | peak | {"seconds_in_all": round(time.monotonic() - start, 1)}
                result["passed"] = result["passed"] and found.get("passed", True)
                print(part.__name__, json.dumps(result[part.__name__]), file=sys.stderr, flush=True)
        finally:
            for variable, value in before.items():
                os.environ.pop(variable) if value is None else os.environ.update({variable: value})
    return result


def run(device: str = "cuda") -> dict[str, Any]:
    """Measure on a GPU, or try everything once on the CPU.

    Raises:
        BadInput: there is no GPU.
    """
    if device != "cpu" and not torch.cuda.is_available():
        raise BadInput(
            f"torch {torch.__version__} finds no CUDA device here, got {device!r}; run this on a machine with a GPU, "
            "or try it with small sizes: python -m benchmarks gpu --device cpu"
        )
    return measure(torch.device(device))
