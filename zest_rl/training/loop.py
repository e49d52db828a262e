"""Sample → loss → step → log → save / resume. Knows no algorithm and no environment.

A run folder holds::

    run.json            the arguments; a rerun with other ones is refused
    metrics.csv, tb/    loss, gradient norm, learning rate, updates per second; tb/ is for TensorBoard
    checkpoints/        the last two states of an unfinished run, each with a sha256 manifest
    snapshots/          intermediate policies, if asked for: each has the two files below, which `zest evaluate` takes
    model.safetensors   the weights to act with: the moving average of the trained ones; where trajectories are held
                        out (T-REX), that of the update which did best on them
    meta.json           everything needed to load and to trace them; written last, so its presence means "finished"

A run that was killed and is started again with the same arguments ends with the same bits as an uninterrupted one (on
a CPU, with the same number of threads): weights, their average, optimizer, both random generators and the running means
are restored from the last checkpoint, and later rows of the log are dropped.

Under ``torchrun`` the processes share the work (`zest_rl.training.distributed`); only the first writes.
"""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import safetensors.torch
import torch
from torch import nn

from zest_rl.agents import get_agent
from zest_rl.agents.base import (
    JUDGED,
    Agent,
    autocast,
    describe_data,
    networks_of,
    resolve_precision,
)
from zest_rl.agents.configs import OptimizerConfig
from zest_rl.errors import BadInput, ZestError
from zest_rl.runtime import artifacts
from zest_rl.training.checkpoints import TrainState, resume, save_checkpoint
from zest_rl.training.distributed import Group, launched, local_index, process_group
from zest_rl.training.log import COLUMNS, MetricsLog
from zest_rl.training.request import OnProgress, asked, check_request, snapshot_folder
from zest_rl.training.request import TrainingConfig as TrainingConfig
from zest_rl.types import Episode

RESULT_KEYS = ("n_params", "model_sha256", "train_seconds", "made_by")  # keys of meta.json that are known at the end


def fit(
    agent: str,
    agent_config: Any,
    episodes: Sequence[Episode],
    run_dir: Path,
    config: TrainingConfig,
    *,
    request: Mapping[str, Any] | None = None,
    meta: Mapping[str, Any] = MappingProxyType({}),
    files: Mapping[str, bytes] = MappingProxyType({}),
    on_progress: OnProgress | None = None,
) -> Path:
    """Train a policy, or go on with an interrupted run; return `run_dir`. A finished run returns at once.

    `zest_rl.training.runs.train` calls this with a dataset's episodes and facts.

    Args:
        agent: name in `zest_rl.agents.AGENTS`.
        agent_config: that agent's config.
        episodes: the data; their rewards are the only information about quality.
        run_dir: folder of this run alone.
        config: how long and where.
        request: what `zest_rl.training.request.asked` returned for these arguments, if it was called: it hashes the
            data.
        meta: facts about the data (JSON), copied into ``meta.json`` beside the run's own; part of the run's identity.
        files: name → content of further files of the run and its snapshots.
        on_progress: see `OnProgress`.

    Raises:
        BadInput: an argument is out of range, the data are unsuitable, or `run_dir` holds another run.
        ZestError: the loss is not finite, a checkpoint is damaged, the folder cannot be written to, or another process
            of this training is gone.
    """
    definition = get_agent(agent)
    if not isinstance(definition, Agent):
        raise BadInput(f"{agent} learns in the environment, not from data alone; use zest_rl.online.runs.train")
    if not isinstance(agent_config, definition.config):
        raise BadInput(f"agent {agent!r} takes a {definition.config.__name__}, got a {type(agent_config).__name__}")
    device = training_device(config.device)
    facts = describe_data(episodes)
    sample = definition.sampler(agent_config, facts, episodes)
    judge = definition.judge(agent_config, facts, episodes)
    launched().share(sample(np.random.default_rng(config.seed)))  # a batch that is too small is refused first
    precision = resolve_precision(agent_config.amp, device)
    asked_for = asked(agent, agent_config, episodes, config) if request is None else request
    request = {**asked_for, "device": str(device), "precision": precision}
    if config.threads is None:
        request["threads"] = torch.get_num_threads()
    if launched().size > 1:
        request["n_processes"] = launched().size
    clashing = sorted(meta.keys() & {*request, *asdict(facts), *RESULT_KEYS, "held_out"})
    if clashing:
        raise BadInput(f"meta must not use the keys {', '.join(clashing)}, which meta.json has already; rename them")
    request |= meta
    described = request | asdict(facts)

    with (
        process_group(device) as group,
        _claimed(run_dir, request, group) as finished,
        torch_set_up(config.seed, request["threads"], device),
    ):
        if finished:
            return run_dir
        model = definition.networks(agent_config, facts).to(device)
        state = TrainState.start(model, agent_config.weight_decay, config.seed)
        resume(run_dir, state)
        group.agree(updates_done=state.update)
        _reseed_others(config.seed, group, state.update)
        params = list(state.params.values())
        networks = networks_of(state.model)
        n_reported, row_update = 0, state.update
        tick = row_tick = time.perf_counter()
        judged_columns = () if judge is None else JUDGED
        with MetricsLog(run_dir, state.update, (*COLUMNS, *judged_columns)) if group.leads else nullcontext() as log:
            while state.update < config.n_updates:
                # sample
                rows, weight = group.share(sample(state.rng))
                batch = {name: tensor.to(device) for name, tensor in rows.items()}
                # loss
                with autocast(precision, device):
                    loss = torch.stack([definition.loss(network, batch) for network in networks]).sum() * weight
                # step
                learning_rate = _learning_rate(agent_config, state.update)
                for options in state.optimizer.param_groups:
                    options["lr"] = learning_rate
                state.optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                loss = loss.detach() / len(networks)
                group.average([loss, *(p.grad for p in params if p.grad is not None)])
                network_norms = [
                    nn.utils.clip_grad_norm_(network.parameters(), agent_config.grad_clip) for network in networks
                ]
                state.optimizer.step()
                state.update += 1
                state.update_average(params, agent_config.ema_decay)
                state.recent.append((loss.item(), torch.stack(network_norms).mean().item()))
                if not all(map(math.isfinite, state.recent[-1])):
                    raise ZestError(
                        f"loss and gradient must be finite, got {state.recent[-1]} at update {state.update}; "
                        "lower learning_rate or set amp to fp32, and train into a new folder"
                    )
                now = time.perf_counter()
                state.seconds, tick = state.seconds + now - tick, now
                # log
                is_last = state.update == config.n_updates
                if state.update % config.log_every == 0 or is_last:
                    losses, norms = np.mean(state.recent, axis=0)
                    row = {
                        "loss": float(losses),
                        "grad_norm": float(norms),
                        "learning_rate": learning_rate,
                        "updates_per_s": round((state.update - row_update) / (now - row_tick), 2),
                    }
                    state.recent, row_update, row_tick = [], state.update, now
                    if judge is not None:
                        row |= state.judge(judge)
                    if log is not None:
                        log.write(state.update, row)
                    if on_progress is not None:
                        on_progress(state.update - n_reported, **row)
                    n_reported = state.update
                # save
                at_checkpoint = state.update % config.checkpoint_every == 0
                if at_checkpoint:
                    _reseed_others(config.seed, group, state.update)
                if group.leads and not is_last:
                    # before the checkpoint: a run resumed from there does not reach this update again
                    if config.snapshot_every is not None and state.update % config.snapshot_every == 0:
                        _write_snapshot(run_dir, state, described, files)
                    if at_checkpoint:
                        save_checkpoint(run_dir, state)
        if group.leads:
            _write_policy(run_dir, state, described, files)
    return run_dir


