"""A dataset and a learned reward → a copy with that reward, and the embeddings that some learned rewards are of."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from zest_rl.data.folders import CARD_FILE, dataset_path, exists
from zest_rl.data.reader import Dataset, open_dataset
from zest_rl.data.writer import DatasetCopy, write_scored
from zest_rl.errors import BadInput
from zest_rl.rewards.cards import dataset_card
from zest_rl.rewards.learned import LearnedReward
from zest_rl.rewards.scorer import SCORER_FILE
from zest_rl.rewards.state_scorer import StateScorer
from zest_rl.runtime import artifacts
from zest_rl.runtime.hub import REWARD_FILES, local_run
from zest_rl.types import FloatArray


@dataclass(frozen=True)
class RelabeledByRun:
    """Result of `relabel_by_run`."""

    dataset_id: str
    path: Path
    already_there: bool
    """Whether the dataset existed."""


def relabel_by_run(dataset_id: str, run_dir: str | Path, **options: Any) -> RelabeledByRun:
    """Write a copy of a dataset with the rewards of a finished `zest train trex`: r_t is that of o_{t+1} or x_{t+1}.

    The rewards of all T + 1 observations are kept as the scores. All else, ground truth included, stays the same.

    Args:
        dataset_id: of the environment whose trajectories were ranked; its own rewards do not matter.
        run_dir: folder of the run, or ``hf://OWNER/NAME``.
        options: of a reward of embeddings, as in `embeddings_of`.

    Raises:
        BadInput: the run is no reward, or of another task, environment or observation space; or its trajectories were
            not ranked by ZeST scores.
        ZestError: the disk is full or read-only; nothing is left behind.
    """
    run_dir = local_run(run_dir)
    reward = LearnedReward.load(run_dir)
    ranked = reward.record
    if ranked.relabel is None:
        raise BadInput(
            f"{run_dir} learned from {ranked.id}, which was not ranked by ZeST scores; run `zest relabel` on that, and "
            "`zest train trex` on the dataset that it writes"
        )
    with open_dataset(dataset_id) as ds:
        reward.check_fits(ds.record)
        copy, source = DatasetCopy.of(ds), ds.record.source_id
        target = _target_id(source, copy.sha256, reward)
        if exists(target):
            return RelabeledByRun(target, dataset_path(target), already_there=True)
        if reward.inputs == "obs":
            scores = [reward.of_obs(episode.obs) for episode in ds.episodes()]
        else:
            scores = [reward.of_embeddings(frames) for frames in embeddings_of(ds, run_dir / SCORER_FILE, **options)]
    held_out = reward.meta.get("held_out", {})
    learned = {"ranked": ranked.id, "inputs": reward.inputs, "sha256": reward.sha256, "held_out": held_out}
    record = replace(
        ranked.relabel,
        source=source,
        source_sha256=copy.sha256,
        reward="level",
        n_still_frames=None,
        learned=learned,
        provenance=artifacts.provenance(),
    )

    def add(folder: Path) -> None:
        artifacts.write_bytes(folder / CARD_FILE, dataset_card(target, record, scores).encode())
        for name in REWARD_FILES:
            artifacts.write_bytes(folder / name, (run_dir / Path(name).name).read_bytes())

    write_scored(
        copy,
        target,
        [score[1:] for score in scores],
        scores,
        description=f"Rewards were learned (T-REX, of {reward.inputs}) from the ranking of {ranked.id}.",
        zest={"relabel": record.to_json()},
        extra=add,
    )
    return RelabeledByRun(target, dataset_path(target), already_there=False)


def _target_id(source: str, sha256: str, reward: LearnedReward) -> str:
    """``zest/kitchen-micro-noisy-v0`` → ``zest/kitchen-micro-noisy-trex-1a2b3c4d-v0``."""
    digest = artifacts.hash_json([sha256, reward.sha256])
    return re.sub(r"-v(\d+)$", rf"-trex-{digest[:8]}-v\1", source)


def embeddings_of(ds: Dataset, scorer_file: Path, **options: Any) -> Iterator[FloatArray]:
    """Yield the embeddings (T+1, V, D) of all frames of every episode, as a scorer sees them.

    Args:
        ds: a dataset of the kitchen.
        scorer_file: of the dataset or the run.
        options: device, n_workers, engine, as in `zest_rl.rewards.state_embeddings.StateEmbedder`.

    Raises:
        BadInput: the frames are not rendered from the states of the kitchen.
        ZestError: there is no scorer, or it was made with another embedder or renderer than those installed.
    """
    if ds.record.task is None:
        raise BadInput(f"embeddings are those of kitchen states, but {ds.id} has none; use --inputs obs")
    scorer = StateScorer.load(scorer_file, **options)
    for episode in scorer.embeddings(ds.states()):
        yield episode.embeddings[episode.index]
