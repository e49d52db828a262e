"""Sample → loss → step → log → save / resume. Knows no algorithm and no environment.

A run folder, and what each part of it is for::

    run.json            what was asked for; a rerun that asks for something else is refused
    metrics.csv, tb/    loss, gradient norm, learning rate, updates per second; tb/ is for TensorBoard
    checkpoints/        the last two states of an unfinished run, each with a sha256 manifest
    snapshots/          policies on the way, if asked for: each with the two files below, as `zest evaluate` takes them
    model.safetensors   the weights to act with: the moving average of the trained ones
    meta.json           everything needed to load and to trace them; written last, so it says "finished"

A run that was killed at any moment and is started again with the same arguments ends with the same bits as one that
was not (on a CPU, with the same number of threads): weights, their average, optimizer, both random generators and the
running means are restored from the last checkpoint, and rows of the log after it are dropped.

Under ``torchrun`` the processes share the work (`zest_rl.training.distributed`); the first alone writes.
"""

from __future__ import annotations

import csv
import json
import math
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from torch import Tensor, nn
from torch.utils.tensorboard import SummaryWriter

from zest_rl.agents import get_agent
from zest_rl.agents.base import (
    DataFacts,
    Rules,
    autocast,
    check_fields,
    describe_data,
    resolve_precision,
)
from zest_rl.errors import BadInput, ZestError
from zest_rl.runtime import artifacts
from zest_rl.training.checkpoints import TrainState, resume, save_checkpoint, snapshot_folder
from zest_rl.training.distributed import Group, joined, launched, local_index
from zest_rl.types import Episode

Progress = Callable[[int, dict[str, float]], None]
COLUMNS = ("loss", "grad_norm", "learning_rate", "updates_per_s")
RESULT_KEYS = ("n_params", "model_sha256", "train_seconds", "made_by")  # keys of meta.json that only the end knows


def train(
    agent: str,
    config: Any,
    episodes: Sequence[Episode],
    run_dir: Path,
    *,
    n_updates: int,
    seed: int,
    meta: Mapping[str, Any],
    device: str = "auto",
    threads: int | None = None,
    checkpoint_every: int = 500,
    log_every: int = 50,
    snapshot_every: int | None = None,
    on_progress: Progress | None = None,
) -> Path:
    """Train a policy, or go on with a run that was cut short; return `run_dir`. A finished run returns at once.

    Args:
        agent: name in `zest_rl.agents.AGENTS`.
        config: that agent's config.
        episodes: the data; the rewards in them are all that is known about quality.
        run_dir: folder of this run alone.
        n_updates: gradient steps.
        seed: of the weights, the batches and the dropout.
        meta: facts about the data (JSON), copied into ``meta.json`` beside the run's own; part of the run's identity.
        device: ``cpu``, ``cuda``, ``cuda:N``, or ``auto``: CUDA where there is one.
        threads: CPU threads; torch's current number by default. Bits depend on it, so it is recorded.
        checkpoint_every: updates between checkpoints.
        log_every: updates between rows of the log; a row holds means over the updates since the last one.
        snapshot_every: updates between policies kept under ``snapshots/``, for learning curves; none by default.
        on_progress: called after every logged row with the number of updates done and the row.

    Raises:
        BadInput: an argument is out of range, the data do not suit, or `run_dir` holds another run.
        ZestError: the loss is not finite, a checkpoint is damaged, the folder cannot be written to, or another process
            of this training is gone.
    """
    definition = get_agent(agent)
    if not isinstance(config, definition.config):
        raise BadInput(f"agent {agent!r} takes a {definition.config.__name__}, got a {type(config).__name__}")
    n_threads = torch.get_num_threads() if threads is None else threads
    arguments = _Arguments(n_updates, seed, n_threads, checkpoint_every, log_every, snapshot_every)
    place = _find_device(device)
    facts = describe_data(episodes)
    sample = definition.sampler(config, facts, episodes)
    launched().share(sample(np.random.default_rng(seed)))  # a batch that is too small is refused before all else
    precision = resolve_precision(config.amp, place)
    request: dict[str, Any] = {
        "agent": agent,
        "config": asdict(config),
        "n_updates": n_updates,
        "seed": seed,
        "device": str(place),
        "threads": arguments.threads,
        "snapshot_every": snapshot_every,
        "precision": precision,
        "data_sha256": artifacts.hash_arrays(*(a for e in episodes for a in (e.obs, e.actions, e.rewards))),
    }
    if launched().size > 1:
        request["n_processes"] = launched().size
    taken = sorted(meta.keys() & {*request, *asdict(facts), *RESULT_KEYS})
    if taken:
        raise BadInput(f"meta must not use the keys {', '.join(taken)}, which meta.json has already; rename them")
    request |= meta

    with joined(place) as group, artifacts.lock(run_dir) if group.leads else nullcontext():
        if group.leads:
            _claim(run_dir, request)
        group.agree(data_sha256=request["data_sha256"], precision=precision)  # and wait for the claim
        finished = (run_dir / "meta.json").exists()
        group.agree(finished=finished)
        if not finished:
            with _torch_set_up(seed, arguments.threads, place):
                state = TrainState.start(definition.build(config, facts).to(place), config.weight_decay, seed)
                resume(run_dir, state)
                group.agree(updates_done=state.update)

                def draw_loss() -> Tensor:
                    rows, weight = group.share(sample(state.rng))
                    batch = {name: tensor.to(place) for name, tensor in rows.items()}
                    with autocast(precision, place):
                        return definition.loss(state.model, batch) * weight

                def keep_snapshot() -> None:
                    folder = snapshot_folder(run_dir, state.update)
                    if not folder.exists():
                        with artifacts.staged_folder(folder) as staging:
                            _write_policy(staging, state, request | {"n_updates": state.update}, facts)

                _fit(run_dir, state, draw_loss, config, arguments, keep_snapshot, on_progress, group)
            if group.leads:
                _write_policy(run_dir, state, request, facts)
        if group.leads:
            shutil.rmtree(run_dir / "checkpoints", ignore_errors=True)
        group.agree()  # files are there when any of them returns
    return run_dir


