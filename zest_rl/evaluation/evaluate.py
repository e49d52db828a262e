"""A run → the returns and successes of its policy, written to and read from the run's folder.

All policies get the same starts (paired seeds). Episodes run in parts, one part per core at a time.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import NDArray

from zest_rl.agents.configs import CONFIGS
from zest_rl.agents.recorded import RecordedPolicy, recorded_policy
from zest_rl.data.provenance import DatasetRecord
from zest_rl.errors import BadInput, Notice, nearest
from zest_rl.evaluation.environments import KITCHEN, MAX_HORIZON, RunEnvironment, find_environment
from zest_rl.evaluation.online import check_online, load_online
from zest_rl.evaluation.rollout import Rtg, Traces, run_episodes, uses_online_scores
from zest_rl.evaluation.videos import episode_video
from zest_rl.kitchen.scene import N_QPOS
from zest_rl.metrics.statistics import bootstrap, iqm, normalized_return, representative, wilson
from zest_rl.runtime import artifacts
from zest_rl.runtime.hub import local_run
from zest_rl.runtime.parallel import cached_jobs, chunks, one_thread, read_parts
from zest_rl.runtime.records import from_json, reading_record
from zest_rl.simulation.videos import Video, ensure_videos
from zest_rl.types import EpisodeResult

if TYPE_CHECKING:
    from zest_rl.agents import Policy

EPISODES_PER_JOB, N_JOBS = 5, 10
"""An evaluation is split into `N_JOBS` parts of at least `EPISODES_PER_JOB` episodes: small enough that all cores have
work and an interrupted evaluation loses little, large enough that a policy acts on a batch."""
MAX_EPISODES = 10_000
"""Of an evaluation; a part holds one environment for each of its episodes in memory."""
_REFERENCES = ("minimum", "expert")


@dataclass(frozen=True)
class EvaluationConfig:
    """Which episodes are run. Two evaluations with equal seeds start from equal states."""

    n_episodes: int = 50
    seed: int = 1_000_000
    """Episode i resets the environment with seed + i; datasets use other seeds."""
    rtg: Rtg = "online"
    """How the return-to-go falls: online, constant or schedule (`Rtg`)."""
    target_quantile: float = 1.0
    """The target return is this quantile of the training returns: a rule fixed before evaluation."""
    env: str | None = None
    """``package.module:make``, a function that makes the environment; None: the dataset names it."""
    horizon: int | None = None
    """Steps of an episode; None: those of the dataset's longest, or as registered where these are unknown."""
    success_key: str | None = None
    """Of success in ``info``; None: success or is_success."""

    def to_json(self) -> dict[str, Any]:
        """Return the fields; those that are None, which earlier versions did not have, are left out."""
        return {name: value for name, value in asdict(self).items() if value is not None}

    @property
    def starts(self) -> range:
        """The seeds of the environment's resets, one per episode."""
        return range(self.seed, self.seed + self.n_episodes)

    def __post_init__(self) -> None:
        problems = []
        if self.n_episodes < 1:
            problems.append(f"n_episodes must be at least 1, got {self.n_episodes}")
        if self.n_episodes > MAX_EPISODES:
            problems.append(f"n_episodes must be at most {MAX_EPISODES}, got {self.n_episodes}")
        if self.seed < 0:
            problems.append(f"seed must be at least 0, got {self.seed}")
        if self.rtg not in get_args(Rtg):
            problems.append(f"unknown rtg {self.rtg!r}; {nearest(self.rtg, get_args(Rtg))}")
        if not 0 <= self.target_quantile <= 1:
            problems.append(f"target_quantile must be in [0, 1], got {self.target_quantile}")
        if self.horizon is not None and not 1 <= self.horizon <= MAX_HORIZON:
            problems.append(
                f"horizon must be 1 to {MAX_HORIZON} steps, got {self.horizon}; leave it out for that of the dataset"
            )
        if problems:
            raise BadInput("; ".join(problems))


