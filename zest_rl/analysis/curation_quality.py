"""Does a ranking of episodes find the failures? It is compared with the ground truth, which it has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from zest_rl.analysis.curation import RankedEpisode
from zest_rl.data.reader import Dataset
from zest_rl.metrics.reward_quality import average_precision, precision_at
from zest_rl.metrics.statistics import Estimate


@dataclass(frozen=True)
class CurationQuality:
    """How well the episodes of lowest worth are the bad ones; a random ranking has their share in every figure."""

    bad: str
    """What counts as bad."""
    n_bad: int
    n_dropped: int
    auprc: Estimate
    """Area under the precision-recall curve."""
    auprc_by_length: Estimate
    """Of a ranking by the number of steps: the longest or the shortest first, whichever is better."""
    precision: Estimate
    """Share of bad episodes among the dropped ones."""
    recall: float
    """Share of the bad episodes that are dropped."""
    at_random: float
    """Share of bad episodes in the dataset."""

    def to_json(self) -> dict[str, Any]:
        """The form that it has in the result of `zest curate --json`."""
        return {
            name: value.as_json() if isinstance(value, Estimate) else value for name, value in self.__dict__.items()
        }


def measure_curation(ds: Dataset, ranking: Sequence[RankedEpisode], n_dropped: int) -> CurationQuality | None:
    """Compare a ranking with the ground truth; None where there is none, or where it tells no episodes apart.

    Bad are the failures; where success is not recorded or is that of all episodes, as many as are dropped of the
    lowest true return.

    Args:
        ds: an open dataset.
        ranking: of all its episodes.
        n_dropped: the last so many of the ranking are dropped.
    """
    if not ds.has_truth:
        return None
    truth = ds.truth()
    returns = np.array([episode.rewards.sum(dtype=np.float64) for episode in truth])
    failed = np.array([episode.success is False for episode in truth])
    if failed.any() and not failed.all():
        what, bad = "failures", failed
    elif np.ptp(returns) > 0:
        what, bad = f"the {n_dropped} of the lowest true return", np.zeros(len(returns), dtype=bool)
        bad[np.argsort(returns, kind="stable")[:n_dropped]] = True
    else:
        return None
    suspicion = np.empty(len(ranking))
    suspicion[[episode.index for episode in ranking]] = [-episode.worth for episode in ranking]
    lengths = np.array(ds.n_steps(), dtype=np.float64)
    by_length = max((average_precision(sign * lengths, bad) for sign in (1, -1)), key=lambda each: each.value)
    precision = precision_at(n_dropped, suspicion, bad)
    return CurationQuality(
        what,
        int(bad.sum()),
        n_dropped,
        average_precision(suspicion, bad),
        by_length,
        precision,
        precision.value * n_dropped / int(bad.sum()),
        float(bad.mean()),
    )
