"""Evaluations → the episodes of a report, with their videos."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from zest_rl.evaluation.evaluate import Evaluation
from zest_rl.evaluation.videos import episode_video
from zest_rl.metrics.statistics import representative
from zest_rl.report.content import EpisodePanel
from zest_rl.rewards.state_scorer import StateScorer
from zest_rl.runtime import artifacts
from zest_rl.simulation.videos import Film
from zest_rl.types import FloatArray


def representative_episodes(
    name: str, evaluation: Evaluation, scorer: StateScorer | None, film: Film
) -> list[EpisodePanel]:
    """Return the best, the median and the worst episode: video, score over time, ground-truth progress.

    The list is empty where the environment cannot be drawn. Outside the kitchen the scores are those of the rollout, if
    it has any.
    """
    episodes = []
    for which, index in representative(evaluation.returns()).items():
        video = episode_video(evaluation.environment, evaluation.traces, index, evaluation.folder / f"{which}.mp4")
        if video is None:
            continue
        n_frames = evaluation.episodes[index].n_steps + 1
        scores = None
        if not evaluation.environment.is_kitchen:
            scores = evaluation.traces["score"][index, :n_frames] if "score" in evaluation.traces else None
        elif scorer is not None:
            scores = scorer.score_episode(evaluation.traces["qpos"][index])
        episodes.append(_panel(f"{name}: {which}", name, evaluation, index, n_frames, film(video), scores=scores))
    return episodes


def paired_episodes(left: tuple[str, Evaluation], right: tuple[str, Evaluation], film: Film) -> list[EpisodePanel]:
    """Return pairs of episodes from the same start: those in which the right policy gains most, the median and least.

    Args:
        left: name and evaluation of one policy.
        right: of the other; the list is empty if the starts or the environments differ.
        film: makes the videos.
    """
    (left_name, before), (right_name, after) = left, right
    (n_before, frames_before), (n_after, frames_after) = (each.traces["gt_reward"].shape for each in (before, after))
    is_paired = before.config.starts == after.config.starts and before.environment == after.environment
    if not is_paired or (n_before, frames_before) != (n_after, frames_after):
        return []
    episodes = []
    returns = before.returns()
    for which, index in representative(after.returns() - returns).items():
        n_frames = max(each.episodes[index].n_steps for each in (before, after)) + 1
        states = [each.traces[part][index] for each in (before, after) for part in after.environment.state]
        path = after.folder / f"pair-{artifacts.hash_arrays(*states)[:8]}.mp4"
        video = episode_video(after.environment, before.traces, index, path, beside=after.traces)
        if video is None:
            continue
        unit = " %" if before.is_normalized else ""
        title = f"{left_name} (left, {returns[index]:.0f}{unit}) beside {right_name} (right): {which} gain"
        beside = (left_name, _progress(before, index, n_frames))
        episodes.append(_panel(title, right_name, after, index, n_frames, film(video), beside=beside))
    return episodes


def _panel(
    title: str, name: str, evaluation: Evaluation, index: int, n_frames: int, video: Path, **drawn: Any
) -> EpisodePanel:
    return EpisodePanel(
        title=title,
        method=name,
        seed=evaluation.episodes[index].seed,
        value=float(evaluation.returns()[index]),
        success=evaluation.episodes[index].success,
        video=video,
        fps=evaluation.environment.fps,
        gt_progress=_progress(evaluation, index, n_frames),
        is_normalized=evaluation.is_normalized,
        is_progress=evaluation.environment.is_kitchen,
        **drawn,
    )


def _progress(evaluation: Evaluation, index: int, n_frames: int) -> FloatArray:
    return np.asarray(evaluation.traces["gt_reward"][index, :n_frames], dtype=np.float32)
