from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from fuzzing import outcome, with_memory
from PIL import Image, features

from zest_rl.data.images import decode_image, left_out, list_images, read_image
from zest_rl.errors import BadInput

RED, WHITE = (255, 0, 0), (255, 255, 255)


def picture(height: int = 40, width: int = 60) -> np.ndarray:
    """(height, width, 3) uint8: smooth, so that JPEG keeps it, and with another colour in every corner."""
    y, x = np.mgrid[0 : 1 : height * 1j, 0 : 1 : width * 1j]
    return np.stack([255 * x, 255 * y, 128 + 0 * x], axis=-1).astype(np.uint8)


def save(path: Path, pixels: np.ndarray | Image.Image, **options: object) -> Path:
    image = pixels if isinstance(pixels, Image.Image) else Image.fromarray(pixels)
    image.save(path, **options)
    return path


@pytest.mark.parametrize("suffix", ["png", "bmp", "gif", "tif", "tiff"])
def test_a_lossless_file_is_read_exactly(tmp_path: Path, suffix: str) -> None:
    pixels = np.repeat(np.repeat(np.array([[RED, WHITE], [(0, 0, 255), (0, 0, 0)]], np.uint8), 8, axis=0), 8, axis=1)
    frame = read_image(save(tmp_path / f"a.{suffix}", pixels))
    assert frame.dtype == np.uint8
    np.testing.assert_array_equal(frame, pixels)


@pytest.mark.parametrize(
    ("suffix", "options"),
    [
        ("jpg", {"quality": 95}),
        ("jfif", {"quality": 95, "format": "JPEG"}),
        ("webp", {"quality": 95}),
        pytest.param(
            "avif", {"quality": 95}, marks=pytest.mark.skipif(not features.check("avif"), reason="this Pillow has none")
        ),
    ],
)
def test_a_lossy_file_is_read_to_within_its_loss(tmp_path: Path, suffix: str, options: dict[str, object]) -> None:
    frame = read_image(save(tmp_path / f"a.{suffix}", picture(), **options))
    assert np.abs(frame.astype(int) - picture()).max() < 16


def test_the_content_decides_the_format_not_the_suffix(tmp_path: Path) -> None:
    frame = read_image(save(tmp_path / "a.png", picture(), format="JPEG"))
    assert frame.shape == (40, 60, 3)


def test_transparency_shows_white(tmp_path: Path) -> None:
    rgba = np.zeros((4, 6, 4), np.uint8)
    rgba[:, :3] = (*RED, 255)
    rgba[:, 3:] = (0, 0, 0, 0)
    frame = read_image(save(tmp_path / "a.png", rgba))
    np.testing.assert_array_equal(frame[0, 0], RED)
    np.testing.assert_array_equal(frame[0, 5], WHITE)
    rgba[..., 3] = 128
    np.testing.assert_allclose(read_image(save(tmp_path / "b.png", rgba))[0, 0], (255, 127, 127), atol=1)


def test_a_transparent_palette_colour_shows_white(tmp_path: Path) -> None:
    image = Image.new("P", (6, 4), 0)
    image.putpalette([0, 0, 0, *RED])
    image.paste(1, (0, 0, 3, 4))
    frame = read_image(save(tmp_path / "a.png", image, transparency=0))
    np.testing.assert_array_equal(frame[0, 0], RED)
    np.testing.assert_array_equal(frame[0, 5], WHITE)


@pytest.mark.parametrize("mode", ["L", "LA", "1"])
def test_grey_becomes_three_equal_channels(tmp_path: Path, mode: str) -> None:
    frame = read_image(save(tmp_path / "a.png", Image.fromarray(picture()).convert(mode)))
    assert frame.shape == (40, 60, 3)
    assert frame.min() < 64
    assert frame.max() > 128
    assert (frame == frame[..., :1]).all()


def test_16_bit_grey_keeps_its_tones(tmp_path: Path) -> None:
    tones = np.linspace(0, 65535, 256).astype(np.uint16)[None].repeat(4, axis=0)
    frame = read_image(save(tmp_path / "a.png", tones))
    np.testing.assert_array_equal(frame[0, :, 0], np.arange(256))


