from __future__ import annotations

import io
import tracemalloc
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

from zest_rl.data.observations import at_path, by_path, choose_pictures, entries, is_numbers, numbers, stored_rows
from zest_rl.data.picture_forms import PictureForm, form_of, read_pictures
from zest_rl.errors import BadInput, Notice


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
    "RGBA": lambda frame: np.dstack([frame, np.full(frame.shape[:2], 255, np.uint8)]),
    "RGBA CHW": lambda frame: np.moveaxis(np.dstack([frame, np.full(frame.shape[:2], 255, np.uint8)]), 2, 0),
    "float RGBA": lambda frame: np.dstack([frame / 255, np.ones(frame.shape[:2])]),
    "floats of bytes": lambda frame: frame.astype(np.float32),
    "float CHW around 0": lambda frame: np.moveaxis(frame / 127.5 - 1, 2, 0).astype(np.float32),
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_a_picture_is_the_same_frame(group: h5py.Group, form: str) -> None:
    frames = [picture(i) for i in range(5)]
    entry = group.create_dataset("camera", data=np.stack([FORMS[form](frame) for frame in frames]))
    assert form_of(entry).channels == 3
    np.testing.assert_array_equal(read_pictures(entry, slice(1, 4)), frames[1:4])


@pytest.mark.parametrize("shape", [(16, 20), (16, 20, 1), (1, 16, 20)])
def test_grey_pictures_are_frames_of_three_equal_channels(group: h5py.Group, shape: tuple[int, ...]) -> None:
    grey = picture(shape=shape)
    entry = group.create_dataset("camera", data=grey[None])
    assert form_of(entry).channels == 1
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
    assert form_of(entry).channels == 3
    frames = read_pictures(entry, slice(None))
    for frame, file in zip(frames, files, strict=True):
        np.testing.assert_array_equal(frame, np.asarray(Image.open(io.BytesIO(file.tobytes()))))
    stored = [row for part in stored_rows(entry) for row in (part if not ragged else [part])]
    np.testing.assert_array_equal(np.concatenate(stored), np.concatenate(files))


@pytest.mark.parametrize(
    ("array", "why"),
    [
        (np.zeros((2, 3), np.float32), r"float32 \(3,\) per step"),
        (np.zeros((2, 3, 3)), r"float64 \(3, 3\) per step"),
        (np.zeros((2, 16, 16, 4), np.uint8), "the fourth channel is not opaque: depth, or stacked frames"),
        (np.zeros((2, 16, 16, 9), np.uint8), r"is none of \(H, W\), \(H, W, C\)"),
        (np.zeros((2, 16, 16), np.int64), "as depth and labels are"),
        (np.zeros((2, 16, 16, 1), np.uint16), "as depth and labels are"),
        (np.zeros((2, 16, 16, 3), bool), "as depth and labels are"),
        (np.full((2, 16, 16), 3.5), r"but not in \[0, 1\] as pictures of floats are"),
        (np.full((2, 16, 16, 3), 1.5), r"but not in \[0, 1\], \[0, 255\] or \[-1, 1\]"),
        (np.full((2, 16, 16, 3), np.nan), r"but not in \[0, 1\], \[0, 255\] or \[-1, 1\]"),
        (np.zeros((1, 10, 1001), np.uint8), "is too large or too long"),
        (np.full((2, 9), 255, np.uint8), r"uint8 \(9,\) per step"),
    ],
)
def test_what_is_no_picture_is_not_taken_for_one_and_why_is_told(
    group: h5py.Group, array: np.ndarray, why: str
) -> None:
    entry = group.create_dataset("entry", data=array)
    assert form_of(entry).channels == 0
    with pytest.raises(BadInput, match=f"/observations/entry holds no pictures: .*{why}"):
        read_pictures(entry, slice(None))


def test_a_huge_picture_is_refused_before_it_is_unpacked(group: h5py.Group) -> None:
    entry = group.create_dataset("entry", (1, 10**5, 10**5), np.uint8, chunks=(1, 1000, 1000))
    with pytest.raises(BadInput, match="is too large or too long"):
        read_pictures(entry, slice(None))


