"""Policy + environment (+ what rewards new states, for the online return-to-go) → traces of N episodes in lockstep.

The return-to-go that a policy is conditioned on falls by the *online ZeST score* of each new state, or by the learned
reward of each new observation, in the units of its training rewards. Ground-truth rewards are recorded; only a policy
that was trained on them gets them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from zest_rl.agents.recorded import RecordedPolicy
from zest_rl.data.provenance import DatasetRecord
from zest_rl.errors import BadInput, ZestError
from zest_rl.evaluation.environments import RunEnvironment, act_in, find_environment
from zest_rl.rewards.learned import LearnedReward
from zest_rl.rewards.state_scorer import StateScorer
from zest_rl.types import FloatArray

if TYPE_CHECKING:
    from zest_rl.agents import Policy

Rtg = Literal["online", "constant", "schedule"]
"""How the return-to-go falls: by the online ZeST score, not at all, or as in the best training episode."""
Traces = dict[str, NDArray[Any]]


def uses_online_scores(policy: Policy | RecordedPolicy, rtg: Rtg) -> bool:
    """Whether each new state must be scored while the policy acts."""
    return policy.uses_return and rtg == "online" and not _record(policy).has_recorded_rewards


def run_episodes(
    policy: Policy,
    seeds: range,
    *,
    environment: RunEnvironment | None = None,
    rtg: Rtg = "online",
    target_return: float | None = None,
    scorer: StateScorer | None = None,
    reward: LearnedReward | None = None,
) -> Traces:
    """Run one episode per seed.

    Args:
        policy: acts on all episodes at once.
        seeds: of the environments' resets.
        environment: None: that of the policy's dataset.
        rtg: how the return-to-go falls. With ``"online"``, a policy trained on ground-truth rewards gets those, the
            upper bound of the comparison.
        target_return: the return that a policy is asked for, if it uses returns.
        scorer: scores each new state; needed for ``rtg="online"`` with ZeST rewards.
        reward: in its place, a learned reward of observations, for a policy that was trained on it.

    Returns:
        gt_reward (N, T+1) float32; gt_success (N, T+1) bool where the environment tells it; the parts of the state that
        `RunEnvironment` names (N, T+1, n), such as qpos; score (N, T+1) if scored; outside the kitchen n_steps (N,)
        int64, after which an episode ended: rewards and scores are 0 from there, states repeat; and the results of
        `Policy.end`.

    Raises:
        BadInput: as `find_environment`, or the policy needs scores and there is no scorer.
    """
    if scorer is None and reward is None and uses_online_scores(policy, rtg):
        raise BadInput(
            "the policy was not trained on rewards of the environment, so rtg 'online' needs a scorer; give it, or use "
            "'constant'"
        )
    relabel = _record(policy).relabel
    environment = find_environment(policy.meta) if environment is None else environment
    envs = [environment.make() for _ in seeds]
    resets = [env.reset(seed=seed) for env, seed in zip(envs, seeds, strict=True)]
    observations = [first for first, _ in resets]
    trace = _first_frames(
        [environment.tell(env, None, info) for env, (_, info) in zip(envs, resets, strict=True)],
        environment.horizon + 1,
    )
    scores = list[FloatArray]()
    if reward is not None:
        scores.append(reward.of_obs(environment.flatten(observations)))
    elif scorer is not None:
        views = scorer.embedder.views
        starts = np.stack([views.read(env.unwrapped, None) for env in envs])
        scores.append(scorer.score_now(starts, starts))
    n_steps = np.full(len(envs), environment.horizon)
    try:
        policy.begin(len(envs), target_return)
        for step in range(environment.horizon):
            running, rewards = np.flatnonzero(n_steps > step), np.zeros(len(envs), np.float32)
            if len(running):
                actions = act_in(envs[0], policy.act(environment.flatten(observations)))
            for i in running.tolist():
                try:
                    observations[i], rewards[i], terminated, truncated, info = envs[i].step(actions[i])
                except ZestError:
                    raise
                except Exception as error:  # whatever an environment raises
                    raise ZestError(
                        f"{environment.name} failed in step {step + 1} from seed {seeds[i]} ({type(error).__name__}: "
                        f"{error}); mend it, or choose another --seed"
                    ) from error
                for name, part in environment.tell(envs[i], float(rewards[i]), info).items():
                    trace[name][i, step + 1] = part
                if terminated or truncated:
                    n_steps[i] = step + 1
            if scores:
                scores.append(np.zeros(len(envs), np.float32))
                if reward is not None and len(running):
                    scores[-1][running] = reward.of_obs(environment.flatten([observations[i] for i in running]))
                elif scorer is not None and len(running):
                    states = np.stack([views.read(envs[i].unwrapped, starts[i]) for i in running])
                    scores[-1][running] = scorer.score_now(starts[running], states)
                difference = relabel is not None and relabel.reward == "difference"
                rewards = scores[-1] - scores[-2] if difference else scores[-1]
            if policy.uses_return and len(running):
                policy.observe(_decrement(policy, rtg, step, rewards))
    finally:
        results_of_policy = policy.end()
        for env in envs:
            env.close()
    for i, end in enumerate(n_steps):
        for name, part in trace.items():
            part[i, end + 1 :] = part[i, end] * (not name.startswith("gt_"))
    arrays = trace | results_of_policy
    if scores:
        arrays["score"] = np.stack(scores, axis=1)
    return arrays if environment.is_kitchen else arrays | {"n_steps": n_steps}


def _record(policy: Policy | RecordedPolicy) -> DatasetRecord:
    return DatasetRecord.of_run(policy.meta)


def _first_frames(told: list[dict[str, Any]], n_frames: int) -> Traces:
    """Return room for `n_frames` of N episodes, (N, n_frames, …) by name, with what is told of the first one."""
    trace = {}
    for name in told[0]:
        first = np.stack([row[name] for row in told])
        trace[name] = np.empty((len(told), n_frames, *first.shape[1:]), first.dtype)
        trace[name][:, 0] = first
    return trace


def _decrement(policy: Policy, rtg: Rtg, step: int, rewards: FloatArray) -> FloatArray:
    """Return by how much the return-to-go of each episode falls after `step`: (N,)."""
    if rtg == "constant":
        return np.zeros_like(rewards)
    if rtg == "schedule":
        schedule = np.asarray(policy.meta["rtg_schedule"], dtype=np.float32)
        return np.full_like(rewards, schedule[step] - schedule[step + 1] if step + 1 < len(schedule) else 0.0)
    return rewards
