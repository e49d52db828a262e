"""Policy + environment (+ scorer for the online return-to-go) → episode results. Imports no training.

Episodes run in lockstep within a part, one part per core at a time; every policy meets the same starts (paired
seeds). The Decision Transformer's return-to-go falls by the *online ZeST score* of each new state, in the units of the
rewards it was trained on. Ground-truth rewards are recorded, and shown to no policy but one that was trained on them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import gymnasium
import numpy as np
from numpy.typing import NDArray

from zest_rl.agents import Policy, load_policy
from zest_rl.data.env_specs import check_env_spec, check_registered
from zest_rl.data.provenance import DatasetRecord
from zest_rl.errors import BadInput, nearest
from zest_rl.kitchen.env import ENV_ID
from zest_rl.metrics.statistics import bootstrap, iqm, normalized_return, wilson
from zest_rl.rewards.relabel import SCORER_FILE, Reward
from zest_rl.rewards.state_scorer import StateScorer
from zest_rl.runtime import artifacts
from zest_rl.runtime.parallel import cached_jobs, chunks, one_thread, read_parts
from zest_rl.types import EpisodeResult

Rtg = Literal["online", "constant", "schedule"]
EPISODES_PER_JOB, N_JOBS = 5, 10
"""An evaluation is cut into `N_JOBS` parts of at least so many episodes: small enough that all cores have work and a
cut evaluation loses little, large enough that a policy acts on a batch."""
Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class EvaluationConfig:
    """What is run. Two evaluations with equal seeds start from equal states."""

    n_episodes: int = 50
    seed: int = 1_000_000
    """Episode i resets the environment with seed + i; datasets use other seeds."""
    rtg: Rtg = "online"
    """How the return-to-go falls: by the online ZeST score, not at all, or as in the best training episode."""
    target_quantile: float = 1.0
    """The target return is this quantile of the training returns: a rule fixed before evaluation."""

    @property
    def starts(self) -> range:
        """The seeds of the environment's resets, one per episode."""
        return range(self.seed, self.seed + self.n_episodes)

    def __post_init__(self) -> None:
        problems = []
        if self.n_episodes < 1:
            problems.append(f"n_episodes must be at least 1, got {self.n_episodes}")
        if self.seed < 0:
            problems.append(f"seed must be at least 0, got {self.seed}")
        if self.rtg not in get_args(Rtg):
            problems.append(f"unknown rtg {self.rtg!r}; {nearest(self.rtg, get_args(Rtg))}")
        if not 0 <= self.target_quantile <= 1:
            problems.append(f"target_quantile must be in [0, 1], got {self.target_quantile}")
        if problems:
            raise BadInput("; ".join(problems))


@dataclass(frozen=True)
class Evaluation:
    """The result for one trained policy."""

    run: Path
    config: EvaluationConfig
    target_return: float | None
    """Return that the policy was asked for; None for policies without one."""
    minimum: float
    expert: float
    """Ground-truth returns that are 0 % and 100 %."""
    episodes: tuple[EpisodeResult, ...]
    traces: Arrays
    """gt_reward (N, T+1), qpos (N, T+1, nq), score (N, T+1) when scored online, and of a policy from elsewhere clipped
    (N,), the number of actions that left [-1, 1]."""

    def normalized(self) -> NDArray[np.float64]:
        """Normalized return of each episode, in percent: (N,)."""
        return normalized_return(np.array([e.gt_return for e in self.episodes]), self.minimum, self.expert)

    def summary(self) -> dict[str, Any]:
        """JSON-ready: mean with its interval, IQM, success rate; from elsewhere, the share of clipped actions."""
        values = self.normalized()
        success = wilson(sum(e.success for e in self.episodes), len(self.episodes))
        return {
            "normalized_return": asdict(bootstrap([values])),
            "iqm": float(iqm(values)),
            "success": asdict(success),
            "n_episodes": len(self.episodes),
            "target_return": self.target_return,
            **({"clipped_actions": self._clipped_share()} if "clipped" in self.traces else {}),
        }

    def _clipped_share(self) -> float:
        return float(self.traces["clipped"].sum() / sum(episode.n_steps for episode in self.episodes))


def target_return(policy: Policy, config: EvaluationConfig) -> float | None:
    """Return what a return-conditioned policy is asked for: a quantile of its training returns; else None."""
    if not policy.uses_return:
        return None
    quantiles = np.asarray(policy.meta["return_quantiles"], dtype=np.float64)
    return float(np.interp(config.target_quantile, np.linspace(0, 1, len(quantiles)), quantiles))


def uses_online_scores(policy: Policy, config: EvaluationConfig) -> bool:
    """Whether each new state has to be scored while the policy acts."""
    return policy.uses_return and config.rtg == "online" and _reward_kind(policy) is not None


def _reward_kind(policy: Policy) -> Reward | None:
    """How the rewards that the policy was trained on follow from scores; None when they are not ZeST scores."""
    relabel = DatasetRecord.from_description(policy.meta["dataset"]).relabel
    return None if relabel is None else relabel.reward


