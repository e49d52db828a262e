"""Frames from anywhere → scores → a relabeled Minari dataset: `relabel` for robots other than our kitchen.

What is written is the same, but for the rewards that the dataset came with: ``infos/source/reward`` keeps them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from zest_rl.data import reader
from zest_rl.data.writer import write_scored
from zest_rl.rewards.frame_embeddings import FrameScorer, FrameScorerConfig
from zest_rl.rewards.relabel import (
    Reward,
    leave_goal,
    record,
    relabeled_id,
    rewards_from_scores,
    shuffled,
)
from zest_rl.runtime import artifacts
from zest_rl.runtime.parallel import Engine
from zest_rl.sources.base import Source


@dataclass(frozen=True)
class RelabeledFrames:
    """What `relabel_frames` made or found."""

    dataset_id: str
    path: Path
    n_frames: int
    """Scored frames of one view: T + 1 per episode."""
    n_embedded: int
    """Episodes that were not in the cache."""
    n_still: int | None
    """Frames without any change against their first frame; None when the dataset was there already."""
    already_there: bool


def relabel_frames(
    source: Source,
    config: FrameScorerConfig,
    *,
    reward: Reward = "level",
    shuffle: int | None = None,
    device: str = "auto",
    n_workers: int | None = None,
    engine: Engine = "local",
    on_progress: Callable[[int, int], None] | None = None,
) -> RelabeledFrames:
    """Write a copy of a dataset whose rewards are ZeST scores; the rewards that it came with are kept.

    They, too, are hashed into the copy's name; nothing else depends on them.

    Args:
        source: episodes and their frames.
        config: the scorer.
        reward: the level of the score at each step, or its change.
        shuffle: null control: give each episode the scores of another one, drawn with this seed.
        device: where the embedder runs.
        n_workers: processes that read and embed, default one per core.
        engine: processes of this machine, or workers of a Ray cluster; the rewards are the same.
        on_progress: called with (episodes embedded, episodes in all).

    Raises:
        BadInput: the goal, the embedder or the frames do not fit.
        ZestError: the disk is full or read-only; nothing is left behind but finished embeddings.
    """
    trajectories = source.trajectories
    scorer = FrameScorer(config, device=device, n_workers=n_workers, engine=engine)
    digests = [source.frames.digest(episode) for episode in range(len(trajectories.n_steps))]
    fingerprint = trajectories.fingerprint()
    kept = [None if r is None else artifacts.hash_arrays(r) for r in trajectories.source_rewards()]
    digest = artifacts.hash_json([fingerprint, kept, digests, scorer.fingerprint(), reward, shuffle])
    target_id = relabeled_id(trajectories.dataset_id, digest)
    path = reader.dataset_path(target_id)
    n_frames = sum(trajectories.n_steps) + len(trajectories.n_steps)
    if reader.exists(target_id):
        return RelabeledFrames(target_id, path, n_frames, 0, None, already_there=True)
    with artifacts.lock(path):
        if reader.exists(target_id):  # an equal call that ran at the same time
            return RelabeledFrames(target_id, path, n_frames, 0, None, already_there=True)
        scorer.embed(source, digests, on_progress)
        kept_goals = scorer.select_goals(source, digests) if config.goal_share < 1 else None
        scores, n_still = scorer.score_episodes(source, digests)
        if shuffle is not None:
            scores = shuffled(scores, shuffle)
        write_scored(
            trajectories,
            target_id,
            [rewards_from_scores(score, reward) for score in scores],
            scores,
            **record(
                scorer,
                {
                    "source": trajectories.dataset_id,
                    "source_sha256": fingerprint,
                    "frames": source.frames.describe(),
                    "frames_sha256": artifacts.hash_json(digests),
                },
                reward=reward,
                shuffle=shuffle,
                kept=kept_goals,
                n_still=n_still,
            ),
            extra=lambda folder: leave_goal(folder, scorer.goal),
        )
    return RelabeledFrames(target_id, path, n_frames, scorer.n_embedded, n_still, already_there=False)
