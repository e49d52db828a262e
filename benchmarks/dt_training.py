"""Updates per second of the Decision Transformer: ours against a plain transformers loop, on one CPU thread.

Both train `transformers.DecisionTransformerModel` of the default size on the same windows, K = 20, batch 64. The plain
loop is what the documentation of transformers leads to: float32, eager attention, nn.Dropout, default AdamW. The two
take turns, update by update, so that other load on the machine meets both; CPU time is measured, and the medians
compared. Acting is timed as well: one call for 25 episodes with a full context.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn
from transformers import DecisionTransformerConfig, DecisionTransformerModel

from zest_rl.agents import dt
from zest_rl.agents.base import (
    Batch,
    DataFacts,
    Precision,
    autocast,
    describe_data,
    resolve_precision,
)
from zest_rl.types import Episode

OBS_DIM, ACT_DIM, N_STEPS, N_EPISODES = 59, 9, 100, 100  # as the kitchen's datasets
N_ACTING = 25
CPU = torch.device("cpu")
WARM_UP, N_UPDATES = 3, 20
REQUIRED_RATIO = 2.0


def random_episodes() -> list[Episode]:
    """Episodes of the kitchen's shape; the content has no influence on the speed."""
    rng = np.random.default_rng(0)
    return [
        Episode(
            rng.normal(size=(N_STEPS + 1, OBS_DIM)).astype(np.float32),
            rng.uniform(-1, 1, (N_STEPS, ACT_DIM)).astype(np.float32),
            rng.random(N_STEPS, dtype=np.float32),
            terminated=False,
        )
        for _ in range(N_EPISODES)
    ]


def make_update(
    model: nn.Module, optimizer: torch.optim.Optimizer, loss: Callable[[Batch], Tensor]
) -> Callable[[Batch], None]:
    """Return one gradient step as a function of the batch."""

    def update(batch: Batch) -> None:
        optimizer.zero_grad()
        loss(batch).backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(model.parameters(), 0.25)
        optimizer.step()

    return update


def plain_update() -> Callable[[Batch], None]:
    """Return the update of a plain transformers loop."""
    model = DecisionTransformerModel(
        DecisionTransformerConfig(
            state_dim=OBS_DIM, act_dim=ACT_DIM, max_ep_len=N_STEPS,
            attn_implementation="eager",  # type: ignore[call-arg]
        )
    ).train()  # fmt: skip

    def loss(batch: Batch) -> Tensor:
        output = model(
            states=batch["obs"], actions=batch["actions"], returns_to_go=batch["rtg"], timesteps=batch["timesteps"],
            attention_mask=batch["valid"].long(),
        )  # fmt: skip
        error: Tensor = output.action_preds[batch["valid"]] - batch["actions"][batch["valid"]]
        return error.square().mean()

    return make_update(model, torch.optim.AdamW(model.parameters(), lr=1e-4, weight_decay=1e-4), loss)


def our_update(facts: DataFacts) -> tuple[nn.Module, Callable[[Batch], None]]:
    """Return the model and the update of `zest_rl.training.loop`, in the precision that it would choose here."""
    model = dt.build_model(dt.DTConfig(), facts).train()
    precision = resolve_precision("auto", CPU)

    def loss(batch: Batch) -> Tensor:
        with autocast(precision, CPU):
            return dt.loss(model, batch)

    trained = [p for p in model.parameters() if p.requires_grad]
    return model, make_update(model, torch.optim.AdamW(trained, lr=1e-4, weight_decay=1e-4, fused=True), loss)


def time_acting(model: nn.Module, facts: DataFacts, precision: Precision) -> float:
    """Return the median CPU milliseconds of one call of the policy with a full context."""
    config = dt.DTConfig()
    policy = dt.make_policy(model.eval(), config, facts, {"precision": precision}, CPU)
    policy.begin(N_ACTING, 1.0)
    obs = np.random.default_rng(0).normal(size=(N_STEPS, N_ACTING, OBS_DIM)).astype(np.float32)
    times = []
    for step in range(config.context_len + 30):
        start = time.process_time()
        policy.act(obs[step])
        times.append(time.process_time() - start)
    return 1e3 * statistics.median(times[config.context_len :])


def run() -> dict[str, object]:
    """Return updates per CPU second of both loops, their ratio, and the CPU milliseconds of acting."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        episodes = random_episodes()
        facts = describe_data(episodes)
        sample, rng = dt.make_sampler(dt.DTConfig(), facts, episodes), np.random.default_rng(0)
        model, ours = our_update(facts)
        contestants = {"plain": plain_update(), "zest_rl": ours}
        times: dict[str, list[float]] = {name: [] for name in contestants}
        for _ in range(WARM_UP + N_UPDATES):
            batch = sample(rng)
            for name, update in contestants.items():
                start = time.process_time()
                update(batch)
                times[name].append(time.process_time() - start)
        plain, zest = (statistics.median(times[name][WARM_UP:]) for name in contestants)
        return {
            "precision": resolve_precision("auto", CPU),
            "plain_updates_per_s": round(1 / plain, 2),
            "zest_rl_updates_per_s": round(1 / zest, 2),
            "act_ms": round(time_acting(model, facts, resolve_precision("auto", CPU)), 1),
            "act_fp32_ms": round(time_acting(model, facts, "fp32"), 1),
            "ratio": round(plain / zest, 2),
            "required_ratio": REQUIRED_RATIO,
            "passed": plain / zest >= REQUIRED_RATIO,
        }
    finally:
        torch.set_num_threads(threads)
