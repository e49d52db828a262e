"""A reward that `zest train trex` learned from ranked trajectories (`zest_rl.agents.trex`), applied to new frames.

The networks are small, so they are computed by NumPy, on any machine to the same digits up to rounding.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import safetensors.numpy

from zest_rl.data.observations import standardized
from zest_rl.data.provenance import DatasetRecord
from zest_rl.errors import BadInput
from zest_rl.runtime import artifacts
from zest_rl.runtime.hub import local_run
from zest_rl.runtime.records import reading_record
from zest_rl.types import FloatArray

Inputs = Literal["obs", "embeddings"]
"""What a reward is a function of: the observation, or the scorer's embedding of the frame, averaged over its views."""

TREX = "trex"
"""Name of the algorithm in ``meta.json``."""
Layer = tuple[FloatArray, FloatArray]
"""Weights (n_out, n_in) and biases (n_out,)."""


@dataclass(frozen=True, eq=False)
class LearnedReward:
    """An ensemble of reward networks, whose mean is the reward, in [-1, 1]."""

    meta: Mapping[str, Any]
    """The run's ``meta.json``."""
    networks: Sequence[Sequence[Layer]]
    """Linear layers of each; ReLU between them, tanh at the end."""

    @classmethod
    def load(cls, run_dir: str | Path) -> Self:
        """Read a finished run of `zest train trex`, or its copy in a dataset or a policy's run.

        Args:
            run_dir: the run's folder, or ``hf://OWNER/NAME``.

        Raises:
            BadInput: the run is not finished or holds a policy, or ``meta.json`` is not as this package writes it.
            ZestError: the weights differ from those that ``meta.json`` names.
        """
        run_dir = local_run(run_dir)
        meta_file, weights_file = run_dir / "meta.json", run_dir / "model.safetensors"
        if not meta_file.exists():
            raise BadInput(f"{run_dir} holds no learned reward; give the folder of a finished `zest train trex`")
        meta = artifacts.read_json(meta_file)
        with reading_record(meta_file):
            agent, sha256 = meta["agent"], str(meta["model_sha256"])
        if agent != TREX:
            raise BadInput(f"{run_dir} holds a policy ({agent}), no reward; give the folder of a `zest train trex`")
        data = artifacts.read_checked(weights_file, sha256, "restore it from a copy or train again into a new folder")
        with reading_record(meta_file):
            networks = _layers(safetensors.numpy.load(data))
            n_inputs = {network[0][0].shape[1] for network in networks}
            if {len(meta["obs_mean"]), len(meta["obs_std"]), *n_inputs} != {meta["obs_dim"]}:
                raise ValueError(f"its inputs are not those of {weights_file.name}")
        return cls(meta, networks)

    @property
    def record(self) -> DatasetRecord:
        """The dataset whose trajectories were ranked.

        Raises:
            BadInput: the run does not say which.
        """
        return DatasetRecord.of_run(self.meta)

    def check_fits(self, dataset: DatasetRecord) -> None:
        """Check that it is a reward of a dataset's environment and task.

        Raises:
            BadInput: it is of others.
        """
        learned, asked = _place(self.record), _place(dataset)
        if learned != asked:
            raise BadInput(
                f"this reward is of {learned}, where {self.record.id} was recorded, but {dataset.id} is of {asked}; "
                "give one that `zest train trex` learned there"
            )

    @property
    def sha256(self) -> str:
        """Hash of everything that a reward depends on besides its inputs."""
        facts = [self.meta[name] for name in ("model_sha256", "obs_mean", "obs_std")]
        return artifacts.hash_json([self.inputs, *facts])

    @property
    def inputs(self) -> Inputs:
        """What it is a function of."""
        inputs: Inputs = self.meta["config"]["inputs"]
        return inputs

    def of_obs(self, obs: FloatArray) -> FloatArray:
        """Return the rewards (N,) float32 in [-1, 1] of observations (N, obs_dim); r_t is that of o_{t+1}.

        Raises:
            BadInput: it is a reward of embeddings, or the observations are not as those it was trained on.
        """
        if self.inputs != "obs":
            raise BadInput("this reward is of embeddings, not of observations; train one with --inputs obs")
        return np.asarray(self.by_network(obs).mean(axis=0))

    def of_embeddings(self, embeddings: FloatArray) -> FloatArray:
        """Return the rewards (N,) float32 in [-1, 1] of frames' embeddings (N, V, D) in all views.

        Raises:
            BadInput: it is a reward of observations, or the embeddings are not as those it was trained on.
        """
        if self.inputs != "embeddings":
            raise BadInput("this reward is of observations, not of embeddings; train one with --inputs embeddings")
        return np.asarray(self.by_network(embeddings.mean(axis=1)).mean(axis=0))

    def by_network(self, inputs: FloatArray) -> FloatArray:
        """Return the reward of each network (n_networks, N) float32; their deviation tells how sure the mean is.

        Args:
            inputs: (N, D) observations, or embeddings averaged over views.

        Raises:
            BadInput: D is another one than in training, or a value is not finite.
        """
        n_inputs = self.meta["obs_dim"]
        if inputs.ndim != 2 or inputs.shape[1] != n_inputs:
            raise BadInput(
                f"the reward was trained on {self.inputs} of {n_inputs} numbers, got shape {inputs.shape}; it is of "
                "another environment, or of another embedder"
            )
        if not np.isfinite(inputs).all():
            raise BadInput(f"{self.inputs} must be finite, got NaN or infinity; has the simulation diverged?")
        normalized = standardized(inputs, self.meta["obs_mean"], self.meta["obs_std"])
        return np.stack([_forward(network, normalized) for network in self.networks])


def _place(record: DatasetRecord) -> str:
    """Name the environment, and the task if it has several."""
    environment = str(record.env.get("id") or record.source_id)
    return environment if record.task is None else f"task {record.task} of {environment}"


def _layers(tensors: Mapping[str, FloatArray]) -> list[list[Layer]]:
    """Return the linear layers of each network by ``[NETWORK.]LAYER.weight`` and ``….bias`` of a state dict."""
    found: dict[int, dict[int, Layer]] = {}
    for name, weight in tensors.items():
        if match := re.fullmatch(r"(?:(\d+)\.)?(\d+)\.weight", name):
            bias = tensors[name.removesuffix("weight") + "bias"]
            found.setdefault(int(match[1] or 0), {})[int(match[2])] = (weight, bias)
    networks = [[layers[i] for i in sorted(layers)] for _, layers in sorted(found.items())]
    for layers in networks:
        widths = [*(weight.shape[1] for weight, _ in layers[1:]), 1]
        if [(len(weight), *bias.shape) for weight, bias in layers] != [(width, width) for width in widths]:
            raise ValueError(f"layers of shapes {[weight.shape for weight, _ in layers]}")
    if not networks or not all(np.isfinite(tensor).all() for tensor in tensors.values()):
        raise ValueError("no networks, or weights that are not finite")
    return networks


def _forward(network: Sequence[Layer], inputs: FloatArray) -> FloatArray:
    """(N, D) → (N,)."""
    hidden = inputs
    for weight, bias in network[:-1]:
        hidden = np.maximum(hidden @ weight.T + bias, 0)
    weight, bias = network[-1]
    return np.asarray(np.tanh(hidden @ weight.T + bias)[:, 0])
