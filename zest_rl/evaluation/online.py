"""What rewards new states while a policy acts: the scorer or the learned reward that its run holds."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TypedDict

from zest_rl.data.provenance import DatasetRecord
from zest_rl.errors import BadInput
from zest_rl.rewards.learned import LearnedReward
from zest_rl.rewards.scorer import SCORER_FILE, check_scorer
from zest_rl.rewards.state_scorer import StateScorer
from zest_rl.runtime import artifacts
from zest_rl.runtime.hub import REWARD_FOLDER


class RolloutReward(TypedDict, total=False):
    """One of the two, as `zest_rl.evaluation.rollout.run_episodes` takes it."""

    scorer: StateScorer
    reward: LearnedReward


def load_online(run: Path, dataset: DatasetRecord) -> RolloutReward:
    """Load what the run holds, which `check_online` accepted."""
    if _is_learned(dataset):
        return {"reward": LearnedReward.load(run / REWARD_FOLDER)}
    return {"scorer": _scorer(run / SCORER_FILE, artifacts.hash_file(run / SCORER_FILE))}


def _is_learned(dataset: DatasetRecord) -> bool:
    return dataset.relabel is not None and dataset.relabel.learned is not None


@functools.lru_cache(maxsize=2)
def _scorer(path: Path, sha256: str) -> StateScorer:
    """Load a scorer once per process; a changed file has another `sha256`."""
    return StateScorer.load(path, n_workers=1)


def check_online(run: Path, dataset: DatasetRecord, *, trust: bool = False) -> None:
    """Check that new states can be rewarded as those of the dataset were, without loading an embedder.

    Args:
        run: folder of the run.
        dataset: that it was trained on.
        trust: as in `check_scorer`.

    Raises:
        BadInput: they cannot.
        ZestError: a file is missing or damaged.
    """
    if _is_learned(dataset):
        if LearnedReward.load(run / REWARD_FOLDER).inputs != "obs":
            raise BadInput(
                f"the rewards of {run.name} were learned of embeddings, which are not made online; use --rtg constant "
                "or schedule, or learn the reward by `zest train trex --inputs obs`"
            )
        return
    if (run / SCORER_FILE).exists():
        check_scorer(run / SCORER_FILE, trust=trust)
        return
    reason = "it was not trained on a relabeled dataset; use --rtg constant, or train on what `zest relabel` writes"
    if dataset.is_foreign:
        reason = (
            "its frames are from elsewhere, so scores cannot be made online; use --rtg schedule or constant "
            "(recorded states, relabeled without --frames and --camera, could be scored)"
        )
    if dataset.given is not None:
        reason = (
            f"its rewards ({dataset.given.label}) were given as numbers, and new states have none; use --rtg "
            "schedule or constant, or act with zest_rl.load_policy and your own rewards"
        )
    raise BadInput(f"scores are needed, but {run.name} has no {SCORER_FILE}: {reason}")
