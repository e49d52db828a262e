"""Rewards that somebody gives as numbers → a copy of the dataset that has them, to train on and to report."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict
from itertools import zip_longest

import numpy as np
from numpy.typing import ArrayLike

from zest_rl.data.folders import exists
from zest_rl.data.provenance import GivenRecord
from zest_rl.data.reader import open_dataset
from zest_rl.data.writer import DatasetCopy, write_scored
from zest_rl.errors import BadInput
from zest_rl.runtime import artifacts


def with_rewards(dataset_id: str, rewards: Sequence[ArrayLike], label: str = "given") -> str:
    """Write a copy of a dataset that has other rewards; everything else, ground truth included, stays the same.

    Args:
        dataset_id: relabeled or not; ZeST scores and their scorer are left out of the copy.
        rewards: (T,) of every episode, in order; r_t rewards a_t.
        label: a word that reports and the new id call them by.

    Returns:
        The new id, ``NAME-LABEL-HASH-vN`` by content; a dataset that exists under it is the same one.

    Raises:
        BadInput: there is no such dataset, `label` is no word, or a reward is missing or not finite.
        ZestError: the disk is full or read-only; nothing is left behind.
    """
    if not re.fullmatch(r"\w+", label, re.ASCII):
        raise BadInput(f"a label must be one word of letters, digits and _, got {label!r}")
    arrays = [np.asarray(episode, dtype=np.float32) for episode in rewards]
    with open_dataset(dataset_id) as ds:
        copy, source = DatasetCopy.of(ds), ds.record.source_id
    shapes = zip_longest([array.shape for array in arrays], [(n,) for n in copy.n_steps])
    for i, (got, needed) in enumerate(shapes):
        if got != needed:
            raise BadInput(
                f"there must be one reward per action, shape {needed} for episode {i}, got {got}; of T + 1 scores "
                "leave out the first"
            )
    digest = artifacts.hash_json([copy.sha256, artifacts.hash_arrays(*arrays), label])
    target = re.sub(r"-v(\d+)$", rf"-{label}-{digest[:8]}-v\1", source)
    if not exists(target):
        record = GivenRecord(label, source, copy.sha256, artifacts.provenance())
        description = f"Rewards ({label}) were given as numbers."
        write_scored(copy, target, arrays, None, description=description, zest={"given": asdict(record)})
    return target