@pytest.mark.parametrize("kind", ["cameras", "cameras CHW", "grey stack", "grey stack of 4"])
def test_cameras_and_stacked_frames_in_one_array_are_pictures_each(group: h5py.Group, kind: str) -> None:
    n = 4 if kind == "grey stack of 4" else 5
    frames = np.stack([[picture(10 * t + i) for i in range(n)] for t in range(3)])
    if kind.startswith("grey"):
        frames = frames[..., :1].repeat(3, axis=-1)
    stored = {"cameras": frames, "cameras CHW": np.moveaxis(frames, -1, -3)}.get(kind, frames[..., 0])
    entry = group.create_dataset("camera", data=stored)
    form = form_of(entry)
    assert (form.n_parts, form.channels) == (n, 1 if kind.startswith("grey") else 3)
    for part in range(n):
        np.testing.assert_array_equal(read_pictures(entry, slice(1, 3), form, part), frames[1:, part])


def test_the_first_episode_tells_the_range_of_all(group: h5py.Group) -> None:
    bright, dark = (group.create_dataset(f"camera{i}", data=np.full((2, 16, 16, 3), i, "f4")) for i in (200, 1))
    assert [form_of(entry).high for entry in (bright, dark)] == [255, 1]
    assert np.max(read_pictures(dark, slice(None), form_of(bright))) == 1
    with pytest.raises(BadInput, match=r"camera200: pictures of floats must be in \[0, 1\], .* got 200 to 200"):
        read_pictures(bright, slice(None), form_of(dark))
    other = group.create_dataset("other", data=np.zeros((2, 16, 18, 3), "f4"))
    with pytest.raises(BadInput, match=r"holds float32 \(16, 18, 3\) per step, but the first episode float32 \(16, 16"):
        read_pictures(other, slice(None), form_of(dark))


@pytest.mark.parametrize("other", ["uint16", "float32"])
def test_episodes_of_another_type_are_refused_rather_than_wrapped_or_black(group: h5py.Group, other: str) -> None:
    first, second = (group.create_dataset(t, data=np.ones((2, 16, 16, 3), t)) for t in ("uint8", other))
    with pytest.raises(BadInput, match=rf"holds {other} .* but the first episode uint8 \(16, 16, 3\); store all"):
        read_pictures(second, slice(None), form_of(first))


def test_a_dark_episode_has_the_form_of_the_first_and_numbers_have_not(group: h5py.Group) -> None:
    first, dark, beyond = (group.create_dataset(f"{i}", data=np.full((2, 16, 16, 3), i, "f4")) for i in (200, 30, 300))
    with pytest.warns(Notice, match="30 counts as 768 numbers per step"):
        assert is_numbers(dark)
    assert not is_numbers(dark, form_of(first))
    with pytest.warns(Notice, match="300 counts as 768 numbers per step"):
        assert is_numbers(beyond, form_of(first))


def test_a_long_episode_of_floats_is_never_in_memory_whole(group: h5py.Group) -> None:
    entry = group.create_dataset("camera", data=np.ones((640, 64, 64, 3), "f4"), chunks=(8, 64, 64, 3))
    tracemalloc.start()
    assert form_of(entry).high == 1
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < entry.nbytes / 4


def test_floats_that_are_declared_but_not_stored_are_refused_before_they_are_read(group: h5py.Group) -> None:
    entry = group.create_dataset("camera", (10**9, 16, 16, 3), "f4", chunks=(10, 16, 16, 3))
    with pytest.raises(BadInput, match=r"camera declares .* of which 0 are stored"):
        form_of(entry)


def test_numbers_in_the_shape_of_pictures_are_told_and_pixels_are_never_numbers(group: h5py.Group) -> None:
    rng = np.random.default_rng(0)
    group["camera"], group["grid"] = rng.random((3, 16, 20, 3)), rng.uniform(-50, 50, (3, 10, 10))
    group["joints"], group["depth"] = rng.random((3, 4)), np.zeros((3, 10, 10), np.uint16)
    forms = {name: form_of(entry) for name, entry in entries(group).items()}
    assert {name: form.channels for name, form in forms.items()} == {"camera": 3, "depth": 0, "grid": 0, "joints": 0}
    grid = group["grid"][()].astype(np.float32).reshape(3, 100)
    with pytest.warns(Notice) as told:
        np.testing.assert_array_equal(numbers(group), np.concatenate([grid, group["joints"][()].astype("f4")], axis=1))
    assert [str(notice.message).split(": ")[0] for notice in told] == [
        "depth is left out",
        "grid counts as 100 numbers per step",
    ]
    assert choose_pictures(forms, (), "it") == ["camera"]
    with pytest.raises(BadInput, match=r"no pictures at 'grid'.*; not read as pictures: depth \(uint16.*grid \(f"):
        choose_pictures(forms, ("grid",), "it")


