"""Damaged pictures and videos: read or refused, never a crash, a hang or an error of a library."""

from __future__ import annotations

import io
import random
from pathlib import Path

import h5py
import imageio.v2 as imageio
import numpy as np
import pytest
from fuzzing import damaged_bytes, faults, outcomes
from PIL import Image, features

from zest_rl.data.images import decode_image
from zest_rl.data.picture_forms import read_pictures
from zest_rl.data.video import frame_times, iter_frames
from zest_rl.runtime.artifacts import hash_arrays

FORMATS = ("JPEG", "PNG", "WEBP", "GIF", "BMP", "TIFF", *(("AVIF",) if features.check("avif") else ()))


def encoded(kind: str) -> bytes:
    y, x = np.mgrid[0:1:40j, 0:1:60j]
    image = Image.fromarray(np.stack([255 * x, 255 * y, 128 + 0 * x], axis=-1).astype(np.uint8))
    buffer = io.BytesIO()
    exif = Image.Exif()
    exif[0x0112] = 6
    more = {"GIF": {}, "BMP": {}, "TIFF": {"compression": "tiff_lzw", "exif": exif}}.get(kind, {"exif": exif})
    image.save(buffer, kind, **more)
    return buffer.getvalue()


@pytest.mark.parametrize("n", [30, pytest.param(3000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", FORMATS)
def test_damaged_pictures_are_read_or_refused(kind: str, n: int) -> None:
    whole, rng = encoded(kind), random.Random(kind)
    damaged = [damaged_bytes(whole, rng) for _ in range(n)]
    counts, wrong = faults(outcomes(lambda i: hash_arrays(decode_image(damaged[i], "it")), n))
    print(f"{kind}: {n} inputs, {dict(counts)}")
    assert not wrong, wrong[0]
    assert counts["refused"]


@pytest.mark.parametrize("n", [30, pytest.param(3000, marks=pytest.mark.slow)])
def test_damaged_jpeg_files_among_observations_are_read_or_refused(n: int) -> None:
    whole, rng = encoded("JPEG"), random.Random(0)

    def read(data: bytes) -> str:
        with h5py.File("in memory", "w", driver="core", backing_store=False) as file:
            entry = file.create_dataset("camera", (2,), h5py.vlen_dtype(np.uint8))
            for i, row in enumerate((whole, data)):
                entry[i] = np.frombuffer(row, np.uint8)
            return hash_arrays(*read_pictures(entry, slice(None)))

    damaged = [damaged_bytes(whole, rng) for _ in range(n)]
    counts, wrong = faults(outcomes(lambda i: read(damaged[i]), n))
    print(f"JPEG among observations: {n} inputs, {dict(counts)}")
    assert not wrong, wrong[0]
    assert counts["refused"]


@pytest.mark.parametrize("n", [15, pytest.param(500, marks=pytest.mark.slow)])
@pytest.mark.parametrize("suffix", ["mp4", "webm", "avi"])
def test_damaged_videos_are_read_or_refused(suffix: str, n: int, tmp_path: Path) -> None:
    path, rng = tmp_path / f"film.{suffix}", random.Random(suffix)
    moving = [np.roll(np.tile(np.arange(64, dtype=np.uint8)[:, None, None] * 3, (1, 64, 3)), i, 0) for i in range(6)]
    imageio.mimwrite(path, moving, fps=10, **({"codec": "libvpx-vp9"} if suffix == "webm" else {}))
    whole = path.read_bytes()

    def read(data: bytes) -> str:
        path.write_bytes(data)
        return hash_arrays(frame_times(path), *iter_frames(path, 0.15, 3))

    damaged = [damaged_bytes(whole, rng) for _ in range(n)]
    counts, wrong = faults(outcomes(lambda i: read(damaged[i]), n))
    print(f"{suffix}: {n} inputs, {dict(counts)}")
    assert not wrong, wrong[0]