def rollout(
    policy: Policy, env_spec: str, seeds: range, config: EvaluationConfig, scorer: StateScorer | None = None
) -> Arrays:
    """Run one episode per seed, in lockstep.

    Args:
        policy: acts on all episodes at once.
        env_spec: Gymnasium EnvSpec as JSON.
        seeds: of the environments' resets.
        config: how the return-to-go falls.
        scorer: scores each new state; needed for ``rtg="online"`` with ZeST rewards.

    Returns:
        gt_reward (N, T+1) float32, gt_success (N, T+1) bool, qpos (N, T+1, nq), score (N, T+1) if scored, and what
        the policy tells of its episodes at their end.

    With ``rtg="online"`` the return-to-go of a policy that was trained on ground-truth rewards falls by those: the
    upper bound of the comparison.

    Raises:
        BadInput: the environment is not the kitchen, or the policy needs scores and there is no scorer.
    """
    if scorer is None and uses_online_scores(policy, config):
        raise BadInput(
            "the policy was trained on ZeST scores, so rtg 'online' needs a scorer; give it, or use 'constant'"
        )
    spec = _kitchen_spec(env_spec)
    horizon = spec.max_episode_steps
    assert horizon is not None
    envs = [gymnasium.make(spec) for _ in seeds]
    resets = [env.reset(seed=seed) for env, seed in zip(envs, seeds, strict=True)]
    obs = np.stack([o for o, _ in resets])
    infos = [info for _, info in resets]
    trace: dict[str, list[Any]] = {"gt_reward": [], "gt_success": [], "qpos": []}
    first = np.stack([info["state"]["qpos"] for info in infos])
    scores = [scorer.score_now(first, first)] if scorer is not None else []

    def record() -> None:
        trace["gt_reward"].append(np.array([info["gt"]["reward"] for info in infos]))
        trace["gt_success"].append(np.array([info["gt"]["success"] for info in infos]))
        trace["qpos"].append(np.stack([info["state"]["qpos"] for info in infos]))

    record()
    try:
        policy.begin(len(envs), target_return(policy, config))
        for step in range(horizon):
            actions = policy.act(obs)
            results = [env.step(action) for env, action in zip(envs, actions, strict=True)]
            obs = np.stack([result[0] for result in results])
            rewards = np.array([result[1] for result in results], dtype=np.float32)
            infos = [result[4] for result in results]
            record()
            if scorer is not None:
                scores.append(scorer.score_now(first, trace["qpos"][-1]))
                level = _reward_kind(policy) != "difference"
                rewards = scores[-1] if level else scores[-1] - scores[-2]
            if policy.uses_return:
                policy.observe(_decrement(policy, config, step, rewards))
    finally:
        told = policy.end()
        for env in envs:
            env.close()
    arrays = {name: np.stack(values, axis=1) for name, values in trace.items()} | told
    if scorer is not None:
        arrays["score"] = np.stack(scores, axis=1)
    return arrays


def _kitchen_spec(env_spec: str) -> gymnasium.envs.registration.EnvSpec:
    """Read the EnvSpec of a run; the run may come from somebody else, so it must not run code of its choice."""
    check_env_spec(env_spec, "the environment of the run", "evaluate a run on a dataset of the kitchen")
    spec = gymnasium.envs.registration.EnvSpec.from_json(env_spec)
    if spec.id != ENV_ID or spec.max_episode_steps is None:
        raise BadInput(
            f"evaluation needs {ENV_ID} with a horizon, got {spec.id} with max_episode_steps {spec.max_episode_steps}; "
            "train on a dataset of `zest collect`"
        )
    check_registered(spec)
    return spec


def is_evaluable(dataset: Mapping[str, Any]) -> bool:
    """Whether a run's dataset (`zest_rl.data.reader.Dataset.describe`) is of the environment that `evaluate` runs."""
    record = DatasetRecord.from_description(dataset)
    return not record.is_foreign or record.env.get("id") == ENV_ID


def _decrement(
    policy: Policy, config: EvaluationConfig, step: int, rewards: NDArray[np.float32]
) -> NDArray[np.float32]:
    """By how much the return-to-go of each episode falls after `step`."""
    if config.rtg == "constant":
        return np.zeros_like(rewards)
    if config.rtg == "schedule":
        schedule = np.asarray(policy.meta["rtg_schedule"], dtype=np.float32)
        return np.full_like(rewards, schedule[step] - schedule[step + 1] if step + 1 < len(schedule) else 0.0)
    return rewards


@functools.lru_cache(maxsize=2)
def _scorer(path: Path, sha256: str) -> StateScorer:
    """Load a scorer once per process; `sha256` tells a changed file apart."""
    return StateScorer.load(path, n_workers=1)


def _evaluate_part(job: tuple[Path, EvaluationConfig, range, bool, str]) -> Arrays:
    run, config, seeds, scored, device = job
    policy = load_policy(run, device=device)
    scorer = _scorer(run / SCORER_FILE, artifacts.hash_file(run / SCORER_FILE)) if scored else None
    with one_thread():
        arrays = rollout(policy, policy.meta["dataset"]["env_spec"], seeds, config, scorer)
    if scorer is not None:
        scorer.flush()
    return arrays


