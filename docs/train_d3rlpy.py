"""Trains d3rlpy on an exported dataset and saves the policies as TorchScript, which `zest adopt` takes over.

It runs in an environment of d3rlpy's own and needs that, NumPy and torch alone; docs/foreign_policies.md has the loop::

    python train_d3rlpy.py DATASET.npz --algorithm iql --seeds 0 1 2 --n-steps 10000 --output policies

leaves ``policies/iql-seed0.pt`` and so on. Observations are normalised inside of the policy, rewards are as exported.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import d3rlpy
import numpy as np
import torch
from d3rlpy.logging import NoopAdapterFactory
from d3rlpy.preprocessing import StandardObservationScaler

ALGORITHMS = {"iql": d3rlpy.algos.IQLConfig, "td3bc": d3rlpy.algos.TD3PlusBCConfig}


def read_buffer(path: Path) -> d3rlpy.dataset.ReplayBuffer:
    """Return the episodes of what `zest export --to npz` wrote."""
    with np.load(path) as data:
        starts = np.flatnonzero(np.diff(data["episode"], prepend=-1))
        pieces = zip(
            *(np.split(data[name], starts[1:]) for name in ("observations", "actions", "rewards", "terminals")),
            strict=True,
        )
        episodes = [
            d3rlpy.dataset.Episode(obs, actions, rewards[:, None], terminated=bool(terminals[-1]))
            for obs, actions, rewards, terminals in pieces
        ]
    return d3rlpy.dataset.ReplayBuffer(d3rlpy.dataset.InfiniteBuffer(), episodes=episodes)


def main() -> None:
    """Train one policy per seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="what `zest export --to npz` wrote")
    parser.add_argument("--algorithm", choices=ALGORITHMS, default="iql")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--n-steps", type=int, default=10_000, help="gradient steps")
    parser.add_argument("--batch-size", type=int, default=256)
    parser.add_argument("--output", type=Path, default=Path("policies"), help="folder")
    arguments = parser.parse_args()
    buffer = read_buffer(arguments.data)
    arguments.output.mkdir(parents=True, exist_ok=True)
    for seed in arguments.seeds:
        d3rlpy.seed(seed)
        config = ALGORITHMS[arguments.algorithm](
            batch_size=arguments.batch_size, observation_scaler=StandardObservationScaler()
        )
        algorithm = config.create(device="cuda:0" if torch.cuda.is_available() else "cpu:0")
        start = time.perf_counter()
        algorithm.fit(
            buffer,
            n_steps=arguments.n_steps,
            n_steps_per_epoch=min(1000, arguments.n_steps),
            logger_adapter=NoopAdapterFactory(),
            show_progress=False,
        )
        speed = arguments.n_steps / (time.perf_counter() - start)
        path = arguments.output / f"{arguments.algorithm}-seed{seed}.pt"
        algorithm.save_policy(str(path))
        algorithm.save(str(path.with_suffix(".d3")))
        print(f"{path}: {arguments.n_steps} steps, {speed:.1f} steps/s")


if __name__ == "__main__":
    main()
