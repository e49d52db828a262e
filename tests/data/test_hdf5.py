"""HDF5 files that reach out of themselves, or that no reader can hold."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from zest_rl.data import reader
from zest_rl.data.hdf5 import MAX_DEPTH, MAX_RATIO, open_hdf5, read_array
from zest_rl.errors import BadInput, ZestError
from zest_rl.sources import open_source

Spoil = Callable[[h5py.File, str], None]
"""Puts something at a path of an open file, in whose folder `other.hdf5` and `secret.txt` lie."""


def virtual(file: h5py.File, name: str) -> None:
    layout = h5py.VirtualLayout((3,), "f4")
    layout[:] = h5py.VirtualSource("other.hdf5", "rewards", (3,))
    file.create_virtual_dataset(name, layout)


def put(name: str) -> Callable[[Callable[[h5py.File], Any]], Spoil]:
    return lambda make: lambda file, at: file.__setitem__(f"{at}{name}", make(file))


REACH_OUT: dict[str, tuple[Spoil, str]] = {
    "external link": (put("/x")(lambda file: h5py.ExternalLink("other.hdf5", "/rewards")), "x is an external link"),
    "external link to a group": (put("/x")(lambda file: h5py.ExternalLink("other.hdf5", "/")), "x is an external link"),
    "soft link": (
        put("/x")(lambda file: h5py.SoftLink("/plain")),
        "x is a soft link, not data; copy the data themselves",
    ),
    "dangling soft link": (put("/x")(lambda file: h5py.SoftLink("/nowhere")), "x is a soft link"),
    "hard link": (put("/x")(lambda file: file["plain"]), "is a second name of something else in the file"),
    "cycle": (put("/x")(lambda file: file["/"]), "x is a second name of something else in the file"),
    "external storage": (
        lambda file, at: file.create_dataset(f"{at}/x", (3,), "f4", external=[("secret.txt", 0, 12)]) and None,
        r"x is stored outside the file \(external storage or a virtual dataset\)",
    ),
    "virtual dataset": (lambda file, at: virtual(file, f"{at}/x"), "x is stored outside the file"),
    "a name that is no text": (
        lambda file, at: h5py.h5g.create(file.id, at.encode() + b"/demo_\xff") and None,
        r"/demo_\\xff is a name that is not UTF-8; rename it",
    ),
    "deep groups": (put("/x" * (MAX_DEPTH + 2))(lambda file: np.zeros(3)), "groups deep, expected 32 at most"),
}


def folder_with(path: Path, libver: str | None = None) -> Path:
    """A plain file, one beside it, and a text."""
    (path.parent / "secret.txt").write_bytes(b"do not read!")
    with h5py.File(path.with_name("other.hdf5"), "w") as file:
        file["rewards"] = np.arange(3, dtype=np.float32)
    with h5py.File(path, "w", libver=libver) as file:
        file["plain"] = np.arange(3, dtype=np.float32)
        file.create_dataset("group/of/ragged", (3,), h5py.vlen_dtype(np.uint8))[1] = np.arange(2, dtype=np.uint8)
        file.create_dataset("packed", data=np.zeros((100, 3)), chunks=(10, 3), compression="gzip", shuffle=True)
        file.create_dataset("unwritten", (50,), "f4", chunks=(5,), maxshape=(None,))
        file["plain"].attrs["about"] = "x" * 100
    return path


@pytest.mark.parametrize("libver", [None, "latest"])
def test_a_plain_file_is_read(tmp_path: Path, libver: str | None) -> None:
    with open_hdf5(folder_with(tmp_path / "a.hdf5", libver)) as file:
        np.testing.assert_array_equal(read_array(file["plain"], np.float64), [0, 1, 2])
        assert read_array(file["packed"], np.float32).shape == (100, 3)


@pytest.mark.parametrize("libver", [None, "latest"])
@pytest.mark.parametrize(("spoil", "rule"), REACH_OUT.values(), ids=REACH_OUT)
def test_whatever_reaches_out_of_a_file_or_has_two_names_is_refused(
    spoil: Spoil, rule: str, libver: str | None, tmp_path: Path
) -> None:
    with h5py.File(folder_with(tmp_path / "a.hdf5", libver), "r+") as file:
        spoil(file, "group/of")
    with pytest.raises(BadInput, match=rule), open_hdf5(tmp_path / "a.hdf5"):
        pass


@pytest.mark.parametrize(("spoil", "rule"), REACH_OUT.values(), ids=REACH_OUT)
def test_a_dataset_that_reaches_out_is_refused_by_every_way_to_it_and_nothing_else_is_changed(
    spoil: Spoil, rule: str, collected: str, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    path = reader.dataset_path(collected) / reader.DATA_FILE
    (path.parent.parent / reader.MANIFEST_FILE).unlink()
    folder_with(path.with_name("some.hdf5"))
    with h5py.File(path, "r+") as file:
        file["plain"] = file["episode_1/rewards"][()]
        spoil(file, "episode_1")
    beside = [path.with_name("other.hdf5"), path.with_name("secret.txt")]
    before = [file.read_bytes() for file in beside]
    for words in (
        ("relabel", collected),
        ("export", collected, "--output", tmp_path / "x.npz"),
        ("inspect", collected),
    ):
        code, error = refusal(*words)
        assert code == 2
        assert re.search(f"dataset {collected}: .*{rule}", error), error
    assert [file.read_bytes() for file in beside] == before
    assert reader.list_datasets() == [collected]
    assert not (tmp_path / "x.npz").exists()


@pytest.mark.parametrize(("spoil", "rule"), REACH_OUT.values(), ids=REACH_OUT)
def test_a_robomimic_file_that_reaches_out_is_refused(spoil: Spoil, rule: str, tmp_path: Path) -> None:
    with h5py.File(folder_with(tmp_path / "a.hdf5"), "r+") as file:
        for name in ("actions", "obs/object"):
            file[f"data/demo_0/{name}"] = np.zeros((3, 2))
        spoil(file, "data/demo_0/obs")
    with pytest.raises(BadInput, match=rule):
        open_source(str(tmp_path / "a.hdf5"))


def test_a_file_that_was_changed_is_walked_through_again(tmp_path: Path) -> None:
    with open_hdf5(folder_with(tmp_path / "a.hdf5")):
        pass
    with h5py.File(tmp_path / "a.hdf5", "r+") as file:
        file["x"] = h5py.SoftLink("/plain")
    with pytest.raises(BadInput, match="soft link"), open_hdf5(tmp_path / "a.hdf5"):
        pass


# --- sizes, filters, damage -------------------------------------------------------------------------------------------


def with_filter(path: Path, code: int) -> Path:
    """An array whose only block claims to be compressed by a filter."""
    values = np.arange(3, dtype=np.float32)
    with h5py.File(folder_with(path), "r+") as file:
        properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        properties.set_chunk((3,))
        properties.set_filter(code, h5py.h5z.FLAG_OPTIONAL, ())
        space, kind = h5py.h5s.create_simple((3,)), h5py.h5t.py_create(values.dtype)
        h5py.h5d.create(file.id, b"squeezed", kind, space, dcpl=properties).write_direct_chunk((0,), values.tobytes())
    return path


def test_an_unknown_filter_is_named_with_what_to_install(tmp_path: Path) -> None:
    rule = "squeezed is compressed by filter 32099 .*`pip install hdf5plugin`.*`h5repack -f GZIP=4 IN OUT`"
    with pytest.raises(BadInput, match=rule), open_hdf5(with_filter(tmp_path / "a.hdf5", 32099)):
        pass


@pytest.mark.parametrize("n", [10**9, 10**12, 10**15])
def test_an_array_that_is_declared_but_not_stored_is_refused_before_it_takes_memory(n: int, tmp_path: Path) -> None:
    with h5py.File(folder_with(tmp_path / "a.hdf5"), "r+") as file:
        file.create_dataset("huge", (n,), "f4", chunks=(10,))
    with (
        open_hdf5(tmp_path / "a.hdf5") as file,
        pytest.raises(BadInput, match=r"huge declares .* of which 0 are stored"),
    ):
        read_array(file["huge"], np.float32)


def test_an_array_that_its_filter_shrinks_to_nearly_nothing_is_read(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        entry = file.create_dataset(
            "zeros", data=np.zeros(2**25, "i4"), chunks=(2**24,), scaleoffset=0, compression="gzip"
        )
        assert entry.nbytes > MAX_RATIO * entry.id.get_storage_size()
    with open_hdf5(tmp_path / "a.hdf5") as file:
        assert not read_array(file["zeros"], np.int32).any()


def test_what_is_no_number_is_refused_and_what_float32_cannot_hold_is_infinite(tmp_path: Path) -> None:
    with h5py.File(folder_with(tmp_path / "a.hdf5"), "r+") as file:
        file["text"], file["great"] = np.array([b"a"]), np.array([1e300])
    with open_hdf5(tmp_path / "a.hdf5") as file:
        for name in ("text", "group/of/ragged"):
            with pytest.raises(BadInput, match=f"/{name} must hold numbers, got values of type"):
                read_array(file[name], np.float32)
        assert read_array(file["great"], np.float32) == np.inf


@pytest.mark.parametrize(
    ("make", "rule"),
    [
        (lambda path: path.write_bytes(b"version https://git-lfs.github.com/spec/v1\noid 1"), "is a Git LFS pointer"),
        (lambda path: path.write_bytes(b"no HDF5"), "cannot be read as HDF5"),
        (lambda path: path.touch(), "is empty"),
        (Path.mkdir, "is not a file"),
        (os.mkfifo, "is not a file"),
        (lambda path: path.symlink_to("/dev/zero"), "is not a file"),
        (lambda path: path.symlink_to("nowhere"), "does not exist"),
    ],
)
def test_what_is_no_hdf5_file_is_told_as_what_it_is(make: Callable[[Path], Any], rule: str, tmp_path: Path) -> None:
    make(tmp_path / "a.hdf5")
    with pytest.raises(BadInput, match=rule), open_hdf5(tmp_path / "a.hdf5"):
        pass


def test_errors_of_h5py_are_told_and_those_of_our_own_are_not_taken_for_damage(tmp_path: Path) -> None:
    path = folder_with(tmp_path / "a.hdf5")
    for wrong in (lambda file: file["missing"], lambda file: file["plain"][7], lambda file: file["group"]["of"][()]):
        with (
            pytest.raises(ZestError, match=r"a\.hdf5 is damaged \(.*download it or make it again"),
            open_hdf5(path) as file,
        ):
            wrong(file)
    with pytest.raises(KeyError, match="ours"), open_hdf5(path):
        raise KeyError("ours")
    with pytest.raises(BadInput, match="needs more memory than there is"), open_hdf5(path):
        np.empty(2**55)
