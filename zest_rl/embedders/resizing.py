"""Pillow's resize and centre crop of square frames where they are already on a GPU, equal to the bit.

Pillow computes with whole numbers: coefficients are multiples of 2⁻²², and each of its two passes ends with a byte.
float64 holds all these numbers exactly, so two products of matrices give the same bytes, whatever the order in which
they sum. On a CPU Pillow is faster.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

_ONE = 2.0**22
"""What Pillow multiplies its coefficients by (``PRECISION_BITS``)."""


@lru_cache(maxsize=4)
def _coefficients(side: int, resized: int, cropped: int, device: torch.device) -> Tensor:
    """Return (cropped, side) float64: the whole numbers by which pixels are multiplied, of the pixels in the middle.

    Pillow's resize of whole numbers of 32 bits rounds as it rounds the coefficients for bytes.
    """
    unit = Image.fromarray((np.eye(side) * _ONE).astype(np.int32))
    matrix = np.asarray(unit.resize((resized, side), Image.Resampling.BICUBIC)).T
    first = round((resized - cropped) / 2)
    return torch.from_numpy(matrix[first : first + cropped].astype(np.float64)).to(device)


def preprocess_squares(frames: Tensor, options: dict[str, Any]) -> Tensor:
    """Preprocess as timm's ``create_transform(**options)`` with equal means and deviations does, on their device.

    Args:
        frames: (N, side, side, 3) uint8.
        options: ``input_size``, ``crop_pct``, ``mean``, ``std``; the interpolation is bicubic.

    Returns:
        (N, 3, H, H) float32.
    """
    size = options["input_size"][1]
    matrix = _coefficients(frames.shape[1], int(size / options["crop_pct"]), size, frames.device)
    resized = _rounded(matrix @ _rounded(frames.permute(0, 3, 1, 2).double() @ matrix.T))
    table: Tensor = (torch.arange(256, dtype=torch.float32) / 255 - options["mean"][0]) / options["std"][0]
    return table.to(frames.device)[resized.long()]  # from a table, because a GPU multiplies by 1/255


def _rounded(sums: Tensor) -> Tensor:
    return sums.add_(_ONE / 2).div_(_ONE).floor_().clamp_(0, 255)