def test_16_bit_colour_keeps_its_tones(tmp_path: Path) -> None:
    """Pillow cannot write such a file, so the chunks are put together here."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    row = b"\0" + np.array([[65535, 32768, 0]] * 5, ">u2").tobytes()
    path = tmp_path / "a.png"
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", 5, 2, 16, 2, 0, 0, 0))
        + chunk(b"IDAT", zlib.compress(row * 2))
        + chunk(b"IEND", b"")
    )
    frame = read_image(path)
    assert frame.shape == (2, 5, 3)
    np.testing.assert_array_equal(frame[1, 4], (255, 128, 0))


def test_cmyk_becomes_rgb(tmp_path: Path) -> None:
    cmyk = Image.new("CMYK", (16, 16), (0, 255, 255, 0))
    frame = read_image(save(tmp_path / "a.jpg", cmyk, quality=95))
    np.testing.assert_allclose(frame[8, 8], RED, atol=4)


def test_exif_rotation_is_applied(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # the camera was held upright: turn a quarter clockwise to view
    frame = read_image(save(tmp_path / "a.jpg", picture(), exif=exif, quality=95))
    assert frame.shape == (60, 40, 3)
    assert np.abs(frame.astype(int) - np.rot90(picture(), k=-1)).max() < 24


def test_a_phone_picture_with_a_thumbnail_behind_it_is_a_still(tmp_path: Path) -> None:
    thumbnail = Image.fromarray(picture(10, 15))
    path = save(tmp_path / "a.jpg", picture(), format="MPO", save_all=True, append_images=[thumbnail])
    assert read_image(path).shape == (40, 60, 3)


@pytest.mark.parametrize("suffix", ["gif", "webp", "png"])
def test_an_animation_is_refused(tmp_path: Path, suffix: str) -> None:
    more = [Image.fromarray(255 - picture())]
    path = save(tmp_path / f"a.{suffix}", picture(), save_all=True, append_images=more)
    with pytest.raises(BadInput, match=r"a\.\w+ is animated \(2 frames\).*save one frame"):
        read_image(path)


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "gif", "bmp"])
@pytest.mark.parametrize("kept", [0.1, 0.5, 0.9])
def test_a_file_that_is_cut_off_is_refused(tmp_path: Path, suffix: str, kept: float) -> None:
    path = save(tmp_path / f"a.{suffix}", np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8))
    path.write_bytes(path.read_bytes()[: int(kept * path.stat().st_size)])
    with pytest.raises(BadInput, match=rf"a\.{suffix} is (damaged or cut off|not an image)"):
        read_image(path)


def test_a_damaged_file_is_refused_or_read_but_never_crashes(tmp_path: Path) -> None:
    rng, path = np.random.default_rng(0), tmp_path / "a"
    outcomes = set()
    for file_format in ("JPEG", "PNG", "WEBP", "GIF"):
        whole = np.frombuffer(save(path, picture(), format=file_format).read_bytes(), np.uint8)
        for _ in range(100):
            broken = whole.copy()
            broken[rng.integers(0, len(whole), 4)] = rng.integers(0, 256, 4)
            path.write_bytes(broken.tobytes())
            try:
                assert read_image(path).dtype == np.uint8
                outcomes.add("read")
            except BadInput:
                outcomes.add("refused")
    assert outcomes == {"read", "refused"}


def test_an_empty_a_missing_and_a_foreign_file_are_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "empty.png").touch()
    (tmp_path / "notes.png").write_text("not a picture")
    with pytest.raises(BadInput, match=r"empty\.png is empty \(0 bytes\)"):
        read_image(tmp_path / "empty.png")
    with pytest.raises(BadInput, match=r"notes\.png is not an image.*convert it to PNG"):
        read_image(tmp_path / "notes.png")
    with pytest.raises(BadInput, match=r"none\.png does not exist"):
        read_image(tmp_path / "none.png")


@pytest.mark.parametrize("side", [4001, 12_000, 30_000])
def test_a_huge_image_is_refused_by_its_header(tmp_path: Path, side: int) -> None:
    path = save(tmp_path / "bomb.png", Image.new("1", (side, side)))
    assert path.stat().st_size < 200_000
    with pytest.raises(BadInput, match=r"bomb\.png is too large.*scale it down"):
        read_image(path)


@pytest.mark.parametrize("shape", [(1, 16_000_000), (16_000, 100)])
def test_a_long_image_is_refused_by_its_header(tmp_path: Path, shape: tuple[int, int]) -> None:
    path = save(tmp_path / "line.png", Image.new("1", shape))
    with pytest.raises(BadInput, match=r"line\.png is too long: .* one side may be 100 times the other"):
        read_image(path)


def test_a_heic_picture_is_named_whatever_its_suffix(tmp_path: Path) -> None:
    (tmp_path / "IMG_1.JPG").write_bytes(b"\0\0\0\x18ftypheic" + b"x" * 200)
    with pytest.raises(BadInput, match=r"IMG_1\.JPG is a HEIC picture.*export it as JPEG or PNG"):
        read_image(tmp_path / "IMG_1.JPG")


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_grey_of_12_bits_in_16_is_refused_rather_than_read_as_black(tmp_path: Path, suffix: str) -> None:
    grey = picture()[..., 0].astype(np.uint16) * 16
    with pytest.raises(BadInput, match=rf"a\.{suffix} holds grey values of 0 to 4080, but white is 65535; scale"):
        read_image(save(tmp_path / f"a.{suffix}", grey))
    assert read_image(save(tmp_path / "black.png", 0 * grey)).max() == 0


def test_floats_in_a_picture_file_are_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "a.tif", Image.fromarray(picture()[..., 0].astype(np.float32)))
    with pytest.raises(BadInput, match=r"a\.tif holds floats"):
        read_image(path)


def test_postscript_never_starts_ghostscript(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "gs").write_text(f"#!/bin/sh\ntouch {tmp_path / 'ran'}\n")
    (tmp_path / "bin" / "gs").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"), prepend=":")
    page = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 60 40\n%%EndComments\nshowpage\n%%EOF\n"
    (tmp_path / "page.png").write_bytes(page)
    for read in (lambda: read_image(tmp_path / "page.png"), lambda: decode_image(page, "a row")):
        with pytest.raises(BadInput, match="is not an image that can be read"):
            read()
    assert not (tmp_path / "ran").exists()


def test_images_of_a_folder_are_listed_by_name_without_hidden_and_other_files(tmp_path: Path) -> None:
    for name in ("b.JPG", "a.png", "c.WebP", ".hidden.png", "notes.txt"):
        (tmp_path / name).touch()
    (tmp_path / "folder.png").mkdir()
    assert [path.name for path in list_images(tmp_path)] == ["a.png", "b.JPG", "c.WebP"]
    for name in ("Thumbs.db", "IMG_1.HEIC"):
        (tmp_path / name).touch()
    assert left_out(tmp_path) == ["IMG_1.HEIC", "folder.png/", "notes.txt"]


def test_a_folder_without_images_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    with pytest.raises(BadInput, match=r"holds no image, .*\*\.png, .*; it holds notes\.txt: put"):
        list_images(tmp_path)
    with pytest.raises(BadInput, match="none is not a folder"):
        list_images(tmp_path / "none")


@pytest.mark.data
def test_every_image_of_the_visual_tasks_dataset_is_read(visual_tasks: Path) -> None:
    folders = sorted(visual_tasks.glob("*/*/*"))
    paths = [path for folder in folders for path in list_images(folder)]
    assert len(paths) == sum(path.is_file() for folder in folders for path in folder.iterdir())
    for path in paths:
        frame = read_image(path)
        assert frame.dtype == np.uint8
        assert frame.shape[2] == 3
        assert frame.std() > 1, f"{path} came out blank"


def test_a_picture_that_does_not_fit_in_memory_is_not_called_damaged(tmp_path: Path) -> None:
    path = save(tmp_path / "a.png", np.zeros((4000, 4000, 3), np.uint8))
    end = outcome(lambda: with_memory(2 * 10**7, lambda: read_image(path).shape))
    assert (end.kind, "a.png needs more memory than there is" in end.detail) == ("refused", True), end
