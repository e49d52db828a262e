"""Image files as RGB arrays: one reader for every kind of file that people collect as goal images."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from zest_rl.errors import BadInput
from zest_rl.types import Frame

SUFFIXES = (".bmp", ".gif", ".jpeg", ".jpg", ".png", ".webp")
"""File names that `list_images` counts as images, in any case; how a file is read depends on its content alone."""

MAX_PIXELS = 16_000_000
"""Larger images are refused by their header: a file of a few kB can unpack to gigabytes."""

_FORMATS = ("BMP", "GIF", "JPEG", "PNG", "WEBP")
_TOO_LARGE = (Image.DecompressionBombError, Image.DecompressionBombWarning)
_UNDECODABLE = (OSError, SyntaxError, ValueError, IndexError, EOFError)  # what Pillow raises on damaged files


def read_image(path: Path) -> Frame:
    """Read one still image as people see it: upright (EXIF), transparency on white, any colour mode as RGB.

    Args:
        path: a JPEG, PNG, WebP, BMP or single-frame GIF of at most 16 megapixels.

    Returns:
        (H, W, 3) uint8 RGB.

    Raises:
        BadInput: the file is missing, empty, no image, cut off, animated or too large.
    """
    path = Path(path)
    if not path.is_file():
        raise BadInput(f"{path} is not a file; give the path of an image")
    if path.stat().st_size == 0:
        raise BadInput(f"{path} is empty (0 bytes); copy or download it again")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        try:
            with Image.open(path, formats=_FORMATS) as image:
                _check_still(image, path)
                image.load()
                return _to_rgb(ImageOps.exif_transpose(image))
        except BadInput:
            raise
        except _TOO_LARGE as error:
            raise BadInput(f"{path} is too large: {error}; scale it down to at most 16 megapixels") from error
        except UnidentifiedImageError as error:
            raise BadInput(
                f"{path} is not an image that can be read (JPEG, PNG, WebP, BMP, GIF); convert it to PNG or remove it"
            ) from error
        except PermissionError as error:
            raise BadInput(f"{path} may not be read; change its permissions") from error
        except _UNDECODABLE as error:
            raise BadInput(f"{path} is damaged or cut off ({error}); copy or download it again") from error


def list_images(folder: Path) -> list[Path]:
    """Return the image files directly in `folder`, sorted by name; hidden files are ignored.

    Raises:
        BadInput: there is no such folder, or it holds no image.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise BadInput(f"{folder} is not a folder; give a folder of images")
    files = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    images = sorted(path for path in files if path.suffix.lower() in SUFFIXES)
    if not images:
        raise BadInput(f"{folder} holds no image: {len(files)} files, none of them named *{', *'.join(SUFFIXES)}")
    return images


def _check_still(image: Image.Image, path: Path) -> None:
    """Refuse by the header alone, before any pixel is unpacked."""
    if image.width * image.height > MAX_PIXELS:
        raise BadInput(
            f"{path} is too large: {image.width} x {image.height} pixels, at most {MAX_PIXELS / 1e6:.0f} million are "
            "read; scale it down"
        )
    n_frames = getattr(image, "n_frames", 1)
    if n_frames > 1 and image.format != "MPO":  # MPO: a JPEG with thumbnails behind it, as phones write
        raise BadInput(f"{path} is animated ({n_frames} frames), a still image is needed; save one frame of it as PNG")


def _to_rgb(image: Image.Image) -> Frame:
    if image.mode.startswith("I"):  # 16-bit grey, which convert("RGB") would clip to white
        grey = np.asarray(image).astype(np.float64) / 257
        return np.repeat(grey.round().clip(0, 255).astype(np.uint8)[..., None], 3, axis=-1)
    if image.has_transparency_data:
        rgba = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", rgba.size, "white"), rgba)
    return np.array(image.convert("RGB"), dtype=np.uint8)