def test_pictures_as_jpeg_files_are_no_numbers_and_damage_among_them_is_named(group: h5py.Group) -> None:
    buffer = io.BytesIO()
    Image.fromarray(picture(0, (40, 40, 3))).save(buffer, format="JPEG")
    page = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 60 40\n%%EndComments\nshowpage\n%%EOF\n"
    rows = [np.frombuffer(row, np.uint8) for row in (buffer.getvalue(), buffer.getvalue()[:300], page)]
    entry = group.create_dataset("camera", data=rows, dtype=h5py.vlen_dtype(np.uint8))
    assert not is_numbers(entry)
    for row, message in ((1, "camera at step 1 is damaged or cut off"), (2, "camera at step 2 is not an image")):
        with pytest.raises(BadInput, match=message):
            read_pictures(entry, slice(row, row + 1))


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
        assert form_of(observations["parts/_index_1"]).channels == channels
        assert numbers(observations).shape == (2, 1 if channels else 101)


@pytest.mark.parametrize("value", [1.0, 2.0, 255.0])
def test_bytes_that_are_declared_but_divided_by_255_are_not_read_as_black(tmp_path: Path, value: float) -> None:
    space = spaces.Dict({"camera": spaces.Box(0, 255, (16, 16, 3), np.float32)})
    storage = MinariStorage.new(tmp_path, observation_space=space, action_space=spaces.Discrete(2))
    one = np.zeros(1)
    pictures = {"camera": np.full((2, 16, 16, 3), value, np.float32)}
    pictures["camera"][0] = 0  # the first frame is black
    storage.update_episodes([EpisodeBuffer(0, None, None, pictures, one.astype(int), one, one == 1, one == 0, {})])
    with h5py.File(tmp_path / "main_data.hdf5") as file:
        form = form_of(file["episode_0/observations/camera"])
    assert (form.channels, bool(form.problem)) == ((3, False) if value > 1 else (0, True))


@given(st.integers(8, 30), st.integers(8, 30), st.sampled_from([1, 3]), st.booleans())
def test_the_order_of_the_axes_is_told_by_the_channels(height: int, width: int, channels: int, first: bool) -> None:
    frame = picture(shape=(height, width, channels))
    stored = np.moveaxis(frame, 2, 0) if first else frame
    with h5py.File("in memory", "w", driver="core", backing_store=False) as file:
        entry = file.create_dataset("camera", data=stored[None])
        np.testing.assert_array_equal(read_pictures(entry, slice(None)), [np.broadcast_to(frame, (height, width, 3))])


def test_the_only_pictures_in_colour_are_chosen_and_several_must_be_named() -> None:
    none, grey, colour = PictureForm(), PictureForm(1), PictureForm(3)
    assert choose_pictures({"state": none, "top": colour, "depth": grey}, (), "it") == ["top"]
    assert choose_pictures({"only": grey}, (), "it") == ["only"]
    two = {"a/left": colour, "a/right": colour, "state": none}
    with pytest.raises(BadInput, match="it has several entries with pictures: obs/a/left, obs/a/right; choose with"):
        choose_pictures(two, (), "it", "obs")
    assert choose_pictures(two, ("obs/a/right", "a/left"), "it", "obs") == ["a/right", "a/left"]
    with pytest.raises(BadInput, match="it has no pictures at 'state', and there is no such folder; entries with pict"):
        choose_pictures(two, ("state",), "it", "obs")
    with pytest.raises(BadInput, match="it has no entry with pictures"):
        choose_pictures({"state": none}, (), "it")


@pytest.mark.parametrize("path", ["gt/success", "gt/reward", "zest/score", "is_success", "gt", "gt/success/x", "empty"])
def test_one_entry_is_found_by_the_path_that_it_has_among_all(path: str) -> None:
    info = {"gt": {"success": True, "reward": 0.5}, "zest/score": 1.0, "/is_success": 0, "empty": {}}
    assert at_path(info, path) == by_path(info).get(path)


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
