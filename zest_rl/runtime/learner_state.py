"""What a learner of stable-baselines3 has learned, as named arrays, so that a training that is cut short goes on.

Their own ``save`` pickles; here weights, moments of the optimizers and replayed steps are arrays without code.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import Tensor

_REPLAYED = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def state_of(model: BaseAlgorithm) -> dict[str, NDArray[Any]]:
    """Return all that changes in a training, except the environments and random generators."""
    tensors: dict[str, Tensor] = {}
    for name, state in model.get_parameters().items():
        moments = {f"{i}/{key}": value for i, of_one in state.get("state", {}).items() for key, value in of_one.items()}
        tensors |= {f"{name}/{key}": value for key, value in (moments if "param_groups" in state else state).items()}
    if isinstance(model, SAC):
        assert model.log_ent_coef is not None
        tensors["log_ent_coef"] = model.log_ent_coef
    arrays = {name: tensor.detach().cpu().numpy() for name, tensor in tensors.items()}
    arrays["counts"] = np.array([model.num_timesteps, model._n_updates])
    if isinstance(model, SAC):
        buffer = model.replay_buffer
        assert buffer is not None
        arrays |= {f"replay/{name}": getattr(buffer, name)[: buffer.pos] for name in _REPLAYED}
    return arrays


def restore(model: BaseAlgorithm, arrays: dict[str, NDArray[Any]]) -> None:
    """Set what `state_of` returned; raises as torch does where it is of another model."""
    parameters = model.get_parameters()
    for name, state in parameters.items():
        own = {key.removeprefix(f"{name}/"): value for key, value in arrays.items() if key.startswith(f"{name}/")}
        if "param_groups" not in state:
            parameters[name] = {key: torch.tensor(value) for key, value in own.items()}
            continue
        moments: dict[int, dict[str, Tensor]] = {}
        for key, value in own.items():
            i, _, moment = key.partition("/")
            moments.setdefault(int(i), {})[moment] = torch.tensor(value)
        parameters[name] = {**state, "state": moments}
    model.set_parameters(parameters)  # type: ignore[arg-type]  # a path, or what get_parameters returned
    model.num_timesteps, model._n_updates = map(int, arrays["counts"])
    if isinstance(model, SAC):
        assert model.log_ent_coef is not None
        assert model.replay_buffer is not None
        with torch.no_grad():
            model.log_ent_coef.copy_(torch.tensor(arrays["log_ent_coef"]))
        model.replay_buffer.pos = len(arrays["replay/rewards"])
        for name in _REPLAYED:
            getattr(model.replay_buffer, name)[: model.replay_buffer.pos] = arrays[f"replay/{name}"]
