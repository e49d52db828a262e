"""Scores → a relabeled Minari dataset with provenance, named by a hash of how it was scored."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from PIL import Image

from zest_rl.data import reader
from zest_rl.data.folders import CARD_FILE, GOAL_FOLDER
from zest_rl.data.provenance import RelabelRecord
from zest_rl.data.writer import write_scored
from zest_rl.embedders import DEFAULT_EMBEDDER, Backend, Precision, Vectors
from zest_rl.errors import BadInput, nearest
from zest_rl.kitchen.views import Views
from zest_rl.rewards.cards import dataset_card
from zest_rl.rewards.embeddings import EmbeddedEpisode, EpisodeEmbeddings
from zest_rl.rewards.episode_goals import read_source_goal
from zest_rl.rewards.frame_embeddings import FrameEmbeddings
from zest_rl.rewards.goals import SAME_SCENE
from zest_rl.rewards.scorer import SCORER_FILE, Scorer, ScorerConfig
from zest_rl.rewards.scores import Features, Reward, Similarity
from zest_rl.rewards.state_embeddings import StateEmbedder, StateEmbeddings
from zest_rl.runtime import artifacts
from zest_rl.runtime.parallel import Engine
from zest_rl.runtime.privacy import masked
from zest_rl.sources import EpisodeFrames, KitchenStates, Source, open_source
from zest_rl.sources.masked import MaskedFrames
from zest_rl.sources.scenes import SceneStates
from zest_rl.types import FloatArray

MAX_THUMBNAILS, THUMBNAIL = 8, 160
"""Number of start pictures and of goal pictures kept for reports, and their longer side in pixels."""


@dataclass(frozen=True)
class Relabeled:
    """Result of `relabel`: the new dataset, or the equal one that existed."""

    dataset_id: str
    path: Path
    source: Source = field(repr=False)
    scorer: Scorer = field(repr=False)
    n_frames: int
    """Scored frames of one view: T + 1 per episode."""
    n_embedded: int
    """Number of `unit` that were not in the cache."""
    unit: str
    """``distinct_states`` or ``episodes``."""
    n_still: int | None
    """Number of unchanged frames, equal to the first of their episode; None if the dataset existed."""
    view_cannot_tell: bool
    """See `zest_rl.rewards.scorer.Scorer.view_cannot_tell`; only of one view in which the robot is not hidden."""

    @property
    def already_there(self) -> bool:
        """Whether the dataset existed."""
        return self.n_still is None


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
    raise BadInput(f"unknown reward {reward!r}; {nearest(reward, get_args(Reward))}")


def shuffled(scores: Sequence[FloatArray], seed: int) -> list[FloatArray]:
    """Give every episode the scores of another one: a null control, rewards that say nothing about their episode.

    Raises:
        BadInput: there are fewer than 2 episodes, or they are not equally long.
    """
    if len(scores) < 2 or len({len(score) for score in scores}) > 1:
        raise BadInput("scores can be shuffled among 2 or more equally long episodes only; leave --shuffle out")
    order = np.random.default_rng(seed).permutation(len(scores))  # a ring, so that none keeps its own
    donors = dict(zip(order, np.roll(order, 1), strict=True))
    return [scores[donors[i]] for i in range(len(scores))]


def relabeled_id(source_id: str, digest: str) -> str:
    """``zest/kitchen-micro-noisy-v0`` → ``zest/kitchen-micro-noisy-zest-1a2b3c4d-v0``."""
    return re.sub(r"-v(\d+)$", rf"-zest-{digest[:8]}-v\1", source_id)


def relabel(
    dataset: str,
    goal: str = "same-scene",
    *,
    frames: Sequence[str] = (),
    camera: Sequence[str] = (),
    env: str | None = None,
    robot: Sequence[str] = (),
    look_at: str | None = None,
    views: int = Views.n_views,
    show_robot: bool = Views.robot,
    tolerance: float = Views.tolerance,
    skip_incomplete: bool = False,
    masks: Sequence[str] = (),
    embedder: str = DEFAULT_EMBEDDER,
    features: Features = "delta",
    similarity: Similarity = "cos",
    precision: Precision = "auto",
    backend: Backend = "auto",
    vectors: Vectors = "float32",
    goal_share: float = 1.0,
    **options: Any,
) -> Relabeled:
    """Write a copy of a dataset whose rewards are ZeST scores, with the arguments of `zest relabel`.

    `dataset` and `frames` … `masks` choose the frames (`open_source`), `goal` and `embedder` … `goal_share`
    the scorer (`ScorerConfig`); the other options and the errors are those of `relabel_source`.
    """
    config = ScorerConfig(goal, embedder, features, similarity, precision, goal_share, backend, vectors)
    source = open_source(
        dataset,
        frames=frames,
        cameras=camera,
        env=env,
        robot=robot,
        look_at=look_at,
        n_views=views,
        show_robot=show_robot,
        tolerance=tolerance,
        skip_incomplete=skip_incomplete,
        masks=masks,
    )
    return relabel_source(source, config, **options)


def relabel_source(
    source: Source,
    config: ScorerConfig,
    *,
    reward: Reward = "level",
    shuffle: int | None = None,
    device: str = "auto",
    n_workers: int | None = None,
    engine: Engine = "local",
    on_start: Callable[[Source], None] | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> Relabeled:
    """Write a copy of a dataset whose rewards are ZeST scores.

    The ground truth stays in the infos, unread; original rewards that are not ground truth are kept as
    ``infos/source/reward``.

    Args:
        source: episodes and their frames.
        config: the scorer.
        reward: the level of the score at each step, or its change.
        shuffle: null control: give each episode the scores of another one, drawn with this seed.
        device: of the embedder.
        n_workers: processes that read or render, and embed; default one per core.
        engine: processes of this machine, or workers of a Ray cluster; the rewards are the same.
        on_start: called with `source` before any work, to tell which frames were chosen.
        on_progress: called with (parts embedded, parts in all).

    Raises:
        BadInput: the goal, the embedder or the frames do not fit.
        ZestError: the disk is full or read-only; nothing is left behind but finished embeddings.
    """
    if on_start is not None:
        on_start(source)
    trajectories = source.trajectories
    scorer, embeddings = _open(source, config, device, n_workers, engine)
    source_sha256 = trajectories.fingerprint()
    digest = artifacts.hash_json([source_sha256, *embeddings.identity(), scorer.fingerprint(), reward, shuffle])
    target_id = relabeled_id(trajectories.dataset_id, digest)
    path = reader.dataset_path(target_id)

    def result(scorer: Scorer, n_still: int | None, *, view_cannot_tell: bool) -> Relabeled:
        n_frames = sum(trajectories.n_steps) + len(trajectories.n_steps)
        n_embedded = embeddings.n_embedded
        unit = embeddings.unit
        return Relabeled(target_id, path, source, scorer, n_frames, n_embedded, unit, n_still, view_cannot_tell)

    def existing() -> Relabeled:
        """Return the dataset on disk, and a scorer with the goals that it kept."""
        with reader.open_dataset(target_id) as ds:
            record = ds.record.relabel
        kept = None if record is None else record.kept_goals
        found = scorer if kept is None else scorer.with_goals(np.array(kept))
        return result(found, None, view_cannot_tell=record is not None and record.view_cannot_tell)

    if reader.exists(target_id):
        return existing()
    with artifacts.lock(path):
        if reader.exists(target_id):  # an equal call that ran at the same time
            return existing()
        rendered = read_source_goal(config.goal, source) if config.goal == SAME_SCENE else None
        scorer.check_goal(device, rendered)
        embeddings.embed(on_progress)
        kept = scorer.goals_near(embeddings) if config.goal_share < 1 else None
        scorer = scorer if kept is None else scorer.with_goals(kept)
        scores, n_still = scorer.score_episodes(embeddings)
        if shuffle is not None:
            scores = shuffled(scores, shuffle)
        cannot_tell = view_cannot_tell(scorer, source.frames, embeddings)
        record = RelabelRecord(
            source=trajectories.dataset_id,
            source_sha256=source_sha256,
            **embeddings.describe(),
            reward=reward,
            shuffle=shuffle,
            kept_goals=None if kept is None else tuple(kept.tolist()),
            scorer=scorer.record,
            n_still_frames=n_still,
            view_cannot_tell=cannot_tell,
            provenance=artifacts.provenance(),
        )

        def add(folder: Path) -> None:
            artifacts.write_bytes(folder / CARD_FILE, dataset_card(target_id, record, scores).encode())
            _write_scorer(folder, scorer, source.frames)

        write_scored(
            trajectories,
            target_id,
            [rewards_from_scores(score, reward) for score in scores],
            scores,
            description=f"Rewards are scores ({config.similarity}+{config.features}, {reward}) "
            f"by {masked(config.embedder)}.",
            zest={"relabel": record.to_json()},
            extra=add,
        )
    return result(scorer, n_still, view_cannot_tell=cannot_tell)


def _open(
    source: Source, config: ScorerConfig, device: str, n_workers: int | None, engine: Engine
) -> tuple[Scorer, EpisodeEmbeddings]:
    """Build the scorer, and open the embeddings: of distinct states where frames are rendered from them."""
    frames = source.frames
    ring = frames.ring if isinstance(frames, KitchenStates) else None
    config.load_embedder(device)  # refused before the goal's pictures are kept
    scorer = Scorer.build(config, read_source_goal(config.goal, source, cached=True), views=ring, device=device)
    options: dict[str, Any] = {"device": device, "n_workers": n_workers, "engine": engine}
    return scorer, open_embeddings(source, **config.embedding(), **options)


def open_embeddings(source: Source, embedder: str, precision: Precision = "auto", **options: Any) -> EpisodeEmbeddings:
    """Open the embeddings of a dataset: of its distinct states in the kitchen, else of its frames.

    Arguments and errors are those of `StateEmbedder` and `FrameEmbeddings`.
    """
    frames = source.frames
    if isinstance(frames, KitchenStates):
        return StateEmbeddings(StateEmbedder(frames.ring, embedder, precision, **options), frames.states)
    return FrameEmbeddings(source, embedder, precision, **options)


def view_cannot_tell(scorer: Scorer, frames: EpisodeFrames, episodes: Iterable[EmbeddedEpisode]) -> bool:
    """Return `Scorer.view_cannot_tell` where there is one view, in which the robot is not hidden; else False."""
    of_pictures = scorer.goal is not None and not scorer.goal.is_text
    is_masked = isinstance(frames, KitchenStates | SceneStates | MaskedFrames)
    return len(frames.views) == 1 and not is_masked and of_pictures and scorer.view_cannot_tell(episodes)


def _write_scorer(folder: Path, scorer: Scorer, frames: EpisodeFrames) -> None:
    """Save the scorer in a dataset's folder if it can score online, and thumbnails of the goal's pictures."""
    if isinstance(frames, SceneStates):
        replace(scorer, views=frames.state_views()).save(folder / SCORER_FILE)
    elif scorer.views is not None:
        scorer.save(folder / SCORER_FILE)
    goal = scorer.goal
    if goal is None or goal.is_text:
        return
    for part, pictures in (("init", goal.starts), ("goal", goal.goals)):
        (folder / GOAL_FOLDER / part).mkdir(parents=True)
        for i, picture in enumerate(pictures[:MAX_THUMBNAILS]):
            thumbnail = Image.fromarray(np.asarray(picture))
            thumbnail.thumbnail((THUMBNAIL, THUMBNAIL))
            thumbnail.save(folder / GOAL_FOLDER / part / f"{i}.png")
