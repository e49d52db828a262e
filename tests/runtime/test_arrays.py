from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from zest_rl.errors import ZestError
from zest_rl.runtime import artifacts
from zest_rl.runtime.arrays import concatenate, read_arrays, write_arrays

if TYPE_CHECKING:
    from conftest import Disk


def test_arrays_survive_the_way_to_disk_and_back(tmp_path: Path) -> None:
    arrays: dict[str, Any] = {"a": np.arange(6, dtype=np.uint8).reshape(2, 3), "b": np.array([True]), "c": np.zeros(0)}
    write_arrays(tmp_path / "deep/part.npz", arrays)
    got = read_arrays(tmp_path / "deep/part.npz")
    assert got is not None
    assert got.keys() == arrays.keys()
    for name, array in arrays.items():
        assert got[name].dtype == array.dtype
        np.testing.assert_array_equal(got[name], array)


def test_a_missing_file_reads_as_none(tmp_path: Path) -> None:
    assert read_arrays(tmp_path / "part.npz") is None


def test_no_damage_of_one_byte_makes_other_numbers_or_a_crash(tmp_path: Path) -> None:
    path = tmp_path / "part.npz"
    values = np.arange(4, dtype=np.float32)
    write_arrays(path, {"values": values})
    whole = path.read_bytes()
    n_damaged = 0
    for position in range(len(whole)):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 0x01]) + whole[position + 1 :])
        got = read_arrays(path)
        n_damaged += got is None
        assert not got or got["values"].tobytes() == values.tobytes()
        path.write_bytes(whole[:position])
        assert read_arrays(path) is None
    assert n_damaged > len(whole) / 2


def test_a_pickle_in_an_npz_file_is_never_opened(tmp_path: Path) -> None:
    np.savez(tmp_path / "part.npz", values=np.array([{"a": 1}], dtype=object))
    assert read_arrays(tmp_path / "part.npz") is None


def test_a_full_disk_leaves_the_old_part_and_no_half_of_the_new_one(
    disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = disk.path / "part.npz"
    with pytest.raises(ZestError, match="not enough disk space"):
        write_arrays(path, {"values": np.ones(3)})
    monkeypatch.setattr(artifacts, "check_free_space", lambda folder, n_bytes: None)
    write_arrays(path, {"values": np.ones(3)})
    with pytest.raises(ZestError, match="No space left on device"):
        write_arrays(path, {"values": np.ones(2_000_000)})
    np.testing.assert_array_equal((read_arrays(path) or {})["values"], np.ones(3))
    assert [p.name for p in disk.path.iterdir()] == ["part.npz"]


def test_parts_are_joined_along_the_first_axis() -> None:
    joined = concatenate([{"a": np.ones((2, 3)), "b": np.zeros(2)}, {"a": np.zeros((1, 3)), "b": np.ones(1)}])
    assert joined["a"].shape == (3, 3)
    np.testing.assert_array_equal(joined["b"], [0, 0, 1])