@dataclass(frozen=True)
class _Arguments:
    n_updates: int
    seed: int
    threads: int
    checkpoint_every: int
    log_every: int
    snapshot_every: int | None

    def __post_init__(self) -> None:
        rules: Rules = {
            "seed": (self.seed >= 0, "0 or positive"),
            **{
                name: (getattr(self, name) >= 1, "at least 1")
                for name in ("n_updates", "threads", "checkpoint_every", "log_every")
            },
            "snapshot_every": (self.snapshot_every is None or self.snapshot_every >= 1, "at least 1, or None"),
        }
        check_fields("training", self, rules)


# ------------------------------------------------------------------------------------------------------------ loop


def _fit(
    run_dir: Path,
    state: TrainState,
    draw_loss: Callable[[], Tensor],
    config: Any,
    arguments: _Arguments,
    keep_snapshot: Callable[[], None],
    on_progress: Progress | None,
    group: Group,
) -> None:
    params = list(state.params.values())
    log = _open_log(run_dir, state.update) if group.leads else nullcontext(lambda _update, _row: None)
    with log as write_row:
        tick = row_tick = time.perf_counter()
        row_update = state.update
        _draw_apart(arguments.seed, group, state.update)
        while state.update < arguments.n_updates:
            warm = min(1.0, (state.update + 1) / config.warmup_updates) if config.warmup_updates else 1.0
            for options in state.optimizer.param_groups:
                options["lr"] = config.learning_rate * warm
            loss = draw_loss()
            state.optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            loss = loss.detach()
            group.average([loss, *(p.grad for p in params if p.grad is not None)])
            norm = nn.utils.clip_grad_norm_(params, config.grad_clip)
            state.optimizer.step()
            state.update += 1
            state.follow(params, config.ema_decay)
            state.recent.append((loss.item(), norm.item()))
            if not all(map(math.isfinite, state.recent[-1])):
                raise ZestError(
                    f"loss and gradient must be finite, got {state.recent[-1]} at update {state.update}; "
                    "lower learning_rate or set amp to fp32, and train into a new folder"
                )
            now = time.perf_counter()
            state.seconds, tick = state.seconds + now - tick, now
            if state.update % arguments.log_every == 0 or state.update == arguments.n_updates:
                losses, norms = np.mean(state.recent, axis=0)
                speed = (state.update - row_update) / (now - row_tick)
                values = (float(losses), float(norms), config.learning_rate * warm, round(speed, 2))
                row = dict(zip(COLUMNS, values, strict=True))
                write_row(state.update, row)
                state.recent, row_update, row_tick = [], state.update, now
                if on_progress is not None:
                    on_progress(state.update, row)
            if state.update % arguments.checkpoint_every == 0:
                _draw_apart(arguments.seed, group, state.update)
            if not group.leads:
                continue
            every = arguments.snapshot_every
            if every is not None and state.update % every == 0 and state.update < arguments.n_updates:
                keep_snapshot()  # before the checkpoint: a run that goes on from there does not come by here again
            if state.update % arguments.checkpoint_every == 0 and state.update < arguments.n_updates:
                save_checkpoint(run_dir, state)


