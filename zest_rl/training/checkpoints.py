"""The state of a training, and how it survives an interruption: ``checkpoints/update-N`` of a run folder."""

from __future__ import annotations

import copy
import operator
import shutil
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from torch import Tensor, nn

from zest_rl.agents.base import Judge, networks_of
from zest_rl.errors import ZestError
from zest_rl.runtime import artifacts
from zest_rl.runtime.files import check_file
from zest_rl.runtime.records import reading_record

N_CHECKPOINTS = 2
_PARTS = ("model", "optimizer", "average", "generators")
_BEST = "best.safetensors"
_FILES = {"state.json", *(f"{part}.safetensors" for part in _PARTS)}


@dataclass
class TrainState:
    """Everything that changes in a training; a checkpoint holds this and torch's random generators."""

    model: nn.Module
    optimizer: torch.optim.Optimizer
    rng: np.random.Generator
    average: dict[str, Tensor]
    """Exponential moving average of `params`: the weights that a policy acts with."""
    update: int = 0
    recent: list[tuple[float, float]] = field(default_factory=list)
    """(loss, gradient norm) since the last logged row."""
    seconds: float = 0.0
    best: dict[str, Tensor] = field(default_factory=dict)
    """`averaged_weights` of the smallest ``held_out_loss``; empty where nothing is held out."""
    best_judged: dict[str, float] = field(default_factory=dict)
    """``update``, and `zest_rl.agents.base.JUDGED`, of these."""

    @classmethod
    def start(cls, model: nn.Module, weight_decay: float, seed: int) -> TrainState:
        """Return the state before the first update; AdamW trains the parameters that require a gradient."""
        trained = {name: p for name, p in model.named_parameters() if p.requires_grad}
        optimizer = torch.optim.AdamW(trained.values(), weight_decay=weight_decay, fused=True)
        average = {name: p.detach().clone() for name, p in trained.items()}
        return cls(model.train(), optimizer, np.random.default_rng(seed), average)

    @property
    def params(self) -> dict[str, nn.Parameter]:
        """Trained parameters by name, in the optimizer's order."""
        return {name: p for name, p in self.model.named_parameters() if p.requires_grad}

    def update_average(self, params: list[nn.Parameter], decay: float) -> None:
        """Move the average towards `params`; after n updates the decay is at most (1 + n) / (10 + n).

        This is the rule of TensorFlow's ``ExponentialMovingAverage``.
        """
        decay = min(decay, (1 + self.update) / (10 + self.update))
        with torch.no_grad():
            for mean, parameter in zip(self.average.values(), params, strict=True):
                mean.lerp_(parameter, 1 - decay)

    def judge(self, judge: Judge) -> dict[str, float]:
        """Judge the averaged weights, and keep them if they are the best so far."""
        weights, model = self.averaged_weights(), copy.deepcopy(self.model).eval()
        model.load_state_dict(weights)
        judged = judge(networks_of(model))
        if not self.best or judged["held_out_loss"] < self.best_judged["held_out_loss"]:
            self.best = {name: tensor.clone() for name, tensor in weights.items()}
            self.best_judged = {"update": self.update, **judged}
        return judged

    def averaged_weights(self) -> dict[str, Tensor]:
        """Return the model's state dict on the CPU, with averages in place of the trained parameters."""
        return {name: tensor.cpu() for name, tensor in (self.model.state_dict() | self.average).items()}