def evaluate(
    run: Path,
    config: EvaluationConfig,
    *,
    score: bool = False,
    device: str = "cpu",
    n_workers: int | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> Evaluation:
    """Evaluate the policy that a run ended with; finished parts are kept, so a cut evaluation goes on where it stopped.

    Args:
        run: folder that `zest_rl.training` left.
        config: seeds and return-to-go.
        score: also record ZeST scores where the policy does not need them.
        device: where the policy runs.
        n_workers: number of processes, default one per core.
        on_progress: called with the number of episodes that were finished.

    Raises:
        BadInput: the run was not trained to its end, is of another robot than the kitchen's, or has no scorer although
            scores are asked for.
        ZestError: a part of the run is damaged.
    """
    check_finished(run)
    run = run.resolve()
    policy = load_policy(run, device=device)
    dataset = policy.meta["dataset"]
    if not is_evaluable(dataset):
        dataset_id = dataset["id"]
        raise BadInput(
            f"`zest evaluate` runs {ENV_ID} alone, and {run.name} was trained on {dataset_id}; act with it from Python "
            f"(zest_rl.agents.load_policy), or hand the data to other code: zest export {dataset_id}"
        )
    scored = score or uses_online_scores(policy, config)
    if scored and not (run / SCORER_FILE).exists():
        reason = (
            "its frames are from elsewhere, so scores cannot be made online; use --rtg constant"
            if DatasetRecord.from_description(dataset).is_foreign
            else "it was not trained on a relabeled dataset; use --rtg constant, or train on what `zest relabel` writes"
        )
        raise BadInput(f"scores are needed, but {run.name} has no {SCORER_FILE}: {reason}")
    folder = evaluation_folder(run, config)
    jobs = {}
    for part in chunks(config.n_episodes, max(EPISODES_PER_JOB, config.n_episodes // N_JOBS)):
        seeds = range(config.seed + part.start, config.seed + part.stop)
        jobs[f"seeds-{seeds.start}-{seeds.stop}{'-scored' if scored else ''}"] = (run, config, seeds, scored, device)
    for name in cached_jobs(_evaluate_part, jobs, folder / "parts", n_workers=n_workers):
        if on_progress is not None:
            on_progress(len(jobs[name][2]))
    traces = read_parts(folder / "parts", jobs)
    dataset = policy.meta["dataset"]
    result = Evaluation(
        run,
        config,
        target_return(policy, config),
        dataset["ref_min_score"],
        dataset["ref_max_score"],
        _episode_results(traces, config),
        traces,
    )
    artifacts.write_json(
        folder / "result.json",
        {
            "config": asdict(config),
            "agent": policy.agent,
            "references": {"minimum": result.minimum, "expert": result.expert},
            "summary": result.summary(),
            "episodes": [asdict(episode) for episode in result.episodes],
            "parts": list(jobs),
            "provenance": artifacts.provenance(),
        },
    )
    return result


def check_finished(run: Path) -> None:
    """Refuse what is not the folder of a finished training.

    Raises:
        BadInput: it is not; the message says whether there is an unfinished one.
    """
    if not (run / "meta.json").exists():
        raise BadInput(
            f"the training in {run} is not finished; type its `zest train` command again to go on"
            if (run / "run.json").exists()
            else f"{run} is not the folder of a training; give a folder that `zest train` or `zest adopt` left"
        )


def read_evaluation(folder: Path) -> Evaluation:
    """Read what `evaluate` left in ``RUN/evaluations/NAME``.

    Raises:
        ZestError: there is no result, or a part is damaged; evaluate again.
    """
    result = artifacts.read_json(folder / "result.json")
    config = EvaluationConfig(**result["config"])
    return Evaluation(
        folder.parent.parent,
        config,
        result["summary"]["target_return"],
        result["references"]["minimum"],
        result["references"]["expert"],
        tuple(EpisodeResult(**episode) for episode in result["episodes"]),
        read_parts(folder / "parts", result["parts"]),
    )


def evaluation_folder(run: Path, config: EvaluationConfig) -> Path:
    """Where `evaluate` leaves its parts, ``result.json`` and videos."""
    return run / "evaluations" / artifacts.hash_json(asdict(config))[:8]


def _episode_results(traces: Arrays, config: EvaluationConfig) -> tuple[EpisodeResult, ...]:
    n_episodes, n_frames = traces["gt_reward"].shape
    return tuple(
        EpisodeResult(
            seed=config.seed + i,
            gt_return=float(traces["gt_reward"][i, 1:].sum(dtype=np.float64)),
            success=bool(traces["gt_success"][i].any()),
            n_steps=n_frames - 1,
            zest_return=float(traces["score"][i, 1:].sum(dtype=np.float64)) if "score" in traces else None,
        )
        for i in range(n_episodes)
    )
