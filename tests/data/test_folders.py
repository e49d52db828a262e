"""Ids of datasets, files that lie elsewhere or are of another kind, and what a dataset's own manifest may say."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from read_dataset import READERS, read

from zest_rl.data import reader
from zest_rl.data.folders import DATA_FILE, MANIFEST_FILE, METADATA_FILE
from zest_rl.data.reader import Dataset
from zest_rl.errors import BadInput, ZestError

# --- ids --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "dataset_id",
    ["", "..", "../x-v0", "zest/../../x-v0", "x", "a/b", "a/b-v0", "zest/", "/zest/x-v0", "zest//x-v0", "zest/x-v",
     "zest/x-v0/", "zest/x-v0\n", "zest/.x-v0", "zest/x y-v0", "zest/x\\y-v0", "~/x-v0", "zest/x..y-v0", "C:/x-v0"],
)  # fmt: skip
def test_a_malformed_id_is_refused_before_anything_is_made(
    dataset_id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    for refuse in (reader.dataset_path, reader.exists, *READERS.values()):
        with pytest.raises(BadInput, match="a dataset id must look like 'namespace/name-v0'"):
            refuse(dataset_id)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("dataset_id", ["zest/kitchen-micro-noisy-v0", "kitchen-v12", "a1/b.c/d_e-f-v3", "zest/v-v0"])
def test_a_well_formed_id_is_a_folder_below_the_root(
    dataset_id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    assert reader.dataset_path(dataset_id) == tmp_path / dataset_id
    assert not reader.exists(dataset_id)


@given(st.lists(st.sampled_from(["..", ".", "/", "a", "zest", "-v0", "x-v0", "~", "\\", "\n", " "]), max_size=6))
def test_no_id_leads_out_of_the_root(parts: list[str]) -> None:
    try:
        path = reader.dataset_path("".join(parts))
    except BadInput:
        return
    assert path.resolve().is_relative_to(reader.datasets_root().resolve())
    assert path != reader.datasets_root()


def test_the_root_is_where_minari_looks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    assert reader.datasets_root() == tmp_path / "minari"
    monkeypatch.delenv("MINARI_DATASETS_PATH")
    assert reader.datasets_root() == Path.home() / ".minari/datasets"


@pytest.mark.parametrize("read_by_id", READERS.values(), ids=READERS)
def test_a_missing_dataset_names_the_nearest(read_by_id: Callable[[str], Any], collected: str) -> None:
    with pytest.raises(BadInput, match=rf"no dataset 'zest/kitchen-mirco-tiny-v0' .*did you mean '{collected}'\?"):
        read_by_id("zest/kitchen-mirco-tiny-v0")


def test_without_any_dataset_the_message_says_how_to_make_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    with pytest.raises(BadInput, match=r"valid: \(none\)\. Make one with `zest collect`"):
        read("zest/x-v0", Dataset.episodes)
    assert reader.list_datasets() == []


def test_complete_datasets_are_listed_and_staged_ones_are_not(collected: str) -> None:
    folder = reader.dataset_path(collected)
    shutil.copytree(folder, folder.parent / ".other-v0.staging")
    shutil.copytree(folder, reader.datasets_root() / "alone-v1")
    assert reader.list_datasets() == ["alone-v1", collected]
    assert reader.exists(collected)


def test_datasets_and_namespaces_behind_links_are_listed_and_open(collected: str, tmp_path: Path) -> None:
    root, elsewhere = reader.datasets_root(), tmp_path / "elsewhere"
    (root / "zest").rename(elsewhere)
    (root / "linked").symlink_to(elsewhere, target_is_directory=True)
    (root / "mine").mkdir()
    (root / "mine" / "one-v0").symlink_to(elsewhere / collected.split("/")[-1], target_is_directory=True)
    (elsewhere / "back").symlink_to(root, target_is_directory=True)
    (root / "nowhere").symlink_to(tmp_path / "gone")
    listed = reader.list_datasets()
    assert {"linked/kitchen-micro-tiny-v0", "mine/one-v0"} <= set(listed)
    for dataset_id in ("linked/kitchen-micro-tiny-v0", "mine/one-v0"):
        assert len(read(dataset_id, Dataset.episodes)) == 4


# --- files ------------------------------------------------------------------------------------------------------------


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