def save_checkpoint(run_dir: Path, state: TrainState) -> None:
    """Write the state under ``checkpoints/update-N`` and remove all but the newest `N_CHECKPOINTS`."""
    folder = run_dir / "checkpoints" / f"update-{state.update:09d}"
    moments = {
        f"{name}/{key}": tensor
        for name, parameter in state.params.items()
        for key, tensor in state.optimizer.state[parameter].items()
    }
    generators = {"cpu": torch.get_rng_state()}
    device = next(state.model.parameters()).device
    if device.type == "cuda":
        generators["cuda"] = torch.cuda.get_rng_state(device)
    weights = state.model.state_dict()
    parts = dict(zip(_PARTS, (weights, moments, state.average, generators), strict=True))
    artifacts.check_free_space(run_dir, sum(t.nbytes for tensors in parts.values() for t in tensors.values()))
    with artifacts.staged_folder(folder) as staging:
        for name, tensors in parts.items():
            safetensors.torch.save_file(tensors, staging / f"{name}.safetensors")
        if state.best:
            safetensors.torch.save_file(state.best, staging / _BEST)
        progress = {
            "update": state.update,
            "seconds": state.seconds,
            "recent": state.recent,
            "sampler": state.rng.bit_generator.state,
            "best_judged": state.best_judged,
        }
        artifacts.write_json(staging / "state.json", progress)
        manifest = {path.name: artifacts.hash_file(path) for path in sorted(staging.iterdir())}
        artifacts.write_json(staging / "manifest.json", manifest)
    for old in _checkpoints(run_dir)[:-N_CHECKPOINTS]:
        shutil.rmtree(old, ignore_errors=True)


def _checkpoints(run_dir: Path) -> list[Path]:
    return sorted((run_dir / "checkpoints").glob("update-*"))


def resume(run_dir: Path, state: TrainState) -> None:
    """Restore `state` and torch's generators from the newest checkpoint, if there is one.

    Raises:
        ZestError: the checkpoint is damaged.
    """
    folders = _checkpoints(run_dir)
    if not folders:
        return
    _verify(folders[-1])
    with reading_record(folders[-1], "delete this folder and start the run again, or train into a new one"):
        _restore(folders[-1], state)


def _restore(folder: Path, state: TrainState) -> None:
    tensors = {name: safetensors.torch.load_file(folder / f"{name}.safetensors") for name in _PARTS}
    state.model.load_state_dict(tensors["model"])
    for name, mean in state.average.items():
        mean.copy_(tensors["average"][name])
    parameters = state.params
    moments: dict[int, dict[str, Tensor]] = {i: {} for i in range(len(parameters))}
    places = {name: i for i, name in enumerate(parameters)}
    for full_name, tensor in tensors["optimizer"].items():
        name, _, key = full_name.rpartition("/")
        if tensor.shape not in ((), parameters[name].shape):
            raise ValueError(f"{full_name} has shape {tuple(tensor.shape)}")
        moments[places[name]][key] = tensor.clone()
    state.optimizer.load_state_dict({"state": moments, "param_groups": state.optimizer.state_dict()["param_groups"]})
    torch.set_rng_state(tensors["generators"]["cpu"])
    if "cuda" in tensors["generators"]:
        torch.cuda.set_rng_state(tensors["generators"]["cuda"], next(state.model.parameters()).device)
    progress = artifacts.read_json(folder / "state.json")
    state.update, state.seconds = operator.index(progress["update"]), float(progress["seconds"])
    state.recent = [(float(loss), float(norm)) for loss, norm in progress["recent"]]
    state.rng.bit_generator.state = progress["sampler"]
    if (folder / _BEST).exists():
        state.best, state.best_judged = safetensors.torch.load_file(folder / _BEST), progress["best_judged"]


def _is_whole(path: Path, sha256: str) -> bool:
    try:
        check_file(path)
        return artifacts.hash_file(path) == sha256
    except (ZestError, OSError):
        return False


def _verify(folder: Path) -> None:
    bad = ["manifest.json"]
    with suppress(ZestError):
        manifest = artifacts.read_json(folder / "manifest.json")
        if isinstance(manifest, dict) and set(manifest) | {_BEST} == _FILES | {_BEST}:
            bad = [name for name in sorted(manifest) if not _is_whole(folder / name, manifest[name])]
    if bad:
        raise ZestError(
            f"checkpoint {folder} is damaged: {', '.join(bad)} is not what was written; delete this folder and start "
            "the run again, which then goes on from the checkpoint before it"
        )
