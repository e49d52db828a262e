"""What a scorer scores: the embeddings of an episode's frames, wherever the frames come from."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from zest_rl.embedders import Embedder, Precision, load_embedder
from zest_rl.errors import BadInput
from zest_rl.types import FloatArray


@dataclass(frozen=True)
class EmbeddedEpisode:
    """The frames of one episode of T steps, embedded; frames that are known to be equal may be there once."""

    embeddings: FloatArray
    """(U, V, D) of V views, that of x_0 first."""
    index: NDArray[np.intp]
    """(T+1,) which of them shows x_0, x_1, … x_T."""

    @property
    def ends(self) -> FloatArray:
        """(2, V, D) embeddings of x_0 and x_T."""
        return self.embeddings[[0, self.index[-1]]]


class EpisodeEmbeddings(Protocol):
    """The embeddings of all episodes of a dataset, through a cache on disk."""

    unit: ClassVar[str]
    """What is embedded and cached as a whole."""

    @property
    def n_embedded(self) -> int:
        """Units that were not in the cache."""

    def identity(self) -> list[Any]:
        """What the embeddings depend on besides the recorded episodes and the scorer, for hashes; JSON-ready."""

    def describe(self) -> dict[str, Any]:
        """Where the frames come from, for provenance; JSON-ready."""

    def embed(self, on_progress: Callable[[int, int], None] | None = None) -> None:
        """Leave all embeddings in the cache; `on_progress` is called with (parts embedded, parts in all)."""

    def __iter__(self) -> Iterator[EmbeddedEpisode]:
        """Yield what `embed` left, one episode in memory at a time."""


@functools.lru_cache(maxsize=2)
def shared_embedder(uri: str, precision: Precision, device: str) -> Embedder:
    """Return this process's embedder of a URI, see `load_embedder`."""
    return load_embedder(uri, device=device, precision=precision)


def check_same_embedder(embedder: Embedder, fingerprint: str) -> None:
    """Make sure that a worker's embedder is that of the process that asked: the cache goes by the latter.

    Raises:
        BadInput: weights, precision or versions differ between the machines.
    """
    if embedder.fingerprint != fingerprint:
        raise BadInput(
            f"embedder {embedder.uri} of this worker is not that of the process that asked: weights, precision or "
            "versions differ; install the same on every node, and choose --precision fp32 or bf16"
        )
