from __future__ import annotations

import multiprocessing
import random
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from fuzzing import damaged_bytes, faults, outcomes

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


@pytest.mark.parametrize("n_flips", [400, pytest.param(20_000, marks=pytest.mark.slow)])
def test_no_flipped_bit_makes_other_numbers_or_an_error(n_flips: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    shard: dict[str, Any] = {"keys": rng.normal(size=(32, 30)), "embeddings": rng.normal(size=(32, 2, 64)).astype("f4")}
    path, n_read = tmp_path / "part.npz", 0
    write_arrays(path, shard)
    whole = bytearray(path.read_bytes())
    outside = [i for i in range(len(whole)) if not is_numbers(i, whole)]  # of which every bit is flipped where asked
    n_inside = max(0, n_flips - 8 * len(outside))
    places = [8 * i + bit for i in outside for bit in range(8)] + rng.integers(8 * len(whole), size=n_inside).tolist()
    for place in rng.permutation(places)[:n_flips]:
        whole[place // 8] ^= 1 << place % 8
        path.write_bytes(whole)
        whole[place // 8] ^= 1 << place % 8
        for layout in (None, {"keys": (np.float64, (None, 30))}):
            got = read_arrays(path, layout)
            n_read += got is not None
            assert got is None or all(got[name].tobytes() == shard[name].tobytes() for name in got)
            assert got is None or got.keys() == (shard if layout is None else layout).keys()
    assert n_read < n_flips, "what is read lies in dates and the like"


def is_numbers(i: int, whole: bytearray) -> bool:
    """Whether a byte is one of the numbers, and not of a header or a directory."""
    starts = [whole.index(b"keys.npy") + 200, whole.index(b"embeddings.npy") + 200]
    return starts[0] <= i < starts[0] + 32 * 30 * 8 - 200 or starts[1] <= i < starts[1] + 32 * 2 * 64 * 4 - 200


@pytest.mark.parametrize("n_inputs", [15, pytest.param(3000, marks=pytest.mark.slow)])
def test_damaged_files_are_missing_files(n_inputs: int, tmp_path: Path) -> None:
    arrays = {"keys": np.arange(90.0).reshape(3, 30), "embeddings": np.ones((3, 2, 8), np.float32)}
    path = tmp_path / "part.npz"
    write_arrays(path, arrays)
    whole, rng = path.read_bytes(), random.Random(0)

    def read(damaged: bytes) -> str | None:
        path.write_bytes(damaged)
        got = read_arrays(path)
        return None if got is None else artifacts.hash_arrays(*(got[name] for name in sorted(got)))

    damaged = [damaged_bytes(whole, rng) for _ in range(n_inputs)]
    ends = outcomes(lambda i: read(damaged[i]), n_inputs)
    kinds, wrong = faults(ends)
    assert not wrong
    assert kinds == {"read": n_inputs}
    as_written = artifacts.hash_arrays(*(arrays[name] for name in sorted(arrays)))
    assert {end.detail for end in ends} <= {"None", repr(as_written)}
    assert sum(end.detail == "None" for end in ends) > n_inputs / 2


def test_files_without_digests_are_damage_unless_they_belong_to_runs(tmp_path: Path) -> None:
    path = tmp_path / "part.npz"
    np.savez(path, values=np.arange(4, dtype=np.float32))
    assert read_arrays(path) is None
    assert (read_arrays(path, undigested=True) or {})["values"].tolist() == [0, 1, 2, 3]
    whole = path.read_bytes()
    path.write_bytes(whole.replace(b"(4,)", b"(3,)"))  # what zip's checksum does not tell when 3 numbers are read
    assert read_arrays(path, undigested=True) is None


def test_arrays_of_another_form_are_damage(tmp_path: Path) -> None:
    path = tmp_path / "part.npz"
    write_arrays(path, {"a": np.ones((2, 3), np.float32), "b": np.array([np.nan])})
    for layout in (
        {"a": (np.float32, (None, 3))}, {"a": (np.float32, (2, None))}, {"a": (np.float32, (2, 3))},
    ):  # fmt: skip
        assert (read_arrays(path, layout) or {}).keys() == {"a"}
    for damaged in (
        {"a": (np.float64, (2, 3))}, {"a": (np.float32, (2, 4))}, {"a": (np.float32, (6,))},
        {"b": (np.float64, (1,))}, {"c": (np.float64, (1,))},
    ):  # fmt: skip
        assert read_arrays(path, damaged) is None


def test_an_archive_that_unpacks_to_more_than_it_holds_is_damage(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "part.npz", values=np.zeros(10_000_000))
    assert read_arrays(tmp_path / "part.npz", undigested=True) is None


def write_again_and_again(path: Path, value: int) -> None:
    for _ in range(200):
        write_arrays(path, {"values": np.full(5000, value)})


def test_a_reader_beside_two_writers_sees_whole_files_only(tmp_path: Path) -> None:
    path = tmp_path / "part.npz"
    write_arrays(path, {"values": np.full(5000, 0)})
    context = multiprocessing.get_context("spawn")
    writers = [context.Process(target=write_again_and_again, args=(path, n)) for n in (1, 2)]
    for writer in writers:
        writer.start()
    seen = set()
    alive = True
    while alive:
        alive = any(writer.is_alive() for writer in writers)
        got = read_arrays(path)
        assert got is not None
        seen.add(tuple(np.unique(got["values"])))
    assert [writer.exitcode for writer in writers] == [0, 0]
    assert max(seen) > (0,)
    assert seen <= {(0,), (1,), (2,)}
    assert [file.name for file in tmp_path.iterdir()] == ["part.npz"]


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
