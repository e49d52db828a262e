"""The recording of a relabeled dataset, a robomimic file or a LeRobot folder: how its own tools leave episodes out."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py

from zest_rl.data.provenance import DatasetRecord
from zest_rl.errors import BadInput
from zest_rl.runtime import artifacts
from zest_rl.runtime.child import write_in_child
from zest_rl.runtime.files import user_path
from zest_rl.sources.conversion import ConvertedTrajectories
from zest_rl.sources.lerobot import is_lerobot, open_lerobot
from zest_rl.sources.robomimic import open_robomimic

KEPT, DROPPED = "kept", "dropped"
"""Names of the masks."""


@dataclass(frozen=True)
class Recording:
    """A recording, and its own names of the episodes."""

    trajectories: ConvertedTrajectories

    @property
    def names(self) -> Sequence[str]:
        """``demo_3`` of robomimic, the ``episode_index`` of LeRobot."""
        return self.trajectories.names

    def write_curation(self, kept: Sequence[int], dropped: Sequence[int], path: Path) -> tuple[Path | None, str]:
        """Say how to train on the kept episodes alone; the recording stays as it is.

        Args:
            kept: indices of episodes.
            dropped: the others.
            path: of the masks, for robomimic.

        Returns:
            The file of the masks, None for LeRobot; and the command to type next.
        """
        source = self.trajectories.path
        if self.trajectories.format == "LeRobot":
            return None, delete_command(source, sorted(int(self.names[i]) for i in dropped))
        with artifacts.atomic_path(path) as staging:
            names = {KEPT: [self.names[i] for i in kept], DROPPED: [self.names[i] for i in dropped]}
            write_in_child("the masks", _write_masks, staging, os.path.relpath(source, path.resolve().parent), names)
        return path, f"python -m robomimic.scripts.get_dataset_info --dataset {shlex.quote(str(path))}"


def delete_command(folder: Path, episodes: Sequence[int]) -> str:
    """Return the command of LeRobot that writes a folder without these episodes.

    Flags: lerobot 0.6.1, `scripts/lerobot_edit_dataset.py`.
    """
    name, new = f"local/{folder.name}", folder.with_name(f"{folder.name}-curated")
    words = ["lerobot-edit-dataset", "--repo_id", name, "--root", str(folder)]
    words += ["--new_repo_id", f"{name}-curated", "--new_root", str(new)]
    words += ["--operation.type", "delete_episodes", "--operation.episode_indices", json.dumps(list(episodes))]
    return shlex.join(words)


def open_recording(path: str | Path, record: DatasetRecord) -> Recording:
    """Open the recording that a dataset was relabeled from.

    Args:
        path: of a robomimic file or a LeRobot folder.
        record: of the relabeled dataset.

    Raises:
        BadInput: it is neither, or another one than what was relabeled.
    """
    source, relabel = user_path(path), record.relabel
    assert relabel is not None
    frames = relabel.frames or {}
    views = () if frames.get("kind") == "clips" else tuple(frames.get("views", ()))
    keys = [str(view).removeprefix("obs/") for view in views]
    if is_lerobot(source):
        trajectories, _ = open_lerobot(source, keys, with_frames=bool(keys), skip_incomplete=True)
    elif source.is_file():
        trajectories, _ = open_robomimic(source, keys, with_frames=False)
    else:
        raise BadInput(f"--source must be a robomimic HDF5 file or a LeRobot folder, got {source}")
    if trajectories.fingerprint() != relabel.source_sha256:
        raise BadInput(
            f"{source} holds other episodes than those that {record.id} was relabeled from; give that recording, or "
            "relabel this one"
        )
    return Recording(trajectories)


def _write_masks(path: Path, source: str, names: dict[str, list[str]]) -> None:
    """Write robomimic's masks (filter keys) into a file whose ``data`` is that of the recording."""
    with h5py.File(path, "w") as file:
        file["data"] = h5py.ExternalLink(source, "/data")
        for mask, members in names.items():
            file[f"mask/{mask}"] = [name.encode() for name in members]
