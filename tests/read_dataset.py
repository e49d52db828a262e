"""Opens a dataset for a single read, as tests do."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

from zest_rl.data.reader import Dataset, open_dataset

T = TypeVar("T")


def read(dataset_id: str, what: Callable[[Dataset], T]) -> T:
    """Return what is read of a dataset: ``read(name, Dataset.scores)``."""
    with open_dataset(dataset_id) as ds:
        return what(ds)


READERS: dict[str, Callable[[str], Any]] = {
    what.__name__: partial(read, what=what)
    for what in (
        Dataset.episodes,
        Dataset.states,
        Dataset.truth,
        Dataset.scores,
        Dataset.fingerprint,
        Dataset.describe,
        Dataset.kitchen_task,
    )
}
"""By name, what reads a dataset by its id."""