def _learning_rate(config: OptimizerConfig, n_done: int) -> float:
    """Return the step size of the update after `n_done` updates: a linear warm-up, then constant."""
    warm = min(1.0, (n_done + 1) / config.warmup_updates) if config.warmup_updates else 1.0
    return config.learning_rate * warm


# ----------------------------------------------------------------------------------------------------- set-up of torch


def _reseed_others(seed: int, group: Group, update: int) -> None:
    """Reseed every process but the first, at the start and at each checkpoint.

    So their dropout differs from that of the first process, whose generator is in the checkpoint, and is the same
    whether or not the run was interrupted there.
    """
    if not group.leads:
        torch.manual_seed(int(np.random.SeedSequence([seed, group.rank, update]).generate_state(1)[0]))


@contextmanager
def torch_set_up(seed: int, threads: int, device: torch.device) -> Iterator[None]:
    """Seed torch and set its threads; restore both at the end."""
    before = torch.get_num_threads()
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        try:
            torch.set_num_threads(threads)
            torch.manual_seed(seed)
            yield
        finally:
            torch.set_num_threads(before)


def training_device(name: str) -> torch.device:
    """Return the device of a `RunConfig`; under ``torchrun``, this process's GPU.

    Raises:
        BadInput: it is none, or not there.
    """
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


# -------------------------------------------------------------------------------------------------------- run folder


@contextmanager
def _claimed(run_dir: Path, request: dict[str, Any], group: Group) -> Iterator[bool]:
    """Reserve a run folder for all processes of this training; yield whether the run in it is finished.

    On success the checkpoints are removed at the end, and no process leaves before all files are written.
    """
    with artifacts.lock(run_dir) if group.leads else nullcontext():
        if group.leads:
            check_request(run_dir, request)
        group.agree(data_sha256=request["data_sha256"], precision=request["precision"])  # and wait for `check_request`
        finished = (run_dir / "meta.json").exists()
        group.agree(finished=finished)
        yield finished
        if group.leads:
            shutil.rmtree(run_dir / "checkpoints", ignore_errors=True)
        group.agree()


def _write_snapshot(run_dir: Path, state: TrainState, described: dict[str, Any], files: Mapping[str, bytes]) -> None:
    """Keep the current policy as if the training ended here."""
    folder = snapshot_folder(run_dir, state.update)
    if not folder.exists():
        with artifacts.staged_folder(folder) as staging:
            _write_policy(staging, state, described | {"n_updates": state.update}, files)


def _write_policy(folder: Path, state: TrainState, described: dict[str, Any], files: Mapping[str, bytes]) -> None:
    """Write the weights and `files`, then ``meta.json``."""
    weights = safetensors.torch.save(state.best or state.averaged_weights())
    for name, content in {**files, "model.safetensors": weights}.items():
        artifacts.write_bytes(folder / name, content)
    n_params = sum(p.numel() for p in state.params.values())
    results = (n_params, artifacts.hash_bytes(weights), round(state.seconds, 3), artifacts.provenance())
    held_out = {"held_out": state.best_judged} if state.best else {}
    artifacts.write_json(folder / "meta.json", described | dict(zip(RESULT_KEYS, results, strict=True)) | held_out)
