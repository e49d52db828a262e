"""What a scorer scores: the embeddings of an episode's frames, wherever the frames come from."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from zest_rl.embedders import Backend, Embedder, Precision, Vectors, load_embedder
from zest_rl.errors import BadInput, ZestError
from zest_rl.types import FloatArray

N_CHECKED = 3
"""Cached embeddings that a run computes again."""
TOLERANCE = 0.03
"""Largest distance of an embedding from the same one computed again, in units of its length. One machine agrees to
1e-6, another device within about 0.01; the same view with a part moved is 0.4 away."""


@dataclass(frozen=True)
class EmbeddedEpisode:
    """The embedded frames of one episode of T steps; frames known to be equal may be stored once."""

    embeddings: FloatArray
    """(U, V, D) of V views, that of x_0 first."""
    index: NDArray[np.intp]
    """(T+1,) rows of `embeddings` for x_0, x_1, … x_T."""

    @property
    def ends(self) -> FloatArray:
        """(2, V, D) embeddings of x_0 and x_T."""
        return self.embeddings[[0, self.index[-1]]]


class EpisodeEmbeddings(Protocol):
    """The embeddings of all episodes of a dataset, through a cache on disk."""

    unit: ClassVar[str]
    """What one entry of the cache holds."""

    @property
    def n_embedded(self) -> int:
        """Units that were not in the cache."""

    def identity(self) -> list[Any]:
        """JSON-ready, for hashes: what the embeddings depend on besides the recorded episodes and the scorer."""

    def describe(self) -> dict[str, Any]:
        """JSON-ready, for provenance: where the frames come from."""

    def embed(self, on_progress: Callable[[int, int], None] | None = None) -> None:
        """Fill the cache; `on_progress` is called with (parts embedded, parts in all)."""

    def read(self, episode: int) -> EmbeddedEpisode | None:
        """Read one episode from the cache, into which another process may be writing; None: not all of it is there."""

    def __iter__(self) -> Iterator[EmbeddedEpisode]:
        """Read the cache, one episode in memory at a time."""


def check_equal(folder: Path, pairs: Iterable[tuple[FloatArray | None, FloatArray]]) -> None:
    """Compare embeddings (…, D) of a cache with the same ones computed again; None: was damaged.

    Raises:
        ZestError: they differ by more than `TOLERANCE`; nothing is deleted, because either may be right.
    """
    for cached, computed in pairs:
        if cached is None:
            continue
        held, again = np.asarray(cached, np.float32), np.asarray(computed, np.float32)  # float16 holds no large norm
        off = np.linalg.norm(held - again, axis=-1) / np.linalg.norm(again, axis=-1)
        if not (off <= TOLERANCE).all():
            raise ZestError(
                f"embeddings in the cache {folder} are not those that this machine computes: one is off by "
                f"{off.max():.0%} of its length. Its files were exchanged, or made with another GL driver or device; "
                "delete that folder, then run the same command again"
            )


@functools.lru_cache(maxsize=2)
def shared_embedder(uri: str, precision: Precision, device: str, backend: Backend, vectors: Vectors) -> Embedder:
    """Return this process's embedder of a URI, on one thread; the default's network is loaded at its first picture."""
    return load_embedder(uri, device=device, precision=precision, backend=backend, vectors=vectors, one_thread=True)


@dataclass(frozen=True)
class WorkerEmbedder:
    """An embedder as jobs carry it to worker processes, which load it there."""

    uri: str
    precision: Precision
    device: str
    backend: Backend
    vectors: Vectors
    cache_key: str
    """Of the embedder of the process that asks; it names the cache."""

    def load(self) -> Embedder:
        """Return this process's embedder.

        Raises:
            BadInput: weights, precision, backend or versions differ between the machines.
        """
        embedder = shared_embedder(self.uri, self.precision, self.device, self.backend, self.vectors)
        if embedder.cache_key != self.cache_key:
            raise BadInput(
                f"embedder {self.uri} of this worker is not that of the process that asked: weights, precision, "
                "backend or versions differ; install the same on every node, and choose --precision fp32 or bf16 and "
                "--backend torch"
            )
        return embedder
