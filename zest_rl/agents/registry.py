"""The algorithms by name, and the policies that they and other programs trained, by the folders of their runs."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from torch.overrides import TorchFunctionMode

from zest_rl.agents import bc, dt, foreign, online, rvs, trex
from zest_rl.agents.base import Agent, DataFacts, Policy, ready_to_act
from zest_rl.agents.configs import FOREIGN, config_of
from zest_rl.agents.recorded import recorded_policy
from zest_rl.embedders import find_device
from zest_rl.runtime.artifacts import read_json
from zest_rl.runtime.hub import local_run
from zest_rl.runtime.records import from_json, reading_record
from zest_rl.runtime.trust import remember

AGENTS: dict[str, Agent[Any] | online.OnlineAgent] = {
    "bc": bc.AGENT,
    "dt": dt.AGENT,
    "rvs": rvs.AGENT,
    "trex": trex.AGENT,
    "sac": online.SAC,
    "ppo": online.PPO,
    "trpo": online.TRPO,
}


def get_agent(name: str) -> Agent[Any] | online.OnlineAgent:
    """Return the agent called `name`.

    Raises:
        BadInput: there is no such agent; the message names the nearest ones.
    """
    config_of(name)
    return AGENTS[name]


def load_policy(run_dir: str | Path, device: str = "cpu", *, trust: bool = False) -> Policy:
    """Return the policy of a finished run; it acts in the precision it was trained in.

    Args:
        run_dir: the run's folder, or ``hf://OWNER/NAME`` (`zest_rl.runtime.hub.local_run`).
        device: where the policy runs: "cpu", "cuda", "cuda:1", "mps", "auto" (CUDA where there is one, else the CPU).
        trust: run a foreign policy that was not adopted on this machine, now and from now on.

    Raises:
        ZestError: the run is not finished, or its weights differ from those that ``meta.json`` names.
        BadInput: there is no such device, ``meta.json`` is not as this package writes it, its agent is unknown here, or
            a foreign policy is not trusted or cannot be read.
    """
    run_dir = local_run(run_dir)
    place, path = find_device(device), run_dir / "meta.json"
    meta: dict[str, Any] = read_json(path)
    with reading_record(path):
        is_foreign = meta["agent"] == FOREIGN
        if is_foreign and trust:
            remember("policy", meta["policy"])
    return foreign.load(run_dir, meta, place) if is_foreign else _load(run_dir, place)


class _NoInitialWeights(TorchFunctionMode):
    """Leaves out the drawing of weights, for which torch imports its compiler where the device is ``meta``."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Do nothing in place of a function that draws, whose result is not used."""
        return None if getattr(func, "__module__", "") == "torch.nn.init" else func(*args, **(kwargs or {}))


def _load(run_dir: Path, device: torch.device) -> Policy:
    recorded = recorded_policy(run_dir)
    meta, config, agent = recorded.meta, recorded.config, get_agent(recorded.agent)
    with reading_record(run_dir / "meta.json"), torch.random.fork_rng(devices=[]):  # initial weights are replaced
        facts = from_json(DataFacts, {field.name: meta[field.name] for field in fields(DataFacts)})
        tensors = safetensors.torch.load(recorded.weights)
        with torch.device("meta"), _NoInitialWeights():  # makes no room yet
            shapes = {name: tensor.shape for name, tensor in agent.networks(config, facts).state_dict().items()}
        if shapes != {name: tensor.shape for name, tensor in tensors.items()}:
            raise ValueError("its config is not that of model.safetensors")
        model = agent.networks(config, facts)
        model.load_state_dict(tensors)
    model = ready_to_act(model.to(device).eval(), meta["precision"])
    with reading_record(run_dir / "meta.json"):
        return agent.policy(model, config, facts, meta, device)
