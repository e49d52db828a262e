"""Datasets → frames scored by one goal, for goal and action selection as judged by `zest_rl.metrics.selection`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from zest_rl.data.reader import open_dataset
from zest_rl.embedders import DEFAULT_EMBEDDER, Precision
from zest_rl.errors import BadInput, nearest
from zest_rl.kitchen.env import progress_of
from zest_rl.kitchen.tasks import SUCCESS_PROGRESS, TASKS, Task, get_task
from zest_rl.kitchen.views import Views, canonical_states
from zest_rl.metrics import selection
from zest_rl.rewards.scorer import ScorerConfig
from zest_rl.rewards.scores import Features, Similarity
from zest_rl.rewards.state_scorer import StateScorer

Context = Literal["same", "different"]
"""Which trajectory x_0 comes from: the candidate's own (the paper's SG, as we read it), or another one (DG)."""


@dataclass(frozen=True)
class FramePool:
    """The M candidates of a selection: frames of one or several datasets (the paper's SD and DD)."""

    states: NDArray[np.float64]
    """(M, nq) simulator positions."""
    trajectory: NDArray[np.intp]
    """(M,) trajectory that each frame is of."""
    task: tuple[str, ...]
    """Kitchen task per trajectory."""
    starts: NDArray[np.float64]
    """(trajectories, nq) first states."""

    def satisfies(self, task: Task) -> NDArray[np.bool_]:
        """Return which frames show `task` done, whatever their trajectory's task: (M,) bool. Ground truth."""
        return np.asarray(progress_of(task, self.states) >= SUCCESS_PROGRESS)

    def does(self, task: Task) -> NDArray[np.bool_]:
        """Return which frames show the action of `task` done to the object of their own trajectory: (M,) bool."""
        done = np.zeros(len(self.states), dtype=bool)
        for other in {name for name in self.task if TASKS[name].action == task.action}:
            done |= self.is_of(other) & self.satisfies(TASKS[other])
        return done

    def is_of(self, task: str) -> NDArray[np.bool_]:
        """Return which frames are of a trajectory of `task`: (M,) bool."""
        return np.array([name == task for name in self.task])[self.trajectory]

    def start_alike(self, views: Views) -> bool:
        """Whether all trajectories start with the same picture, as they do without the robot in view."""
        return len(np.unique(canonical_states(self.starts, views), axis=0)) == 1

    def contexts(self, context: Context, seed: int) -> NDArray[np.float64]:
        """Draw x_0 of each candidate: (M, nq).

        Raises:
            BadInput: unknown context, or there is only one trajectory.
        """
        if context == "same":
            return np.asarray(self.starts[self.trajectory])
        if context != "different":
            raise BadInput(f"unknown context {context!r}; {nearest(context, ('same', 'different'))}")
        if len(self.starts) < 2:
            raise BadInput("a different trajectory to take x_0 from needs at least 2 trajectories, got 1")
        return np.asarray(self.starts[selection.draw_others(len(self.starts), seed)[self.trajectory]])


def draw_pool(dataset_ids: Sequence[str], n_frames: int, seed: int = 0) -> FramePool:
    """Draw frames uniformly from datasets, without first frames.

    Args:
        dataset_ids: kitchen datasets; one for a narrow pool, several tasks for a diverse one.
        n_frames: of each dataset; fewer where it has fewer.
        seed: of the draw.

    Raises:
        BadInput: no dataset, one twice, an unknown one, or `n_frames` is below 1.
    """
    if not dataset_ids or n_frames < 1 or len(set(dataset_ids)) < len(dataset_ids):
        raise BadInput(
            "candidates need at least 1 dataset, each once, and 1 frame of each, got "
            f"{', '.join(dataset_ids) or 'none'} and {n_frames}"
        )
    rng = np.random.default_rng(seed)
    states: list[NDArray[np.float64]] = []
    starts: list[NDArray[np.float64]] = []
    trajectory: list[int] = []
    tasks: list[str] = []
    for dataset_id in dataset_ids:
        with open_dataset(dataset_id) as ds:
            episodes, name = ds.states(), ds.kitchen_task()
        steps = [(i, t) for i, episode in enumerate(episodes) for t in range(1, len(episode))]
        chosen = rng.permutation(len(steps))[:n_frames]
        for i, t in (steps[k] for k in np.sort(chosen)):
            states.append(episodes[i][t])
            trajectory.append(len(starts) + i)
        starts += [episode[0] for episode in episodes]
        tasks += [name] * len(episodes)
    return FramePool(np.stack(states), np.array(trajectory, dtype=np.intp), tuple(tasks), np.stack(starts))


def draw_goals(scorer: StateScorer, n_goals: int | None, seed: int) -> StateScorer:
    """Return a scorer with `n_goals` of the goal's pictures, drawn with `seed`; with all of them for None.

    Raises:
        BadInput: there are fewer.
    """
    n = scorer.scorer.goals.shape[-2]
    if n_goals is None:
        return scorer
    if not 1 <= n_goals <= n:
        raise BadInput(f"the goal has {n} pictures, {n_goals} cannot be drawn of them; give a number from 1 to {n}")
    return scorer.with_goals(np.sort(np.random.default_rng(seed).permutation(n)[:n_goals]))


def score_pool(
    pool: FramePool,
    config: ScorerConfig,
    views: Views,
    *,
    ask: Literal["goals", "actions"] = "goals",
    context: Context = "same",
    n_repeats: int = 1,
    n_goals: int | None = None,
    n_workers: int | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> NDArray[np.float64]:
    """Score candidates by a goal.

    Args:
        pool: M candidates.
        config: the goal, and how frames are compared with it.
        views: of the goal's task.
        ask: goals: how much does a frame look like the goal, seen from the views of the goal's task? actions: does its
            trajectory change its own object as the goal changes the goal's, seen from the views of the own task?
        context: where x_0 comes from; actions need ``same``.
        n_repeats: R, over which goals and contexts are drawn anew.
        n_goals: pictures of the goal per repeat, default all.
        n_workers: processes that embed, default one per core.
        on_progress: called with (parts embedded, parts in all).

    Returns:
        (R, M) float64.
    """
    goal = StateScorer.build(config, views, pool.starts[0], n_workers=n_workers)
    by_task = [(goal, np.arange(len(pool.states)))]
    if ask == "actions":
        by_task = [(goal.seen_as(name), np.flatnonzero(pool.is_of(name))) for name in sorted(set(pool.task))]
    scores = np.empty((n_repeats, len(pool.states)))
    for whole, frames in by_task:
        for repeat in range(n_repeats):
            scorer, starts = draw_goals(whole, n_goals, repeat), pool.contexts(context, repeat)
            scores[repeat, frames] = scorer.score_pairs(starts[frames], pool.states[frames], on_progress)
    return scores


@dataclass(frozen=True)
class FrameSelection:
    """The scores of M candidates by one goal, and which of them satisfy it."""

    task: str
    """Of the goal."""
    top: int
    """N of the Top-N success rate."""
    scores: NDArray[np.float64]
    """(R, M) over R repeats."""
    satisfies: NDArray[np.bool_]
    """(M,) Ground truth."""
    trajectory: NDArray[np.intp]
    """(M,) trajectory that each candidate is of."""

    def as_json(self) -> dict[str, Any]:
        """Return the measures of `zest_rl.metrics.selection` with 95 % intervals over trajectories, and the counts."""
        measures: dict[str, selection.Measure] = {
            "top_n_success": partial(selection.top_up_to, n=self.top),
            "dataset_total_variation": selection.dataset_total_variation,
            "relative_variation": selection.relative_variation,
        }
        estimates = {
            name: selection.over_trajectories(measure, self.scores, self.satisfies, self.trajectory)
            for name, measure in measures.items()
        }
        chance = selection.goal_frame_ratio(self.satisfies)
        return {
            "top": self.top,
            "n_repeats": len(self.scores),
            "top_n_by_repeat": [selection.top_up_to(scores, self.satisfies, self.top) for scores in self.scores],
            **{name: estimate.as_json() for name, estimate in estimates.items()},
            "goal_frame_ratio": chance,
            "times_random": estimates["top_n_success"].value / chance,
            "n_candidates": len(self.satisfies),
            "n_satisfying": int(self.satisfies.sum()),
        }


def select_frames(
    datasets: Sequence[str],
    *,
    ask: Literal["goals", "actions"] = "goals",
    task: str | None = None,
    goal: str = "same-scene",
    embedder: str = DEFAULT_EMBEDDER,
    features: Features = "delta",
    similarity: Similarity = "cos",
    views: int = 8,
    show_robot: bool = False,
    tolerance: float = 1e-3,
    context: Context = "same",
    top: int = selection.TOP_N,
    n_frames: int = 500,
    n_goals: int | None = None,
    n_repeats: int = 5,
    seed: int = 0,
    precision: Precision = "auto",
    n_workers: int | None = None,
    on_alike_starts: Callable[[], None] | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> FrameSelection:
    """Draw frames of kitchen datasets and score them by a goal: do the highest scores satisfy it?

    Args:
        datasets: ids: one (the paper's narrow pool) or of several tasks (diverse).
        ask: goals: is the goal reached (Cui et al. §4.1)? actions: is its action done, to any object (§4.2)?
        task: of the goal; default that of the first dataset.
        goal: as in `zest_rl.rewards.goals`.
        embedder: URI of the network.
        features: how frames and goals are compared.
        similarity: how frames and goals are compared.
        views: cameras around the object.
        show_robot: keep the robot in view.
        tolerance: rad or m; states that differ by less are embedded once.
        context: goals only: where x_0 of a candidate comes from.
        top: N of the Top-N success rate.
        n_frames: candidates drawn from each dataset.
        n_goals: pictures of the goal drawn per repeat, default all.
        n_repeats: R; 1 is enough when nothing is drawn.
        seed: of the candidates.
        precision: of the embedder.
        n_workers: processes that embed, default one per core.
        on_alike_starts: called before scoring if ``different`` changes nothing: all trajectories start alike.
        on_progress: called with (parts embedded, parts in all).

    Raises:
        BadInput: an argument is out of range, or fewer than `top` candidates satisfy the goal.
    """
    if not datasets:
        raise BadInput("a selection needs at least 1 dataset; `zest collect` makes them")
    pool = draw_pool(datasets, n_frames, seed)
    goal_task = get_task(task or pool.task[0])
    satisfies = pool.satisfies(goal_task) if ask == "goals" else pool.does(goal_task)
    if satisfies.sum() < top:
        raise BadInput(
            f"only {satisfies.sum()} of {len(satisfies)} candidates satisfy the goal of {goal_task.name!r}, so the "
            f"highest {top} could not all; give more --n-frames, a smaller --top, or a dataset with more successes"
        )
    cameras = Views(goal_task.name, views, robot=show_robot, tolerance=tolerance)
    if on_alike_starts is not None and context == "different" and pool.start_alike(cameras):
        on_alike_starts()
    config = ScorerConfig(goal, embedder, features, similarity, precision)
    scores = score_pool(
        pool,
        config,
        cameras,
        ask=ask,
        context=context if ask == "goals" else "same",
        n_repeats=1 if n_goals is None and context == "same" else n_repeats,
        n_goals=n_goals,
        n_workers=n_workers,
        on_progress=on_progress,
    )
    return FrameSelection(goal_task.name, top, scores, satisfies, pool.trajectory)
