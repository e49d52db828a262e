"""Evaluations → the episodes of a report, with their videos."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zest_rl.evaluation.evaluate import Evaluation
from zest_rl.kitchen.videos import FPS, Film, Video
from zest_rl.metrics.statistics import representative
from zest_rl.report.content import EpisodePanel
from zest_rl.rewards.state_scorer import StateScorer
from zest_rl.runtime import artifacts
from zest_rl.types import FloatArray


def representative_episodes(
    name: str, evaluation: Evaluation, scorer: StateScorer | None, film: Film
) -> list[EpisodePanel]:
    """Return the best, the median and the worst episode: video, score over time, ground-truth progress."""
    episodes = []
    for which, index in representative(evaluation.normalized()).items():
        states: NDArray[np.float64] = evaluation.traces["qpos"][index]
        video = film(Video(states, evaluation.folder / f"{which}.mp4"))
        scores = None if scorer is None else scorer.score_episode(states)
        episodes.append(_panel(f"{name}: {which}", name, evaluation, index, video, scores=scores))
    return episodes


def paired_episodes(left: tuple[str, Evaluation], right: tuple[str, Evaluation], film: Film) -> list[EpisodePanel]:
    """Return pairs of episodes from the same start: those in which the right policy gains most, the median and least.

    Args:
        left: name and evaluation of one policy.
        right: of the other; the list is empty if the starts differ.
        film: makes the videos.
    """
    (left_name, before), (right_name, after) = left, right
    if before.config.starts != after.config.starts:
        return []
    episodes = []
    returns = before.normalized()
    for which, index in representative(after.normalized() - returns).items():
        left_qpos, right_qpos = before.traces["qpos"][index], after.traces["qpos"][index]
        name = f"pair-{artifacts.hash_arrays(left_qpos, right_qpos)[:8]}.mp4"
        video = film(Video(left_qpos, after.folder / name, beside=right_qpos))
        title = f"{left_name} (left, {returns[index]:.0f} %) beside {right_name} (right): {which} gain"
        beside = (left_name, _progress(before, index))
        episodes.append(_panel(title, right_name, after, index, video, beside=beside))
    return episodes


def _panel(title: str, name: str, evaluation: Evaluation, index: int, video: Path, **drawn: Any) -> EpisodePanel:
    return EpisodePanel(
        title=title,
        method=name,
        seed=evaluation.episodes[index].seed,
        normalized_return=float(evaluation.normalized()[index]),
        success=evaluation.episodes[index].success,
        video=video,
        fps=FPS,
        gt_progress=_progress(evaluation, index),
        **drawn,
    )


def _progress(evaluation: Evaluation, index: int) -> FloatArray:
    return np.asarray(evaluation.traces["gt_reward"][index], dtype=np.float32)
