"""Policy + environment (+ scorer for the online return-to-go) → traces of N episodes, run in lockstep.

The return-to-go that a policy is conditioned on falls by the *online ZeST score* of each new state, in the units of its
training rewards. Ground-truth rewards are recorded; only a policy that was trained on them gets them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import gymnasium
import numpy as np
from numpy.typing import NDArray

from zest_rl.agents import Policy
from zest_rl.data.env_specs import check_env_spec, check_registered
from zest_rl.data.provenance import DatasetRecord
from zest_rl.errors import BadInput
from zest_rl.kitchen.env import ENV_ID, env_spec
from zest_rl.rewards.state_scorer import StateScorer
from zest_rl.runtime.records import from_json
from zest_rl.types import FloatArray

Rtg = Literal["online", "constant", "schedule"]
"""How the return-to-go falls: by the online ZeST score, not at all, or as in the best training episode."""
Traces = dict[str, NDArray[Any]]

MAX_HORIZON = 10_000
"""Steps of an episode."""


def uses_online_scores(policy: Policy, rtg: Rtg) -> bool:
    """Whether each new state must be scored while the policy acts."""
    return policy.uses_return and rtg == "online" and _record(policy).relabel is not None


def run_episodes(
    policy: Policy,
    seeds: range,
    *,
    rtg: Rtg = "online",
    target_return: float | None = None,
    scorer: StateScorer | None = None,
) -> Traces:
    """Run one episode per seed in the environment of the policy's dataset.

    Args:
        policy: acts on all episodes at once.
        seeds: of the environments' resets.
        rtg: how the return-to-go falls. With ``"online"``, a policy trained on ground-truth rewards gets those, the
            upper bound of the comparison.
        target_return: the return that a policy is asked for, if it uses returns.
        scorer: scores each new state; needed for ``rtg="online"`` with ZeST rewards.

    Returns:
        gt_reward (N, T+1) float32, gt_success (N, T+1) bool, qpos (N, T+1, nq), score (N, T+1) if scored, and the
        results of `Policy.end`.

    Raises:
        BadInput: the environment is not the kitchen, or the policy needs scores and there is no scorer.
    """
    if scorer is None and uses_online_scores(policy, rtg):
        raise BadInput(
            "the policy was trained on ZeST scores, so rtg 'online' needs a scorer; give it, or use 'constant'"
        )
    dataset = _record(policy)
    spec = _kitchen_spec(dataset.env_spec or "")
    horizon = spec.max_episode_steps
    assert horizon is not None
    envs = [gymnasium.make(spec) for _ in seeds]
    resets = [env.reset(seed=seed) for env, seed in zip(envs, seeds, strict=True)]
    obs = np.stack([first for first, _ in resets])
    trace = [_ground_truth([info for _, info in resets])]
    first_qpos = trace[0]["qpos"]
    scores = [scorer.score_now(first_qpos, first_qpos)] if scorer is not None else []
    try:
        policy.begin(len(envs), target_return)
        for step in range(horizon):
            results = [env.step(action) for env, action in zip(envs, policy.act(obs), strict=True)]
            obs = np.stack([result[0] for result in results])
            rewards = np.array([result[1] for result in results], dtype=np.float32)
            trace.append(_ground_truth([result[4] for result in results]))
            if scorer is not None:
                scores.append(scorer.score_now(first_qpos, trace[-1]["qpos"]))
                difference = dataset.relabel is not None and dataset.relabel.reward == "difference"
                rewards = scores[-1] - scores[-2] if difference else scores[-1]
            if policy.uses_return:
                policy.observe(_decrement(policy, rtg, step, rewards))
    finally:
        results_of_policy = policy.end()
        for env in envs:
            env.close()
    arrays = {name: np.stack([step[name] for step in trace], axis=1) for name in trace[0]} | results_of_policy
    if scorer is not None:
        arrays["score"] = np.stack(scores, axis=1)
    return arrays


def _record(policy: Policy) -> DatasetRecord:
    return DatasetRecord.of_run(policy.meta)


@dataclass(frozen=True)
class _Arguments:
    """Of `KitchenEnv`."""

    task: str = "micro"
    init_noise: float = 0.05


def _kitchen_spec(text: str) -> gymnasium.envs.registration.EnvSpec:
    """Read the EnvSpec of a run, which may come from somebody else: task, noise and horizon are all it may choose."""
    check_env_spec(text, "the environment of the run", "evaluate a run on a dataset of the kitchen")
    try:
        spec = gymnasium.envs.registration.EnvSpec.from_json(text)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise BadInput(f"the environment of the run is not the JSON of a Gymnasium EnvSpec: {error!r}") from error
    horizon = spec.max_episode_steps
    if spec.id != ENV_ID or type(horizon) is not int or not 1 <= horizon <= MAX_HORIZON:
        raise BadInput(
            f"evaluation needs {ENV_ID} with a horizon of 1 to {MAX_HORIZON} steps, got {spec.id} with "
            f"max_episode_steps {horizon}; train on a dataset of `zest collect`"
        )
    check_registered(spec)
    try:
        arguments = from_json(_Arguments, spec.kwargs)
    except (TypeError, ValueError, OverflowError) as error:
        raise BadInput(
            f"the environment of the run takes a task and an init_noise, got {spec.kwargs!r:.200} ({error}); train on "
            "a dataset of `zest collect`"
        ) from error
    if spec.additional_wrappers:
        raise BadInput(
            f"the environment of the run is evaluated without wrappers, got {spec.additional_wrappers!r:.200}; train "
            "on a dataset that was recorded without"
        )
    return replace(env_spec(**asdict(arguments)), max_episode_steps=horizon)


def _ground_truth(infos: Sequence[Mapping[str, Any]]) -> Traces:
    """Return gt_reward (N,), gt_success (N,) and qpos (N, nq) of one time step."""
    return {
        "gt_reward": np.array([info["gt"]["reward"] for info in infos]),
        "gt_success": np.array([info["gt"]["success"] for info in infos]),
        "qpos": np.stack([info["state"]["qpos"] for info in infos]),
    }


def _decrement(policy: Policy, rtg: Rtg, step: int, rewards: FloatArray) -> FloatArray:
    """Return by how much the return-to-go of each episode falls after `step`: (N,)."""
    if rtg == "constant":
        return np.zeros_like(rewards)
    if rtg == "schedule":
        schedule = np.asarray(policy.meta["rtg_schedule"], dtype=np.float32)
        return np.full_like(rewards, schedule[step] - schedule[step + 1] if step + 1 < len(schedule) else 0.0)
    return rewards