@dataclass(frozen=True)
class Evaluation:
    """The result for one trained policy."""

    run: Path
    config: EvaluationConfig
    target_return: float | None
    """Return that the policy was asked for; None for policies without one."""
    minimum: float | None
    expert: float | None
    """Ground-truth returns that count as 0 % and 100 %; None where the dataset has no such references."""
    episodes: tuple[EpisodeResult, ...] = field(repr=False)
    traces: Traces = field(repr=False)
    """What `run_episodes` returns, and of a foreign policy clipped (N,), the number of actions that left [-1, 1]."""
    environment: RunEnvironment

    @property
    def folder(self) -> Path:
        """Folder of the result and the videos."""
        return evaluation_folder(self.run, self.config)

    @property
    def is_normalized(self) -> bool:
        """Whether the dataset has the references of normalized returns."""
        return self.minimum is not None

    def returns(self) -> NDArray[np.float64]:
        """Normalized return of each episode, in percent; without references, the sum of its rewards: (N,)."""
        sums = np.array([e.gt_return for e in self.episodes])
        return (
            sums if self.minimum is None or self.expert is None else normalized_return(sums, self.minimum, self.expert)
        )

    def summary(self) -> dict[str, Any]:
        """Return as JSON mean with interval, IQM, success rate; of a foreign policy, the share of clipped actions.

        The mean goes by ``normalized_return``, or ``return`` without references; success is left out where no
        environment tells it.
        """
        values = self.returns()
        successes = [e.success for e in self.episodes if e.success is not None]
        n_steps = [e.n_steps for e in self.episodes]
        summary: dict[str, Any] = {
            "normalized_return" if self.is_normalized else "return": asdict(bootstrap([values])),
            "iqm": float(iqm(values)),
        }
        if successes:
            summary["success"] = asdict(wilson(sum(successes), len(successes)))
        summary |= {"n_episodes": len(self.episodes), "target_return": self.target_return}
        if not self.environment.is_kitchen:
            summary["mean_length"] = float(np.mean(n_steps))
        if "clipped" in self.traces:
            summary["clipped_actions"] = float(self.traces["clipped"].sum() / sum(n_steps))
        return summary


def target_return(policy: Policy | RecordedPolicy, config: EvaluationConfig) -> float | None:
    """Return the return that a policy is asked for, a quantile of its training returns; None if it uses no return."""
    if not policy.uses_return:
        return None
    quantiles = np.asarray(policy.meta["return_quantiles"], dtype=np.float64)
    return float(np.interp(config.target_quantile, np.linspace(0, 1, len(quantiles)), quantiles))


_Job = tuple[Path, EvaluationConfig, RunEnvironment, range, bool, str]


def _evaluate_part(job: _Job) -> Traces:
    from zest_rl.agents import load_policy

    run, config, environment, seeds, scored, device = job
    policy = load_policy(run, device=device)
    online = load_online(run, DatasetRecord.of_run(policy.meta)) if scored else {}
    with one_thread():
        arrays = run_episodes(
            policy,
            seeds,
            environment=environment,
            rtg=config.rtg,
            target_return=target_return(policy, config),
            **online,
        )
    if "scorer" in online:
        online["scorer"].flush()
    return arrays


def evaluate(
    run: str | Path,
    config: EvaluationConfig | None = None,
    *,
    score: bool = False,
    videos: bool = False,
    device: str = "cpu",
    n_workers: int | None = None,
    trust: bool = False,
    on_progress: Callable[[int], None] | None = None,
) -> Evaluation:
    """Evaluate the final policy of a run; finished parts are kept, so an interrupted evaluation goes on from there.

    Args:
        run: folder that `zest train` or `zest adopt` left, or ``hf://OWNER/NAME`` (`zest_rl.runtime.hub.local_run`).
        config: environment, seeds and return-to-go; default `EvaluationConfig()`.
        score: record ZeST scores even if the policy does not need them.
        videos: also write `episode_videos`; a `Notice` tells where they cannot be drawn.
        device: where the policy runs.
        n_workers: number of processes, default one per core.
        trust: run the policy, and load the embedder, that a run of somebody else names (`zest_rl.runtime.trust`).
        on_progress: called with the number of episodes finished since the last call.

    Raises:
        BadInput: the run is unfinished, is not trusted, or has no scorer although scores are needed; or as
            `zest_rl.evaluation.environments.find_environment`.
        ZestError: a part of the run is damaged, or its environment cannot be made here.
    """
    config = EvaluationConfig() if config is None else config
    run = local_run(run)
    check_finished(run)
    run = run.resolve()
    policy = _policy(run, device, trust, is_done=(evaluation_folder(run, config) / "result.json").exists())
    dataset = DatasetRecord.of_run(policy.meta)
    environment = find_environment(policy.meta, env=config.env, horizon=config.horizon, success_key=config.success_key)
    scored = score or uses_online_scores(policy, config.rtg)
    if scored:
        check_online(run, dataset, trust=trust)
    folder, jobs = evaluation_folder(run, config), _jobs(run, config, environment, scored, device)
    minimum, expert = _references(dataset, policy.meta, config, environment)
    with artifacts.lock(folder):
        if not environment.is_kitchen and not all((folder / "parts" / f"{name}.npz").exists() for name in jobs):
            for video in folder.glob("*.mp4"):  # of an environment that was changed since
                video.unlink()
        for name in cached_jobs(_evaluate_part, jobs, folder / "parts", n_workers=n_workers, stage="rollouts"):
            if on_progress is not None:
                on_progress(len(jobs[name][3]))
        traces = _read_traces(folder, list(jobs), config, environment)
        target, episodes = target_return(policy, config), _episode_results(traces, config)
        result = Evaluation(run, config, target, minimum, expert, episodes, traces, environment)
        _write(result, policy.agent, list(jobs))
        if videos:
            ensure_videos(episode_videos(result).values(), n_workers=n_workers)
    return result


