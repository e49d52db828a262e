"""Scores → a relabeled Minari dataset with provenance, under a name that is a hash of how it was scored."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from zest_rl.data import reader
from zest_rl.data.writer import write_relabeled
from zest_rl.errors import BadInput, nearest
from zest_rl.rewards.goals import GoalSpec
from zest_rl.rewards.scorer import Scorer, ScorerConfig
from zest_rl.runtime import artifacts
from zest_rl.runtime.parallel import Engine
from zest_rl.types import FloatArray

Reward = Literal["level", "difference"]
SCORER_FILE = "zest_scorer.safetensors"
GOAL_FOLDER = "zest_goal"
MAX_THUMBNAILS, THUMBNAIL = 8, 160
"""Pictures per side of a goal that a report shows, and their largest side in pixels."""


@dataclass(frozen=True)
class Relabeled:
    """What `relabel` made or found."""

    dataset_id: str
    path: Path
    scorer: Scorer
    n_frames: int
    n_still: int | None
    """Frames without any change against their first frame; None when the dataset was there already."""
    already_there: bool


def rewards_from_scores(scores: FloatArray, reward: Reward = "level") -> FloatArray:
    """Turn the scores of T+1 frames into the rewards of T actions (alignment: `zest_rl.types`).

    Args:
        scores: (T+1,) φ of x_0 … x_T.
        reward: ``"level"``, r_t = φ_{t+1}, as in the paper; or ``"difference"``, r_t = φ_{t+1} − φ_t.

    Returns:
        (T,) float32.
    """
    if reward == "level":
        return scores[1:]
    if reward == "difference":
        return np.diff(scores)
    raise BadInput(f"unknown reward {reward!r}; {nearest(reward, ('level', 'difference'))}")


def shuffled(scores: Sequence[FloatArray], seed: int) -> list[FloatArray]:
    """Give every episode the scores of another one: rewards of the same shape that tell nothing.

    Raises:
        BadInput: there are fewer than 2 episodes, or they are not equally long.
    """
    if len(scores) < 2 or len({len(score) for score in scores}) > 1:
        raise BadInput("scores can be shuffled among 2 or more equally long episodes only; leave --shuffle out")
    order = np.random.default_rng(seed).permutation(len(scores))  # in a ring, so that none keeps its own
    taken = dict(zip(order, np.roll(order, 1), strict=True))
    return [scores[taken[i]] for i in range(len(scores))]


def relabeled_id(source_id: str, digest: str) -> str:
    """``zest/kitchen-micro-noisy-v0`` → ``zest/kitchen-micro-noisy-zest-1a2b3c4d-v0``."""
    return re.sub(r"-v(\d+)$", rf"-zest-{digest[:8]}-v\1", source_id)


class AnyScorer(Protocol):
    """What `record` asks of a scorer."""

    @property
    def config(self) -> Any:
        """It says features, similarity and embedder."""

    def describe(self) -> dict[str, Any]:
        """Config and content hashes, JSON-ready."""


def record(
    scorer: AnyScorer,
    source: Mapping[str, Any],
    *,
    reward: Reward,
    shuffle: int | None,
    kept: NDArray[np.intp] | None,
    n_still: int,
) -> dict[str, Any]:
    """What a relabeled dataset tells of how it was made: ``description`` and ``zest`` of the writers.

    Args:
        scorer: what scored.
        source: what was scored, JSON-ready.
        reward: see `relabel`.
        shuffle: see `relabel`.
        kept: indices of the goals that were used; None: all.
        n_still: frames without any change against their first frame.
    """
    config = scorer.config
    return {
        "description": f"Rewards are scores ({config.similarity}+{config.features}, {reward}) by {config.embedder}.",
        "zest": {
            "relabel": {
                **source,
                "reward": reward,
                "shuffle": shuffle,
                "kept_goals": None if kept is None else kept.tolist(),
                "scorer": scorer.describe(),
                "n_still_frames": n_still,
                "provenance": artifacts.provenance(),
            }
        },
    }


def relabel(
    source_id: str,
    config: ScorerConfig,
    *,
    reward: Reward = "level",
    shuffle: int | None = None,
    device: str = "auto",
    n_workers: int | None = None,
    engine: Engine = "local",
    on_progress: Callable[[int, int], None] | None = None,
) -> Relabeled:
    """Write a copy of a dataset whose rewards are ZeST scores; the ground truth stays in the infos, unread.

    Args:
        source_id: a dataset with recorded simulator state.
        config: the scorer.
        reward: the level of the score at each step, or its change.
        shuffle: null control: give each episode the scores of another one, drawn with this seed.
        device: where the embedder runs.
        n_workers: processes that render and embed, default one per core.
        engine: processes of this machine, or workers of a Ray cluster; the rewards are the same.
        on_progress: called with (parts embedded, parts in all).

    Raises:
        BadInput: the dataset, goal or embedder is not there or does not fit.
        ZestError: the disk is full or read-only; nothing is left behind.
    """
    states = reader.read_states(source_id)
    scorer = Scorer.build(config, states[0][0], device=device, n_workers=n_workers, engine=engine)
    source_fingerprint = reader.fingerprint(source_id)
    digest = artifacts.hash_json([source_fingerprint, scorer.fingerprint(), reward, shuffle])
    target_id = relabeled_id(source_id, digest)
    path = reader.dataset_path(target_id)
    n_frames = sum(map(len, states))

    def find() -> Relabeled:
        """Return the dataset that is there already, and a scorer with the goals that it was scored by."""
        kept = reader.read_metadata(target_id)["zest"]["relabel"]["kept_goals"]
        if kept is not None:
            scorer.keep_goals(np.array(kept))
        return Relabeled(target_id, path, scorer, n_frames, None, already_there=True)

    if reader.exists(target_id):
        return find()
    with artifacts.lock(path):
        if reader.exists(target_id):  # an equal call that ran at the same time
            return find()
        kept = scorer.select_goals(states, on_progress) if config.goal_share < 1 else None
        scores, n_still = scorer.score_episodes(states, on_progress)
        if shuffle is not None:
            scores = shuffled(scores, shuffle)
        write_relabeled(
            source_id,
            target_id,
            [rewards_from_scores(score, reward) for score in scores],
            scores,
            **record(
                scorer,
                {"source": source_id, "source_sha256": source_fingerprint},
                reward=reward,
                shuffle=shuffle,
                kept=kept,
                n_still=n_still,
            ),
            extra=lambda folder: _leave_scorer(folder, scorer),
        )
    return Relabeled(target_id, path, scorer, n_frames, n_still, already_there=False)


def _leave_scorer(folder: Path, scorer: Scorer) -> None:
    """Leave the scorer, for online scores, and the goal in a dataset's folder."""
    scorer.save(folder / SCORER_FILE)
    leave_goal(folder, scorer.goal)


def leave_goal(folder: Path, goal: GoalSpec | None) -> None:
    """Leave small pictures of the goal, for reports, in a dataset's folder; nothing of sentences."""
    if goal is None or goal.is_text:
        return
    for part, pictures in (("init", goal.starts), ("goal", goal.goals)):
        (folder / GOAL_FOLDER / part).mkdir(parents=True)
        for i, picture in enumerate(pictures[:MAX_THUMBNAILS]):
            thumbnail = Image.fromarray(np.asarray(picture))
            thumbnail.thumbnail((THUMBNAIL, THUMBNAIL))
            thumbnail.save(folder / GOAL_FOLDER / part / f"{i}.png")
