"""Files of a dataset's folder that lie elsewhere, or are of another kind, and what a dataset's own manifest may say."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from read_dataset import read

from zest_rl.data import reader
from zest_rl.data.folders import DATA_FILE, MANIFEST_FILE, METADATA_FILE
from zest_rl.data.reader import Dataset
from zest_rl.errors import BadInput, ZestError


def link_elsewhere(path: Path) -> None:
    shutil.move(path, path.with_suffix(".moved"))
    path.symlink_to(path.with_suffix(".moved").name)


def to_zeros(path: Path) -> None:
    path.unlink()
    path.symlink_to("/dev/zero")


def to_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


@pytest.mark.parametrize("name", [DATA_FILE, METADATA_FILE, MANIFEST_FILE])
@pytest.mark.parametrize("change", [link_elsewhere, to_zeros, to_pipe])
def test_a_file_that_is_a_link_or_no_file_is_refused_and_never_waited_for(
    name: str, change: Callable[[Path], None], collected: str
) -> None:
    change(reader.dataset_path(collected) / name)
    with pytest.raises(
        BadInput, match=rf"{name} of dataset {collected} must be a regular file in its folder.*link the"
    ):
        read(collected, Dataset.episodes)


def test_a_folder_of_files_that_is_a_link_is_refused(collected: str) -> None:
    link_elsewhere(reader.dataset_path(collected) / "data")
    with pytest.raises(BadInput, match=f"{DATA_FILE} of dataset {collected} must be a regular file in its folder"):
        read(collected, Dataset.episodes)


def test_a_whole_dataset_may_be_a_link(collected: str, tmp_path: Path) -> None:
    folder, before = reader.dataset_path(collected), read(collected, Dataset.fingerprint)
    shutil.move(folder, tmp_path / "large disk")
    folder.symlink_to(tmp_path / "large disk")
    assert read(collected, Dataset.fingerprint) == before
    assert reader.list_datasets() == [collected]


def test_an_entry_that_cannot_be_read_hides_no_dataset(collected: str) -> None:
    root = reader.datasets_root()
    for i in range(30):  # whatever the order of the folder
        (root / f"wrong-{i}").symlink_to("x" * 300)
    assert reader.list_datasets() == [collected]


@pytest.mark.parametrize(
    "name",
    ["../../dev/zero", "/dev/zero", "../kitchen-micro-tiny-v0/data/metadata.json", "data", "", ".", "\0", "a" * 999],
)
def test_a_manifest_names_files_of_its_folder_alone(name: str, collected: str) -> None:
    path = reader.dataset_path(collected) / MANIFEST_FILE
    path.write_text(json.dumps({**json.loads(path.read_text()), name: "0" * 64}))
    with pytest.raises(ZestError, match=f"of dataset {collected} is missing or was changed since it was written"):
        read(collected, Dataset.episodes)


@pytest.mark.parametrize(
    "change", [lambda manifest: manifest.pop(DATA_FILE), lambda manifest: manifest.pop(METADATA_FILE)]
)
def test_a_manifest_lists_both_files(change: Callable[[dict[str, str]], Any], collected: str) -> None:
    path = reader.dataset_path(collected) / MANIFEST_FILE
    manifest = json.loads(path.read_text())
    change(manifest)
    path.write_text(json.dumps(manifest))
    with pytest.raises(BadInput, match=rf"{MANIFEST_FILE} of dataset {collected} must map {DATA_FILE} and"):
        read(collected, Dataset.episodes)


@pytest.mark.parametrize("name", [MANIFEST_FILE, METADATA_FILE])
@pytest.mark.parametrize(
    ("content", "rule"),
    [
        ("[]", "must"),
        ('"x"', "must"),
        ("[" * 100_000, "cannot be read as JSON"),
        ('{"a": 1' + "0" * 5000 + "}", "cannot be read as JSON"),
        ("", "is empty"),
    ],
    ids=["list", "text", "deep", "great", "empty"],
)
def test_another_document_is_refused(name: str, content: str, rule: str, collected: str) -> None:
    folder = reader.dataset_path(collected)
    if name == METADATA_FILE:
        (folder / MANIFEST_FILE).unlink()
    (folder / name).write_text(content)
    with pytest.raises(ZestError, match=f"{name}.* {rule}"):
        read(collected, Dataset.episodes)
