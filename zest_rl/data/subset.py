"""Some episodes of a dataset → a dataset of them alone, the same bit for bit; the source is left as it is."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import h5py
from numpy.typing import NDArray

from zest_rl.data.folders import CARD_FILE, DATA_FILE, MANIFEST_FILE, METADATA_FILE
from zest_rl.data.hdf5 import open_hdf5
from zest_rl.data.provenance import CurateRecord
from zest_rl.data.reader import Dataset
from zest_rl.data.writer import DatasetCopy, write_scored
from zest_rl.runtime import artifacts
from zest_rl.types import FloatArray


@dataclass(frozen=True)
class DatasetSubset:
    """The `zest_rl.data.writer.Trajectories` of some episodes of a Minari dataset; made by `of` from an open one."""

    whole: DatasetCopy
    names: tuple[str, ...]
    """The episodes by their names in the whole file; they become ``episode_0``, … in this order."""
    n_steps: tuple[int, ...]
    """T of every episode."""

    @classmethod
    def of(cls, ds: Dataset, episodes: Sequence[int]) -> Self:
        """Take the episodes with these indices."""
        names = tuple(list(ds.groups)[i] for i in episodes)
        return cls(DatasetCopy.of(ds), names, tuple(ds.lengths[name] for name in names))

    @property
    def dataset_id(self) -> str:
        """Id of the whole dataset."""
        return self.whole.dataset_id

    @property
    def n_bytes(self) -> int:
        """Size of the whole HDF5 file."""
        return self.whole.n_bytes

    def fingerprint(self) -> str:
        """Hash of the whole dataset, and the names of the episodes."""
        return artifacts.hash_json([self.whole.fingerprint(), self.names])

    def rewards_to_keep(self) -> Sequence[FloatArray | None]:
        """None beside those that are copied."""
        return [None] * len(self.names)

    def fill(self, folder: Path) -> None:
        """Copy the episodes, and the metadata with their number.

        Raises:
            ZestError: a file was changed since it was read.
        """
        self.whole.fill(folder)
        everything = folder / "everything.hdf5"
        (folder / DATA_FILE).rename(everything)
        with h5py.File(everything, "r") as source, h5py.File(folder / DATA_FILE, "w") as target:
            target.attrs.update(source.attrs)
            for i, name in enumerate(self.names):
                source.copy(name, target, name=f"episode_{i}")
                if "id" in target[f"episode_{i}"].attrs:
                    target[f"episode_{i}"].attrs["id"] = i
        everything.unlink()
        metadata = artifacts.read_json(folder / METADATA_FILE)
        counts = {"total_episodes": len(self.names), "total_steps": sum(self.n_steps)}
        size = {"dataset_size": round((folder / DATA_FILE).stat().st_size / 1e6, 1)}  # MB, as Minari counts
        artifacts.write_json(folder / METADATA_FILE, {**metadata, **counts, **size})

    def written(self) -> Iterator[Mapping[str, NDArray[Any]]]:
        """Yield the numbers of each episode."""
        with open_hdf5(self.whole.path / DATA_FILE) as file:
            for name in self.names:
                arrays = dict[str, NDArray[Any]]()

                def read(path: str, node: Any, arrays: dict[str, NDArray[Any]] = arrays) -> None:
                    if isinstance(node, h5py.Dataset) and node.dtype.kind in "biuf":
                        arrays[path] = node[()]

                file[name].visititems(read)
                yield arrays


def write_subset(
    subset: DatasetSubset,
    dataset_id: str,
    rewards: Sequence[FloatArray],
    scores: Sequence[FloatArray],
    record: CurateRecord,
    description: str,
) -> None:
    """Write some episodes of a relabeled dataset, with its scorer and its goal's thumbnails.

    Args:
        subset: the episodes.
        dataset_id: the new id; must not exist.
        rewards: (T,) of these episodes.
        scores: (T+1,) of them.
        record: kept in the metadata beside those of earlier stages.
        description: one sentence, for the metadata and the dataset's card.

    Raises:
        BadInput, ZestError: as `zest_rl.data.writer.write_scored`.
    """
    source = subset.whole.path

    def add(folder: Path) -> None:
        for name in artifacts.read_json(source / MANIFEST_FILE).keys() - {DATA_FILE, METADATA_FILE}:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source / name, folder / name)
        card = source / CARD_FILE
        of_source = f"\nThe card of that dataset:\n\n{card.read_text(encoding='utf-8')}" if card.is_file() else ""
        artifacts.write_bytes(folder / CARD_FILE, f"# {dataset_id}\n\n{description}\n{of_source}".encode())

    zest = {"relabel": artifacts.read_json(source / METADATA_FILE)["zest"]["relabel"], "curate": asdict(record)}
    write_scored(subset, dataset_id, rewards, scores, description=description, zest=zest, extra=add)
