from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage
from PIL import Image

from zest_rl.data.observations import (
    as_frame,
    choose_pictures,
    entries,
    n_channels,
    numbers,
    read_pictures,
    stored_rows,
)
from zest_rl.errors import BadInput


@pytest.fixture
def group(tmp_path: Path) -> Any:
    with h5py.File(tmp_path / "some.hdf5", "w") as file:
        yield file.create_group("observations")


def picture(seed: int = 0, shape: tuple[int, ...] = (16, 20, 3)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


FORMS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "HWC": lambda frame: frame,
    "CHW": lambda frame: np.moveaxis(frame, 2, 0),
    "float HWC": lambda frame: (frame / 255).astype(np.float32),
    "double CHW": lambda frame: np.moveaxis(frame / 255, 2, 0),
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_a_picture_is_the_same_frame(group: h5py.Group, form: str) -> None:
    frames = [picture(i) for i in range(5)]
    entry = group.create_dataset("camera", data=np.stack([FORMS[form](frame) for frame in frames]))
    assert n_channels(entry) == 3
    np.testing.assert_array_equal(read_pictures(entry, slice(1, 4)), frames[1:4])


@pytest.mark.parametrize("shape", [(16, 20), (16, 20, 1), (1, 16, 20)])
def test_grey_pictures_are_frames_of_three_equal_channels(group: h5py.Group, shape: tuple[int, ...]) -> None:
    grey = picture(shape=shape)
    entry = group.create_dataset("camera", data=grey[None])
    assert n_channels(entry) == 1
    (frame,) = read_pictures(entry, slice(None))
    assert frame.shape == (16, 20, 3)
    for channel in range(3):
        np.testing.assert_array_equal(frame[:, :, channel], grey.reshape(16, 20))


@pytest.mark.parametrize("ragged", [True, False])
def test_jpeg_files_in_the_two_ways_that_minari_stores_them_are_decoded(group: h5py.Group, ragged: bool) -> None:
    files = []
    for i in range(3):
        buffer = io.BytesIO()
        Image.fromarray(picture(i if ragged else 0, (40, 40, 3))).save(buffer, format="JPEG")
        files.append(np.frombuffer(buffer.getvalue(), np.uint8))
    assert (len({len(file) for file in files}) > 1) == ragged
    entry = group.create_dataset("camera", data=files, dtype=h5py.vlen_dtype(np.uint8) if ragged else None)
    assert n_channels(entry) == 3
    frames = read_pictures(entry, slice(None))
    for frame, file in zip(frames, files, strict=True):
        np.testing.assert_array_equal(frame, np.asarray(Image.open(io.BytesIO(file.tobytes()))))
    stored = [row for part in stored_rows(entry) for row in (part if not ragged else [part])]
    np.testing.assert_array_equal(np.concatenate(stored), np.concatenate(files))


@pytest.mark.parametrize(
    ("array", "why"),
    [
        (np.zeros((2, 3), np.float32), "a vector"),
        (np.zeros((2, 3, 3)), "a rotation"),
        (np.zeros((2, 16, 16, 4), np.uint8), "colour and depth, or a stack"),
        (np.zeros((2, 9, 16, 16), np.uint8), "a stack of frames"),
        (np.zeros((2, 16, 16), np.int64), "a map of numbers"),
        (np.full((2, 9), 255, np.uint8), "bytes that are no JPEG"),
    ],
)
def test_what_is_no_picture_is_not_taken_for_one(group: h5py.Group, array: np.ndarray, why: str) -> None:
    entry = group.create_dataset("entry", data=array)
    assert n_channels(entry) is None, why
    with pytest.raises(BadInput, match="/observations/entry holds no pictures"):
        read_pictures(entry, slice(None))


def test_floats_of_another_range_than_pictures_are_numbers_unless_they_are_asked_for(group: h5py.Group) -> None:
    rng = np.random.default_rng(0)
    group["camera"], group["grid"] = rng.random((3, 16, 20, 3)), rng.uniform(-50, 50, (3, 10, 10))
    group["joints"] = rng.random((3, 4))
    found = {name: n_channels(entry) for name, entry in entries(group).items()}
    assert found == {"camera": 3, "grid": 0, "joints": None}
    grid = group["grid"][()].astype(np.float32).reshape(3, 100)
    np.testing.assert_array_equal(numbers(group), np.concatenate([grid, group["joints"][()].astype("f4")], axis=1))
    assert choose_pictures(found, (), "it") == ["camera"]
    assert choose_pictures(found, ("grid",), "it") == ["grid"]
    with pytest.raises(BadInput, match=r"observations/grid: pictures of floats must be in \[0, 1\], got -"):
        read_pictures(group["grid"], slice(None))


@pytest.mark.parametrize(
    ("low", "high", "channels"), [(0, 1, 1), (-50, 50, 0), (0, np.inf, 0), (0, 255, 0), (-np.inf, np.inf, 1)]
)
def test_the_declared_bounds_tell_pictures_from_numbers_whatever_an_episode_holds(
    tmp_path: Path, low: float, high: float, channels: int
) -> None:
    space = spaces.Dict({"parts": spaces.Tuple((spaces.Discrete(2), spaces.Box(low, high, (10, 10), np.float32)))})
    storage = MinariStorage.new(tmp_path, observation_space=space, action_space=spaces.Discrete(2))
    dark = {"parts": (np.zeros(2, int), np.zeros((2, 10, 10), np.float32))}
    one = np.zeros(1)
    storage.update_episodes([EpisodeBuffer(0, None, None, dark, one.astype(int), one, one == 1, one == 0, {})])
    with h5py.File(tmp_path / "main_data.hdf5") as file:
        observations = file["episode_0/observations"]
        assert n_channels(observations["parts/_index_1"]) == channels
        assert numbers(observations).shape == (2, 1 if channels else 101)


@pytest.mark.parametrize("value", [-0.1, 1.5, 255.0, np.nan])
def test_floats_that_are_no_shares_are_refused(value: float) -> None:
    with pytest.raises(BadInput, match=r"camera: pictures of floats must be in \[0, 1\], got"):
        as_frame(np.full((8, 8, 3), value), "camera")


@given(st.integers(8, 30), st.integers(8, 30), st.sampled_from([1, 3]), st.booleans())
def test_the_order_of_the_axes_is_told_by_the_channels(height: int, width: int, channels: int, first: bool) -> None:
    frame = picture(shape=(height, width, channels))
    stored = np.moveaxis(frame, 2, 0) if first else frame
    np.testing.assert_array_equal(as_frame(stored, "camera"), np.broadcast_to(frame, (height, width, 3)))


def test_the_only_pictures_in_colour_are_chosen_and_several_must_be_named() -> None:
    one = {"state": None, "top": 3, "depth": 1}
    assert choose_pictures(one, (), "it") == ["top"]
    assert choose_pictures({"only": 1}, (), "it") == ["only"]
    two = {"a/left": 3, "a/right": 3, "state": None}
    with pytest.raises(BadInput, match="it has several entries with pictures: obs/a/left, obs/a/right; choose with"):
        choose_pictures(two, (), "it", "obs")
    assert choose_pictures(two, ("obs/a/right", "a/left"), "it", "obs") == ["a/right", "a/left"]
    with pytest.raises(BadInput, match="it has no pictures at 'state', and there is no such folder; entries with pict"):
        choose_pictures(two, ("state",), "it", "obs")
    with pytest.raises(BadInput, match="it has no entry with pictures"):
        choose_pictures({"state": None}, (), "it")


def test_numbers_of_a_dictionary_are_flattened_as_gymnasium_flattens_them(group: h5py.Group) -> None:
    space = spaces.Dict(
        {
            "observation": spaces.Box(-1, 1, (4,), np.float64),
            "goal": spaces.Dict({"wanted": spaces.Box(-1, 1, (2,)), "achieved": spaces.Box(-1, 1, (2, 3))}),
        },
        seed=0,
    )
    samples = [space.sample() for _ in range(6)]
    group["observation"] = [sample["observation"] for sample in samples]
    group["goal/wanted"] = [sample["goal"]["wanted"] for sample in samples]
    group["goal/achieved"] = [sample["goal"]["achieved"] for sample in samples]
    group["camera"] = np.stack([picture(i) for i in range(6)])
    group.create_dataset("words", data=["a sentence", "", *"word"], dtype=h5py.string_dtype())
    assert list(entries(group)) == ["camera", "goal/achieved", "goal/wanted", "observation", "words"]
    expected = np.stack([spaces.flatten(space, sample) for sample in samples]).astype(np.float32)
    np.testing.assert_array_equal(numbers(group), expected)
    assert [bytes(row) for row in stored_rows(group["words"])] == [b"a sentence", b"", b"w", b"o", b"r", b"d"]