def _policy(run: Path, device: str, trust: bool, *, is_done: bool) -> Policy | RecordedPolicy:
    """Return a policy; to see that nothing is to be done takes no torch, which is imported when a policy acts."""
    if is_done and artifacts.read_json(run / "meta.json").get("agent") in CONFIGS:
        return recorded_policy(run)
    from zest_rl.agents import load_policy

    return load_policy(run, device=device, trust=trust)


def _jobs(
    run: Path, config: EvaluationConfig, environment: RunEnvironment, scored: bool, device: str
) -> dict[str, _Job]:
    """Return the parts of an evaluation by names that tell all that their traces depend on."""
    jobs = {}
    stamp = "" if environment.is_kitchen else f"-{artifacts.hash_json(asdict(environment))[:8]}"
    for part in chunks(config.n_episodes, max(EPISODES_PER_JOB, config.n_episodes // N_JOBS)):
        seeds = range(config.seed + part.start, config.seed + part.stop)
        name = f"seeds-{seeds.start}-{seeds.stop}{'-scored' if scored else ''}{stamp}"
        jobs[name] = (run, config, environment, seeds, scored, device)
    return jobs


def _write(result: Evaluation, agent: str, parts: Sequence[str]) -> None:
    """Write ``result.json``; `read_evaluation` is the way back."""
    artifacts.write_json(
        result.folder / "result.json",
        {
            "config": result.config.to_json(),
            "agent": agent,
            "references": {"minimum": result.minimum, "expert": result.expert},
            **({} if result.environment.is_kitchen else {"environment": asdict(result.environment)}),
            "summary": result.summary(),
            "episodes": [asdict(episode) for episode in result.episodes],
            "parts": list(parts),
            "provenance": artifacts.provenance(),
        },
    )


def _references(
    dataset: DatasetRecord, meta: Mapping[str, Any], config: EvaluationConfig, environment: RunEnvironment
) -> tuple[float | None, float | None]:
    """Return the returns that are 0 and 100 %, sums over as many steps as the dataset's; None without any."""
    if dataset.ref_min_score is None or dataset.ref_max_score is None:
        return None, None
    n_steps = meta.get("max_steps")
    same = config.horizon is None if environment.is_kitchen else n_steps in (None, environment.horizon)
    if same or config.horizon == n_steps:
        return dataset.ref_min_score, dataset.ref_max_score
    warnings.warn(
        f"returns over {environment.horizon} steps are not normalized: the references of {dataset.id} are of "
        f"{n_steps} steps",
        Notice,
        stacklevel=3,
    )
    return None, None


def check_finished(run: Path) -> None:
    """Check that a folder holds a finished run.

    Raises:
        BadInput: it does not; the message says whether it holds an unfinished one.
    """
    if not (run / "meta.json").exists():
        raise BadInput(
            f"the training in {run} is not finished; type its `zest train` command again to go on"
            if (run / "run.json").exists()
            else f"{run} is not the folder of a training; give a folder that `zest train` or `zest adopt` left"
        )


def read_evaluation(folder: Path) -> Evaluation:
    """Read the result of `evaluate` from ``RUN/evaluations/NAME``.

    Raises:
        BadInput: the result is not as this package writes it, or its episodes are not those of its parts.
        ZestError: there is no result, or a part is damaged; evaluate again.
    """
    path = folder / "result.json"
    result = artifacts.read_json(path)
    with reading_record(path):
        config = from_json(EvaluationConfig, result["config"])
        episodes = tuple(from_json(EpisodeResult, episode) for episode in result["episodes"])
        target, references = result["summary"]["target_return"], result["references"]
        target = None if target is None else float(target)
        minimum, expert = (None if references[name] is None else float(references[name]) for name in _REFERENCES)
        is_scale = minimum is expert is None or (
            minimum is not None and expert is not None and -math.inf < minimum < expert < math.inf
        )
        if len(episodes) != config.n_episodes or not is_scale:
            raise ValueError(f"{len(episodes)} episodes, returns of {minimum} to {expert}")
        environment = from_json(RunEnvironment, result["environment"]) if "environment" in result else KITCHEN
        traces = _read_traces(folder, [Path(name).name for name in result["parts"]], config, environment)
        told, seen = map(_numbers, (episodes, _episode_results(traces, config)))
        if not np.allclose(told, seen, rtol=1e-9, equal_nan=True):
            raise ValueError("its episodes are not those of its parts")
    return Evaluation(folder.parent.parent, config, target, minimum, expert, episodes, traces, environment)


def evaluation_folder(run: Path, config: EvaluationConfig) -> Path:
    """Return the folder of the parts, ``result.json`` and videos of `evaluate`."""
    return run / "evaluations" / artifacts.hash_json(config.to_json())[:8]


def episode_videos(evaluation: Evaluation) -> dict[str, Video]:
    """Return the videos of the best, the median and the worst episode, which need not be written yet.

    Empty where the environment cannot be drawn; a `Notice` says why.
    """
    chosen = {
        which: episode_video(evaluation.environment, evaluation.traces, index, evaluation.folder / f"{which}.mp4")
        for which, index in representative(evaluation.returns()).items()
    }
    return {which: video for which, video in chosen.items() if video is not None}


def _read_traces(folder: Path, parts: Sequence[str], config: EvaluationConfig, environment: RunEnvironment) -> Traces:
    """Read the parts of an evaluation, which may be somebody else's."""
    with reading_record(folder / "parts", "delete this folder and evaluate again"):
        traces = read_parts(folder / "parts", parts)
        n, n_frames = config.n_episodes, traces["gt_reward"].shape[1]
        layout: dict[str, tuple[type[Any], tuple[int | None, ...]]] = {
            "gt_reward": (np.float32, (n, n_frames)), "gt_success": (np.bool_, (n, n_frames)),
            "score": (np.float32, (n, n_frames)), "clipped": (np.int64, (n,)), "n_steps": (np.int64, (n,)),
        }  # fmt: skip
        width = N_QPOS if environment.is_kitchen else None
        layout |= dict.fromkeys(environment.state, (np.float64, (n, n_frames, width)))
        told = () if environment.success_key is None else ("gt_success",)
        required = ("gt_reward", *told, *environment.state, *(() if environment.is_kitchen else ("n_steps",)))
        for name in (*required, *traces):
            array, (dtype, shape) = traces[name], layout[name]
            fits = len(array.shape) == len(shape) and all(
                want in (None, got) for want, got in zip(shape, array.shape, strict=True)
            )
            if not fits or array.dtype != dtype or n_frames < 2 or not np.isfinite(array).all():
                raise ValueError(f"{name} must be finite {np.dtype(dtype)} {shape}, got {array.dtype} {array.shape}")
        if "n_steps" in traces and not ((traces["n_steps"] >= 1) & (traces["n_steps"] < n_frames)).all():
            raise ValueError(f"n_steps must be 1 to {n_frames - 1}")
    return traces


def _numbers(episodes: Sequence[EpisodeResult]) -> NDArray[np.float64]:
    return np.array([astuple(episode) for episode in episodes], dtype=np.float64)  # None becomes NaN


def _episode_results(traces: Traces, config: EvaluationConfig) -> tuple[EpisodeResult, ...]:
    n_episodes, n_frames = traces["gt_reward"].shape
    return tuple(
        EpisodeResult(
            seed=config.seed + i,
            gt_return=float(traces["gt_reward"][i, 1:].sum(dtype=np.float64)),
            success=bool(traces["gt_success"][i].any()) if "gt_success" in traces else None,
            n_steps=int(traces["n_steps"][i]) if "n_steps" in traces else n_frames - 1,
            zest_return=float(traces["score"][i, 1:].sum(dtype=np.float64)) if "score" in traces else None,
        )
        for i in range(n_episodes)
    )
