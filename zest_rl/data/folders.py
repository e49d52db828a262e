"""The folders of Minari's datasets, and their files: all are the folder's own, and as the manifest says they were."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from zest_rl.data.env_specs import entry_points
from zest_rl.errors import BadInput, ZestError, nearest
from zest_rl.runtime import artifacts

DATASET_ID = re.compile(r"(?:[A-Za-z0-9][\w.-]+/)*[A-Za-z0-9][\w.-]*-v\d+")
DATA_FILE, METADATA_FILE, MANIFEST_FILE = "data/main_data.hdf5", "data/metadata.json", "zest_manifest.json"
CARD_FILE = "README.md"
"""For readers, who may add to it: not in the manifest."""
GOAL_FOLDER = "zest_goal"
"""Thumbnails of the goal's pictures, in a relabeled dataset."""


def datasets_root() -> Path:
    """Minari's folder of local datasets: ``$MINARI_DATASETS_PATH``, else ``~/.minari/datasets``. Not created here."""
    return artifacts.folder_of("MINARI_DATASETS_PATH")


def dataset_path(dataset_id: str) -> Path:
    """Return the folder of a dataset id, whether or not it exists.

    Raises:
        BadInput: the id is not of the form ``namespace/name-vN`` (so ``..`` cannot lead out of the root).
    """
    if not DATASET_ID.fullmatch(dataset_id) or ".." in dataset_id:
        raise BadInput(
            f"a dataset id must look like 'namespace/name-v0' (letters, digits, '.', '_', '-'; namespace of at least "
            f"2 characters), got {dataset_id!r}"
        )
    return datasets_root() / dataset_id


def list_datasets() -> list[str]:
    """Return the ids of all complete datasets under the root, sorted."""
    root = datasets_root()
    return sorted(folder.relative_to(root).as_posix() for folder in _datasets_in(root))


def _datasets_in(folder: Path, above: tuple[Path, ...] = ()) -> Iterator[Path]:
    """Yield the datasets below a folder, links to folders included; `above`: the folders that led here."""
    here = folder.resolve()
    if here in above:  # a link that leads back
        return
    entries = []
    with suppress(OSError):  # no root yet, or a folder of somebody else
        entries = list(folder.iterdir())
    for entry in entries:
        with suppress(OSError):  # for instance a link to a name that is too long
            if entry.name.startswith(".") or not entry.is_dir():
                continue
            if (entry / METADATA_FILE).exists():
                yield entry
            else:
                yield from _datasets_in(entry, (*above, here))


def exists(dataset_id: str) -> bool:
    """Whether a complete dataset of this id is on disk."""
    return (dataset_path(dataset_id) / METADATA_FILE).exists()


def verified_metadata(dataset_id: str) -> dict[str, Any]:
    """Return a dataset's metadata after comparing its files with their hashes.

    Raises:
        BadInput: no such dataset; a file is a link or no regular file; the metadata or the manifest break a rule.
        ZestError: a file is missing or was changed since it was written.
    """
    folder, what = dataset_path(dataset_id), f"dataset {dataset_id}"
    if not exists(dataset_id):
        raise BadInput(
            f"there is no dataset {dataset_id!r} under the Minari root; {nearest(dataset_id, list_datasets())}. "
            f"Make one with `zest collect`, fetch a public one with `minari download {dataset_id}` (after "
            "`export MINARI_REMOTE=hf://OWNER` one of OWNER, as `zest push` uploads it), or set "
            "MINARI_DATASETS_PATH to the folder that holds it"
        )
    files = _files(folder)
    for name in (DATA_FILE, METADATA_FILE, MANIFEST_FILE):
        if name not in files and os.path.lexists(folder / name):
            raise BadInput(
                f"{name} of {what} must be a regular file in its folder, got a link or a device; copy the file there, "
                "or link the whole folder of the dataset"
            )
    if MANIFEST_FILE in files:
        for name, digest in _manifest(folder / MANIFEST_FILE, what).items():
            if name not in files or artifacts.hash_file(folder / name) != digest:
                raise ZestError(
                    f"{name} of {what} is missing or was changed since it was written; make the dataset again, or, if "
                    f"you changed it on purpose, delete its {MANIFEST_FILE}"
                )
    metadata = artifacts.read_json(folder / METADATA_FILE)
    if not isinstance(metadata, dict):
        raise BadInput(f"{METADATA_FILE} of {what} must be a JSON object, got {type(metadata).__name__}")
    for key in ("env_spec", "eval_env_spec"):
        if metadata.get(key):
            entry_points(metadata[key], f"the {key} of {what}")
    return metadata


def _files(folder: Path) -> set[str]:
    """Return the regular files below a folder by their paths in it; nothing that a link leads to is among them."""
    return {
        path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file() and not path.is_symlink()
    }


def _manifest(path: Path, what: str) -> dict[str, Any]:
    manifest = artifacts.read_json(path)
    if not isinstance(manifest, dict) or not {DATA_FILE, METADATA_FILE} <= manifest.keys():
        raise BadInput(
            f"{MANIFEST_FILE} of {what} must map {DATA_FILE} and {METADATA_FILE} to their sha256; download the dataset "
            "or make it again"
        )
    return manifest
