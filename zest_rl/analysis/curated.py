"""A relabeled dataset → a dataset of the episodes that are worth most, and a table that says why; see `curation`."""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from zest_rl.analysis.curation import RankedEpisode, n_to_keep, rank_episodes
from zest_rl.analysis.curation_quality import CurationQuality, measure_curation
from zest_rl.analysis.recordings import open_recording
from zest_rl.data.folders import exists
from zest_rl.data.provenance import CurateRecord
from zest_rl.data.reader import open_dataset
from zest_rl.data.subset import DatasetSubset, write_subset
from zest_rl.errors import BadInput
from zest_rl.runtime import artifacts


@dataclass(frozen=True)
class Curation:
    """Result of `curate`."""

    source: str
    """Id of the dataset that was curated; it is left as it is."""
    ranking: tuple[RankedEpisode, ...]
    """The best first."""
    n_kept: int
    """The first so many of the ranking are kept."""
    names: tuple[str, ...]
    """By index in the source: the episode's name in the recording, else its number before any were dropped."""
    quality: CurationQuality | None
    """None without ground truth."""
    suits_agents: bool
    """Whether the package's agents can learn from it."""
    dataset_id: str | None = None
    """The dataset of the kept episodes; this and the following are None where nothing was written."""
    table: Path | None = None
    """CSV with a row and a weight per episode."""
    masks: Path | None = None
    """Of a robomimic file: HDF5 with the masks ``kept`` and ``dropped``."""
    command: str | None = None
    """Of a recording: what to type to use the kept episodes."""

    @property
    def kept(self) -> list[int]:
        """Indices in the source, in its order."""
        return sorted(episode.index for episode in self.ranking[: self.n_kept])

    @property
    def dropped(self) -> list[int]:
        """Indices in the source, the worst first."""
        return [episode.index for episode in reversed(self.ranking[self.n_kept :])]

    def rows(self) -> list[dict[str, Any]]:
        """Return a row per episode, the worst first; its weight is its worth, scaled to [0, 1] over the dataset."""
        low, high = self.ranking[-1].worth, self.ranking[0].worth
        return [
            {
                "episode": each.index,
                "name": self.names[each.index],
                "keep": place < self.n_kept,
                "weight": (each.worth - low) / (high - low) if high > low else 1.0,
                **{name: getattr(each, name) for name in ("worth", "mean", "end", "progress", "still", "dip", "words")},
            }
            for place, each in reversed(list(enumerate(self.ranking)))
        ]


def curate(
    dataset_id: str,
    keep: float = 0.8,
    *,
    source: str | Path | None = None,
    output: Path | None = None,
    dry_run: bool = False,
) -> Curation:
    """Rank the episodes of a relabeled dataset, and write one of those that are worth most.

    The new dataset has the kept episodes in their order, with observations, actions, rewards, scores and ground truth
    as they were, and the scorer: it is trained on, evaluated and inspected as its source is.

    Args:
        dataset_id: relabeled.
        keep: share of the episodes to keep, in (0, 1]; their number is rounded, at least 1.
        source: the robomimic file or LeRobot folder that it was relabeled from, to curate that, too.
        output: the table; default DATASET.curated.csv in the current folder. Masks lie beside it.
        dry_run: write nothing.

    Raises:
        BadInput: no such dataset, it was not relabeled or by the scores of other episodes, `keep` is out of range or
            drops nothing, `source` is another recording.
        ZestError: the disk is full or read-only; nothing is left behind.
    """
    table = output or Path(f"{dataset_id.split('/')[-1]}.curated.csv")
    if table.suffix != ".csv":
        raise BadInput(f"the table is a CSV file, got --output {table}; give it the suffix .csv")
    if not 0 < keep <= 1:
        raise BadInput(f"--keep must be above 0 and at most 1, got {keep}; 0.8 keeps the best 80 % of the episodes")
    with open_dataset(dataset_id) as ds:
        record = ds.record
        if record.relabel is None:
            raise BadInput(
                f"dataset {dataset_id} holds no ZeST scores; run `zest relabel {dataset_id}` and curate that"
            )
        if record.relabel.shuffle is not None:
            raise BadInput(f"{dataset_id} has the scores of other episodes (--shuffle); relabel without, curate that")
        all_scores, all_rewards = ds.scores(), ds.rewards()
        ranking = rank_episodes(all_scores)
        n, n_kept = len(ranking), n_to_keep(keep, len(ranking))
        if n == 1:
            raise BadInput("a dataset must have at least 2 episodes to drop some, got 1; record more")
        if n_kept == n:
            raise BadInput(f"--keep {keep} of {n} episodes drops none; give at most {1 - 1 / n:.4g}")
        quality = measure_curation(ds, ranking, n - n_kept)
        recording = None if source is None else open_recording(source, record)
        numbers = tuple(range(n)) if record.curate is None else record.curate.episodes
        names = tuple(str(number) if recording is None else recording.names[number] for number in numbers)
        curation = Curation(dataset_id, tuple(ranking), n_kept, names, quality, ds.suits_agents)
        if dry_run:
            return curation
        subset = DatasetSubset.of(ds, curation.kept)
    rewards, scores = ([of_all[i] for i in curation.kept] for of_all in (all_rewards, all_scores))
    digest = artifacts.hash_json([subset.fingerprint(), artifacts.hash_arrays(*rewards, *scores)])
    target = re.sub(r"-v(\d+)$", rf"-curated-{digest[:8]}-v\1", dataset_id)
    if not exists(target):
        made = CurateRecord(dataset_id, tuple(numbers[i] for i in curation.kept), artifacts.provenance())
        description = f"The {n_kept} of the {n} episodes of {dataset_id} that are worth most, by `zest curate`."
        write_subset(subset, target, rewards, scores, made, description)
    _write_table(table, curation.rows())
    curation = replace(curation, dataset_id=target, table=table)
    if recording is None:
        return curation
    kept = [numbers[i] for i in curation.kept]
    dropped = sorted(set(range(len(recording.names))) - set(kept))
    masks, command = recording.write_curation(kept, dropped, table.with_suffix(".hdf5"))
    return replace(curation, masks=masks, command=command)


def _write_table(path: Path, rows: list[dict[str, Any]]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({**row, "keep": int(row["keep"])} for row in rows)
    artifacts.write_bytes(path, text.getvalue().encode())
