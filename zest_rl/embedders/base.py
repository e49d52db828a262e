"""A network: frozen weights, with the preprocessing that they were trained with."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from PIL import Image

from zest_rl.types import Frame

Preprocess = Callable[[Image.Image], torch.Tensor]

ENTRY_POINTS = "zest_rl.embedders"
"""Group of the entry points by which another package registers a family: name → function from the URI's rest to a
`Network`."""


@dataclass(frozen=True)
class Network:
    """A frozen network with its weights and its preprocessing."""

    module: torch.nn.Module
    preprocess: Preprocess
    """RGB image → (3, H, W) float32, the model's own."""
    encode_images: Callable[[torch.Tensor], torch.Tensor]
    """(N, 3, H, W) → (N, D), on the module's device and in its dtype."""
    encode_texts: Callable[[list[str]], torch.Tensor] | None = None
    """N sentences → (N, D); None when it reads no text."""
    identity: str = ""
    """Anything that its vectors depend on besides the weights and the `repr` of module and preprocessing."""
    preprocess_squares: Callable[[torch.Tensor], torch.Tensor] | None = None
    """(N, side, side, 3) uint8 frames on a GPU → what `preprocess` makes of them, to the bit, but at once and there."""

    def __post_init__(self) -> None:
        self.module.requires_grad_(False).eval()

    def embed_frames(self, frames: Iterable[Frame]) -> torch.Tensor:
        """(H, W, 3) uint8 frames → (N, D), in one batch."""
        weight = next(self.module.parameters())
        pixels = self._preprocessed(list(frames), weight.device)
        with torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=False):  # fp32 means fp32
            return self.encode_images(pixels.to(weight.device, weight.dtype, memory_format=torch.channels_last))

    def _preprocessed(self, frames: list[Frame], device: torch.device) -> torch.Tensor:
        side = len(frames[0])
        are_squares = all(frame.shape[:2] == (side, side) for frame in frames)
        if self.preprocess_squares is not None and device.type == "cuda" and are_squares:
            return self.preprocess_squares(torch.from_numpy(np.stack(frames)).to(device))
        return torch.stack([self.preprocess(Image.fromarray(frame)) for frame in frames])

    @cached_property
    def dim(self) -> int:
        """Length D of a vector."""
        with torch.inference_mode():
            return self.embed_frames([np.zeros((8, 8, 3), np.uint8)]).shape[1]

    def place(self, device: torch.device, dtype: torch.dtype) -> Network:
        """Move the module, in the memory layout that is fastest for convolutions, and return self."""
        self.module.to(device=device, dtype=dtype)
        self.module.to(memory_format=torch.channels_last)
        return self