def _draw_apart(seed: int, group: Group, update: int) -> None:
    """Seed the processes that follow anew, at each checkpoint: they drop other units than the first, whose generator is
    in the checkpoint, and the same ones whether the run was cut there or not.
    """
    if not group.leads:
        torch.manual_seed(int(np.random.SeedSequence([seed, group.rank, update]).generate_state(1)[0]))


@contextmanager
def _torch_set_up(seed: int, threads: int, device: torch.device) -> Iterator[None]:
    """Seed torch and set its threads; put both back at the end."""
    before = torch.get_num_threads()
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        try:
            torch.set_num_threads(threads)
            torch.manual_seed(seed)
            yield
        finally:
            torch.set_num_threads(before)


def _find_device(name: str) -> torch.device:
    kind, _, index = name.partition(":")
    if kind not in ("auto", "cpu", "cuda") or (index and not (kind == "cuda" and index.isdecimal())):
        raise BadInput(f"device must be auto, cpu, cuda or cuda:N, got {name!r}")
    if index and launched().size > 1:
        raise BadInput(
            f"under torchrun each process takes a GPU of its own, got device {name!r}; use cuda, cpu or auto"
        )
    n_cuda = torch.cuda.device_count()
    if kind == "cpu" or (kind == "auto" and n_cuda == 0):
        return torch.device("cpu")
    gpu = int(index) if index else local_index()
    if gpu >= n_cuda:
        raise BadInput(
            f"device cuda:{gpu} is not there: {n_cuda} CUDA devices found; use cpu or auto, or fewer processes"
        )
    return torch.device("cuda", gpu)


# ------------------------------------------------------------------------------------------------------------- log


@contextmanager
def _open_log(run_dir: Path, n_done: int) -> Iterator[Callable[[int, Mapping[str, float]], None]]:
    """Open ``metrics.csv`` and ``tb/`` after dropping what a killed run logged past update `n_done`."""
    path, header = run_dir / "metrics.csv", ",".join(("update", *COLUMNS))
    lines = path.read_text().splitlines() if path.exists() and n_done else []
    kept = [line for line in lines[1:] if line.count(",") == len(COLUMNS) and int(line.partition(",")[0]) <= n_done]
    artifacts.write_bytes(path, "".join(f"{line}\n" for line in (header, *kept)).encode())
    if not n_done:
        shutil.rmtree(run_dir / "tb", ignore_errors=True)
    board = SummaryWriter(run_dir / "tb", purge_step=n_done + 1)
    with path.open("a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")

        def write_row(update: int, values: Mapping[str, float]) -> None:
            writer.writerow([update, *values.values()])
            file.flush()
            os.fsync(file.fileno())  # a checkpoint after this row must find it
            for name, value in values.items():
                board.add_scalar(name, value, update)

        try:
            yield write_row
        finally:
            board.close()


# --------------------------------------------------------------------------------------------------- start and end


def _claim(run_dir: Path, request: dict[str, Any]) -> None:
    """Write ``run.json``, or check that the one that is there asks for the same."""
    path = run_dir / "run.json"
    if path.exists():
        before, now = _flat(artifacts.read_json(path)), _flat(json.loads(json.dumps(request)))
        differing = [
            f"{key} (was {before.get(key)!r}, is {now.get(key)!r})"
            for key in sorted(before.keys() | now.keys())
            if before.get(key) != now.get(key)
        ]
        if differing:
            raise BadInput(
                f"{run_dir} holds a run with other arguments: {'; '.join(differing)}; repeat the arguments of that "
                "run, or choose another folder"
            )
    elif run_dir.exists() and any(not entry.name.startswith(".") for entry in run_dir.iterdir()):
        raise BadInput(f"{run_dir} is not empty and holds no run; choose another folder")
    else:
        artifacts.write_json(path, request)


def _flat(value: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested objects as one, with dotted keys."""
    items: dict[str, Any] = {}
    for key, entry in value.items():
        items |= _flat(entry, f"{prefix}{key}.") if isinstance(entry, dict) else {f"{prefix}{key}": entry}
    return items


def _write_policy(folder: Path, state: TrainState, request: dict[str, Any], facts: DataFacts) -> None:
    """Write the weights, then ``meta.json``."""
    weights = safetensors.torch.save(state.averaged_weights())
    artifacts.write_bytes(folder / "model.safetensors", weights)
    n_params = sum(p.numel() for p in state.params.values())
    results = (n_params, artifacts.hash_bytes(weights), round(state.seconds, 1), artifacts.provenance())
    artifacts.write_json(folder / "meta.json", request | asdict(facts) | dict(zip(RESULT_KEYS, results, strict=True)))
