"""Datasets → candidates of goal and action selection, scored by one goal. What is found is judged by `selection`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from zest_rl.data.reader import open_dataset
from zest_rl.errors import BadInput, nearest
from zest_rl.kitchen.env import progress_of
from zest_rl.kitchen.tasks import SUCCESS_PROGRESS, TASKS, Task
from zest_rl.kitchen.views import Views, canonical_states
from zest_rl.metrics.selection import others
from zest_rl.rewards.scorer import ScorerConfig
from zest_rl.rewards.state_scorer import StateScorer

Context = Literal["same", "different"]
"""Which trajectory x_0 comes from: the candidate's own (the paper's SG, as we read it), or another one (DG)."""


@dataclass(frozen=True)
class Candidates:
    """Frames of one or several datasets (the paper's SD and DD) and what is asked of them."""

    states: NDArray[np.float64]
    """(M, nq) simulator positions."""
    trajectory: NDArray[np.intp]
    """(M,) which trajectory each is of."""
    task: tuple[str, ...]
    """What the robot was doing, per trajectory."""
    starts: NDArray[np.float64]
    """(trajectories, nq) their first states."""

    def satisfies(self, task: Task) -> NDArray[np.bool_]:
        """Which frames show `task` done, whatever the robot was doing: (M,) bool. Ground truth, for judging."""
        return np.asarray(progress_of(task, self.states) >= SUCCESS_PROGRESS)

    def does(self, task: Task) -> NDArray[np.bool_]:
        """Which frames show the action of `task` done to whatever their trajectory is about: (M,) bool."""
        done = np.zeros(len(self.states), dtype=bool)
        for other in {name for name in self.task if TASKS[name].action == task.action}:
            of_other = np.array([name == other for name in self.task])[self.trajectory]
            done |= of_other & self.satisfies(TASKS[other])
        return done

    def start_alike(self, views: Views) -> bool:
        """Whether all trajectories start with the same picture, as without the robot in view."""
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
        return np.asarray(self.starts[others(len(self.starts), seed)[self.trajectory]])


def draw_candidates(dataset_ids: Sequence[str], n_frames: int, seed: int = 0) -> Candidates:
    """Draw frames evenly from datasets, x_0 left out.

    Args:
        dataset_ids: kitchen datasets; one for a narrow pool, several tasks for a diverse one.
        n_frames: of each dataset; fewer where it has fewer.
        seed: of the draw.

    Raises:
        BadInput: no dataset, none of that name, or `n_frames` is below 1.
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
    return Candidates(np.stack(states), np.array(trajectory, dtype=np.intp), tuple(tasks), np.stack(starts))


def draw_goals(scorer: StateScorer, n_goals: int | None, seed: int) -> StateScorer:
    """Return a scorer with `n_goals` of the goals, drawn with `seed`; with all of them for None.

    Raises:
        BadInput: there are fewer.
    """
    n = scorer.scorer.goals.shape[-2]
    if n_goals is None:
        return scorer
    if not 1 <= n_goals <= n:
        raise BadInput(f"the goal has {n} pictures, {n_goals} cannot be drawn of them; give a number from 1 to {n}")
    return scorer.with_goals(np.sort(np.random.default_rng(seed).permutation(n)[:n_goals]))


def score_as_goals(
    candidates: Candidates,
    config: ScorerConfig,
    views: Views,
    *,
    context: Context = "same",
    n_repeats: int = 1,
    n_goals: int | None = None,
    n_workers: int | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> NDArray[np.float64]:
    """Score candidates by how much they look like the goal, all seen from the views of the goal's task.

    Args:
        candidates: M of them.
        config: the goal, and how it is compared.
        views: of the goal's task.
        context: where x_0 comes from.
        n_repeats: R, over which goals and contexts are drawn anew.
        n_goals: pictures of the goal per repeat, default all.
        n_workers: processes that embed, default one per core.
        on_progress: called with (parts embedded, parts in all).

    Returns:
        (R, M) float64.
    """
    whole = StateScorer.build(config, views, candidates.starts[0], n_workers=n_workers)
    rows = []
    for repeat in range(n_repeats):
        scorer = draw_goals(whole, n_goals, repeat)
        rows.append(scorer.score_pairs(candidates.contexts(context, repeat), candidates.states, on_progress))
    return np.stack(rows).astype(np.float64)


def score_as_actions(
    candidates: Candidates,
    config: ScorerConfig,
    views: Views,
    *,
    n_repeats: int = 1,
    n_goals: int | None = None,
    n_workers: int | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> NDArray[np.float64]:
    """Score candidates by how much they change what their own trajectory is about as the goal changes its object.

    Each trajectory is seen from the views of its own task, so that the change is in the picture.

    Args:
        candidates: M of them, of several tasks.
        config: the goal, and how it is compared.
        views: of the goal's task.
        n_repeats: R, over which goals are drawn anew.
        n_goals: pictures of the goal per repeat, default all.
        n_workers: processes that embed, default one per core.
        on_progress: called with (parts embedded, parts in all).

    Returns:
        (R, M) float64.
    """
    goal = StateScorer.build(config, views, candidates.starts[0], n_workers=n_workers)
    first = candidates.contexts("same", 0)
    scores = np.empty((n_repeats, len(candidates.states)))
    for name in sorted(set(candidates.task)):
        whole = goal.seen_as(name)
        frames = np.flatnonzero(np.array([task == name for task in candidates.task])[candidates.trajectory])
        for repeat in range(n_repeats):
            scorer = draw_goals(whole, n_goals, repeat)
            scores[repeat, frames] = scorer.score_pairs(first[frames], candidates.states[frames], on_progress)
    return scores
