"""Simulator states → embeddings of all views, each distinct state rendered and embedded once, cached by content.

The cache is a folder of shards ``keys (n, nq) float64, embeddings (n, V, D) float32``; its name hashes everything that
an embedding depends on. Any process may add shards, each is written atomically, none is ever changed.

One state is one batch of V frames on one thread, so that an embedding is the same number whichever states were
embedded beside it: networks are exact only up to about 1e-6 across batch sizes and thread counts.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from zest_rl import artifacts
from zest_rl.embedders import Embedder, Precision, load_embedder
from zest_rl.frames import Views, canonical_states, state_keys
from zest_rl.parallel import chunks, map_jobs, one_thread, read_arrays, write_arrays
from zest_rl.types import FloatArray

STATES_PER_SHARD = 32


@dataclass(frozen=True)
class EmbedConfig:
    """What turns a state into embeddings."""

    views: Views
    embedder: str
    """Embedder URI, see `zest_rl.embedders`."""
    precision: Precision = "auto"
    device: str = "auto"

    def load_embedder(self) -> Embedder:
        """Return the embedder, shared within the process; the default's network is loaded at its first picture."""
        return shared_embedder(self.embedder, self.precision, self.device)


@functools.lru_cache(maxsize=2)
def shared_embedder(uri: str, precision: Precision, device: str) -> Embedder:
    """Return this process's embedder of a URI, see `load_embedder`."""
    return load_embedder(uri, device=device, precision=precision)


def _embed_states(job: tuple[EmbedConfig, NDArray[np.float64]]) -> dict[str, NDArray[np.generic]]:
    config, states = job
    renderer, embedder = config.views.shared_renderer(), config.load_embedder()
    with one_thread():
        embeddings = [embedder.embed_images(list(renderer.render(state))) for state in states]
    return {"keys": states, "embeddings": np.stack(embeddings)}


class StateEmbedder:
    """Embeds simulator states through a cache on disk."""

    def __init__(self, config: EmbedConfig, *, n_workers: int | None = None) -> None:
        """Open the cache of `config` (created when something is first written)."""
        self.config = config
        self.n_workers = n_workers
        self.embedder = config.load_embedder()
        self.n_embedded = 0
        """States that were not in the cache and had to be rendered and embedded."""
        digest = artifacts.hash_json([config.views.fingerprint(), self.embedder.fingerprint])
        self.folder: Path = artifacts.cache_dir() / "embeddings" / digest[:20]
        self._known: dict[bytes, FloatArray] = {}
        self._unsaved: list[NDArray[np.float64]] = []
        self._read: set[str] = set()
        self._load()

    def _load(self) -> None:
        for path in sorted(self.folder.glob("*.npz")):
            if path.name not in self._read and (shard := read_arrays(path)) is not None:
                self._known.update(zip(state_keys(shard["keys"]), shard["embeddings"], strict=True))
                self._read.add(path.name)

    def embed(
        self, qpos: NDArray[np.float64], on_progress: Callable[[int, int], None] | None = None
    ) -> tuple[FloatArray, NDArray[np.intp]]:
        """Embed states, all cores at work on those that are not in the cache.

        Args:
            qpos: (N, nq) simulator positions.
            on_progress: called with (shards done, shards in all).

        Returns:
            (U, V, D) float32 embeddings of the U distinct states, and (N,) the index of each state among them.
        """
        states, inverse = np.unique(canonical_states(qpos, self.config.views), axis=0, return_inverse=True)
        keys = state_keys(states)
        missing = states[[key not in self._known for key in keys]]
        if len(missing):
            jobs = {}
            for chunk in chunks(len(missing), STATES_PER_SHARD):
                part = missing[chunk.start : chunk.stop]
                jobs[artifacts.hash_arrays(part)[:20]] = (self.config, part)
            done = 0

            def count(_: str) -> None:
                nonlocal done
                done += 1
                if on_progress is not None:
                    on_progress(done, len(jobs))

            map_jobs(_embed_states, jobs, self.folder, n_workers=self.n_workers, on_done=count)
            self.n_embedded += len(missing)
            self._load()
        return np.stack([self._known[key] for key in keys]), np.asarray(inverse).reshape(-1)

    def embed_now(self, qpos: NDArray[np.float64]) -> FloatArray:
        """Embed states in this process, for use within a rollout: (N, nq) → (N, V, D). Call `flush` at the end."""
        states = canonical_states(qpos, self.config.views)
        rows = []
        for state, key in zip(states, state_keys(states), strict=True):
            if key not in self._known:
                self._known[key] = np.asarray(_embed_states((self.config, state[None]))["embeddings"][0], np.float32)
                self._unsaved.append(state)
                self.n_embedded += 1
            rows.append(self._known[key])
        return np.stack(rows)

    def flush(self) -> None:
        """Leave what `embed_now` computed in the cache."""
        if self._unsaved:
            states = np.stack(self._unsaved)
            path = self.folder / f"{artifacts.hash_arrays(states)[:20]}.npz"
            embeddings = np.stack([self._known[key] for key in state_keys(states)])
            write_arrays(path, {"keys": states, "embeddings": embeddings})
            self._read.add(path.name)
            self._unsaved.clear()
