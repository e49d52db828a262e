"""Image files as RGB arrays: one reader for every kind of file that people collect as goal images."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import BinaryIO

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError, features

from zest_rl.data.picture_size import check_size
from zest_rl.errors import BadInput
from zest_rl.runtime.files import check_file
from zest_rl.types import Frame

_HAS_AVIF = features.check("avif")  # Pillow has it since 11.3, in most of its builds
SUFFIXES = (
    *((".avif",) if _HAS_AVIF else ()), ".bmp", ".gif", ".jfif", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp",
)  # fmt: skip
"""File names that `list_images` counts as images, in any case; how a file is read depends on its content alone."""

_FORMATS = ("BMP", "GIF", "JPEG", "PNG", "TIFF", "WEBP", *(("AVIF",) if _HAS_AVIF else ()))
"""Never EPS, for which Pillow starts Ghostscript."""
_DESKTOP_FILES = ("desktop.ini", "Thumbs.db")
_TOO_LARGE = (Image.DecompressionBombError, Image.DecompressionBombWarning)
_DARK_16_BIT = 4096
"""16-bit grey below this, a sixteenth of white, is taken for that of a camera of 12 bits or fewer."""


def read_image(path: Path) -> Frame:
    """Read one still image as people see it: upright (EXIF), transparency on white, any colour mode as RGB.

    Args:
        path: a JPEG, PNG, WebP, BMP, TIFF, single-frame GIF or, where Pillow has it, AVIF, of at most 16 megapixels.

    Returns:
        (H, W, 3) uint8 RGB.

    Raises:
        BadInput: the file is missing, empty, no image, cut off, animated or too large.
    """
    path = Path(path)
    check_file(path)
    with path.open("rb") as file:
        return _decode(file, str(path))


def decode_image(data: bytes, what: str) -> Frame:
    """Read the bytes of an image file as `read_image` does; `what` names them in an error."""
    return _decode(io.BytesIO(data), what)


def _decode(file: BinaryIO, what: str) -> Frame:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        try:
            with Image.open(file, formats=_FORMATS) as image:
                _check_still(image, what)
                image.load()
                return _to_rgb(ImageOps.exif_transpose(image), what)
        except BadInput:
            raise
        except _TOO_LARGE as error:
            raise BadInput(f"{what} is too large: {error}; scale it down to at most 16 megapixels") from error
        except UnidentifiedImageError as error:
            file.seek(0)
            raise BadInput(f"{what} is {_foreign_format(file.read(12))}") from error
        except MemoryError as error:
            raise BadInput(f"{what} needs more memory than there is; scale it down, or free some") from error
        except Exception as error:  # on damaged files Pillow raises whatever its parsers stumble over
            raise BadInput(f"{what} is damaged or cut off ({error}); copy or download it again") from error


def _foreign_format(start: bytes) -> str:
    """Say what a file is that starts with these 12 bytes, and what to do."""
    brand = start[8:12] if start[4:8] == b"ftyp" else b""
    if brand in (b"heic", b"heix", b"hevc", b"hevx", b"mif1", b"msf1"):
        return "a HEIC picture, as iPhones take them, which is not read; export it as JPEG or PNG"
    if brand in (b"avif", b"avis") and not _HAS_AVIF:
        return "an AVIF picture, which Pillow reads from 11.3 on; install that, or convert it to PNG"
    return "not an image that can be read (JPEG, PNG, WebP, BMP, GIF, TIFF); convert it to PNG or remove it"


def list_images(folder: Path) -> list[Path]:
    """Return the image files directly in `folder`, sorted by name; `left_out` are the others.

    Raises:
        BadInput: there is no such folder, or it holds no image.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise BadInput(f"{folder} is not a folder; give a folder of images")
    images = sorted(path for path in folder.iterdir() if _is_image(path))
    if not images:
        others = ", ".join(left_out(folder)[:5]) or "nothing"
        raise BadInput(
            f"{folder} holds no image, that is, no file named *{', *'.join(SUFFIXES)}; it holds {others}: put the "
            "images directly into it, and convert others, such as HEIC, to JPEG or PNG"
        )
    return images


def left_out(folder: Path) -> list[str]:
    """Return the names of what `list_images` does not count, sorted, without the hidden files of desktops."""
    others = (path for path in folder.iterdir() if not _is_image(path) and path.name not in _DESKTOP_FILES)
    return sorted(f"{path.name}/" if path.is_dir() else path.name for path in others if not path.name.startswith("."))


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()


def _check_still(image: Image.Image, what: str) -> None:
    """Refuse by the header alone, before any pixel is unpacked."""
    check_size(*image.size, what)
    n_frames = getattr(image, "n_frames", 1)
    if n_frames > 1 and image.format != "MPO":  # MPO: a JPEG with thumbnails behind it, as phones write
        raise BadInput(f"{what} is animated ({n_frames} frames), a still image is needed; save one frame of it as PNG")


def _to_rgb(image: Image.Image, what: str) -> Frame:
    if image.mode == "F":
        raise BadInput(f"{what} holds floats, whose white is not known; save it as PNG of 8 or 16 bits")
    if image.mode.startswith("I"):  # 16-bit grey, which convert("RGB") would clip to white
        values = np.asarray(image).astype(np.float64)
        if 0 < values.max() < _DARK_16_BIT or values.max() > 65535 or values.min() < 0:
            raise BadInput(
                f"{what} holds grey values of {values.min():.0f} to {values.max():.0f}, but white is 65535; scale "
                "them to 0 … 65535 (cameras of 10 or 12 bits do not), or save it as PNG of 8 bits"
            )
        return np.repeat((values / 257).round().astype(np.uint8)[..., None], 3, axis=-1)
    if image.has_transparency_data:
        rgba = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", rgba.size, "white"), rgba)
    return np.array(image.convert("RGB"), dtype=np.uint8)
