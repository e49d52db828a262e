"""The pictures of the page's goals, kept in memory by a hash of their content, each embedded once."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

from zest_rl.embedders import Embedder
from zest_rl.errors import BadInput
from zest_rl.runtime import artifacts
from zest_rl.types import FloatArray, Frame

MAX_BYTES = 1_000_000_000
"""Of all pictures, unpacked."""
THUMBNAIL = 224
"""Longest side of what is shown of a picture, in pixels."""


class Shelf:
    """Pictures and sentences, with their embeddings."""

    def __init__(self, embedder: Embedder) -> None:
        """Start without any."""
        self.embedder = embedder
        self._pictures = dict[str, Frame]()
        self._embeddings = dict[tuple[bool, str], FloatArray]()

    def warm_up(self) -> None:
        """Load the network, so that the first picture that is dropped need not wait."""
        self.embedder.embed_images([np.zeros((8, 8, 3), np.uint8)])

    def add(self, picture: Frame) -> str:
        """Keep a picture (H, W, 3), and return its name.

        Raises:
            BadInput: there are too many.
        """
        name = artifacts.hash_arrays(picture)[:16]
        held = sum(each.nbytes for each in self._pictures.values())
        if name not in self._pictures and held + picture.nbytes > MAX_BYTES:
            raise BadInput(f"all pictures together may take {MAX_BYTES / 1e9:.0f} GB; start zest explore again")
        self._pictures[name] = picture
        return name

    def picture(self, name: str) -> Frame:
        """Return a picture by its name.

        Raises:
            BadInput: there is none.
        """
        if name not in self._pictures:
            raise BadInput("this picture is not known any more, drop it again")
        return self._pictures[name]

    def thumbnail(self, name: str) -> bytes:
        """Return a picture as a small PNG file; raises as `picture`."""
        image, buffer = Image.fromarray(self.picture(name)), io.BytesIO()
        image.thumbnail((THUMBNAIL, THUMBNAIL))
        image.save(buffer, "PNG")
        return buffer.getvalue()

    def embed(self, items: tuple[str, ...], *, are_sentences: bool) -> FloatArray:
        """Embed pictures by their names, or sentences: (N, D) float32; raises as `picture`."""
        for item in items:
            if (are_sentences, item) not in self._embeddings:
                if are_sentences:
                    (vector,) = self.embedder.embed_texts([item])
                else:
                    (vector,) = self.embedder.embed_images([self.picture(item)])
                self._embeddings[are_sentences, item] = vector
        return np.stack([self._embeddings[are_sentences, item] for item in items])
