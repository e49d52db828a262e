"""Simulator states → embeddings of all views, each distinct state rendered and embedded once, cached by content.

The cache is a folder of shards ``keys (n, width) float64, embeddings (n, V, D) float32`` or float16; its name is a hash
of everything that an embedding depends on. Any process may add shards; each is written atomically and never changed.

One state is one batch of V frames on one thread, so that its embedding does not depend on the states embedded with it:
networks are exact only up to about 1e-6 across batch sizes and thread counts. States of equal frames that come together
are embedded once.

A digest tells a damaged shard from a whole one, which holds what another process computed, perhaps with another GL
driver. So the first time that embeddings of recorded states are taken from the cache, and at the first new state of a
rollout, a few are computed again and compared.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from zest_rl.embedders import Backend, Precision, Vectors
from zest_rl.rewards.embeddings import N_CHECKED, EmbeddedEpisode, WorkerEmbedder, check_equal, shared_embedder
from zest_rl.runtime import artifacts
from zest_rl.runtime.arrays import Layout, read_arrays, write_arrays
from zest_rl.runtime.cache import cache_folder
from zest_rl.runtime.parallel import Engine, cached_jobs, chunks, run_jobs
from zest_rl.simulation.views import distinct, each_once, state_keys
from zest_rl.sources.base import StateViews
from zest_rl.types import FloatArray

STATES_PER_SHARD = 32
SHARDS_IN_MEMORY = 64
"""Of 1.3 MB each with 8 views and the default embedder."""


@dataclass(frozen=True)
class _Job:
    """Some states to embed."""

    views: StateViews
    embedder: WorkerEmbedder
    states: NDArray[np.float64]


def _embed_states(job: _Job) -> dict[str, NDArray[np.generic]]:
    embedder = job.embedder.load()
    embeddings: dict[str, FloatArray] = {}  # by frames, which are equal where states differ in what no view sees
    rows = []
    for state in job.states:
        frames = job.views.render(state)
        if (digest := artifacts.hash_arrays(*frames)) not in embeddings:
            embeddings[digest] = embedder.embed_images(list(frames))
        rows.append(embeddings[digest])
    return {"keys": job.states, "embeddings": np.stack(rows).astype(embedder.vectors, copy=False)}


@functools.lru_cache(maxsize=SHARDS_IN_MEMORY)
def _read_shard(path: Path, n_views: int, dim: int, vectors: Vectors) -> FloatArray | None:
    """Return the embeddings of a shard, which never changes; None when it is missing or damaged."""
    arrays = read_arrays(path, {"embeddings": (np.dtype(vectors).type, (None, n_views, dim))})
    return None if arrays is None else arrays["embeddings"].astype(np.float32, copy=False)


class StateEmbedder:
    """Embeds simulator states through a cache on disk."""

    def __init__(
        self,
        views: StateViews,
        embedder: str,
        precision: Precision = "auto",
        *,
        backend: Backend = "auto",
        vectors: Vectors = "float32",
        device: str = "auto",
        n_workers: int | None = None,
        engine: Engine = "local",
    ) -> None:
        """Open the cache (created when something is first written); arguments as in `FrameEmbeddings`."""
        network = shared_embedder(embedder, precision, device, backend, vectors)
        self.views = views
        self.embedder = WorkerEmbedder(embedder, precision, device, backend, vectors, network.cache_key)
        self.n_workers, self.engine = n_workers, engine
        self.n_embedded = 0
        """States that were not in the cache."""
        digest = artifacts.hash_json([views.fingerprint(), network.cache_key])
        self.folder: Path = cache_folder("embeddings", digest[:20])
        self._form = (views.n_drawn, network.dim)
        self._where: dict[bytes, tuple[Path, int]] = {}
        """State → its shard, and the row in it."""
        self._new: dict[bytes, FloatArray] = {}
        """Results of `embed_now` that are not in a shard yet."""
        self._read: set[Path] = set()
        self._checked = False
        self._index_shards()

    def _index_shards(self) -> None:
        """Index the states of new shards; a damaged shard is removed."""
        for path in sorted(set(self.folder.glob("*.npz")) - self._read):
            if (arrays := read_arrays(path, {"keys": (np.float64, (None, self.views.width))})) is None:
                path.unlink(missing_ok=True)
                continue
            self._where.update((key, (path, row)) for row, key in enumerate(state_keys(arrays["keys"])))
            self._read.add(path)

    def embed(self, states: NDArray[np.float64], on_progress: Callable[[int, int], None] | None = None) -> None:
        """Embed the states that are not in the cache, on all cores.

        Args:
            states: (N, width).
            on_progress: called with (shards done, shards in all).
        """
        states = each_once(self.views.canonical(states))  # in the order of the episodes: an episode needs few shards
        self._check(state_keys(states))
        missing = states[[key not in self._where for key in state_keys(states)]]
        if len(missing) == 0:
            return
        jobs = {}
        for chunk in chunks(len(missing), STATES_PER_SHARD):
            part = missing[chunk.start : chunk.stop]
            jobs[artifacts.hash_arrays(part)[:20]] = _Job(self.views, self.embedder, part)
        options = {**self._options, "n_workers": self.n_workers, "layout": self._layout}
        for n_done, _ in enumerate(cached_jobs(_embed_states, jobs, self.folder, **options), start=1):
            if on_progress is not None:
                on_progress(n_done, len(jobs))
        self.n_embedded += len(missing)
        self._index_shards()

    def embedded(self, states: NDArray[np.float64]) -> EmbeddedEpisode:
        """Read the embeddings of one episode, (T+1, width) states; a few shards are in memory at a time.

        What turns out to be damaged is embedded again, in this process.
        """
        first, inverse = distinct(self.views.canonical(states))
        rows = self.embed_now(states[first])
        self.flush()
        return EmbeddedEpisode(np.concatenate([rows[inverse[:1]], rows]), 1 + inverse)

    def known(self, states: NDArray[np.float64]) -> EmbeddedEpisode | None:
        """As `embedded`; None where the cache does not hold all of the states, which are not embedded then."""
        self._index_shards()
        if any(key not in self._where for key in state_keys(self.views.canonical(states))):
            return None
        return self.embedded(states)

    def _row(self, key: bytes) -> FloatArray | None:
        """Return the (V, D) embeddings of a state, or None; a damaged shard is removed and forgotten."""
        if key in self._new:
            return self._new[key]
        if key not in self._where:
            return None
        path, row = self._where[key]
        if (embeddings := _read_shard(path, *self._form, self.embedder.vectors)) is not None and row < len(embeddings):
            return np.asarray(embeddings[row])
        path.unlink(missing_ok=True)
        _read_shard.cache_clear()
        self._read.discard(path)
        self._where = {other: place for other, place in self._where.items() if place[0] != path}
        return None

    def _check(self, keys: Iterable[bytes]) -> None:
        """Once, embed a few of the states of these keys that are in the cache, and compare; raises as `check_equal`."""
        known = [] if self._checked else [key for key in keys if key in self._where]
        checked = np.random.default_rng().choice(len(known), min(N_CHECKED, len(known)), replace=False)
        cached = {known[k]: self._row(known[k]) for k in checked}
        if not cached:
            return
        self._checked = True
        states = np.stack([np.frombuffer(key) for key in cached])
        ((_, arrays),) = run_jobs(_embed_states, {"check": _Job(self.views, self.embedder, states)}, **self._options)
        check_equal(self.folder, zip(cached.values(), arrays["embeddings"], strict=True))

    @property
    def _options(self) -> dict[str, Any]:
        return {"engine": self.engine, "device": self.embedder.device, "stage": "rendering and embedding"}

    def _layout(self, job: _Job) -> Layout:
        dtype = np.dtype(self.embedder.vectors).type
        return {"keys": (np.float64, job.states.shape), "embeddings": (dtype, (len(job.states), *self._form))}

    def embed_now(self, states: NDArray[np.float64]) -> FloatArray:
        """Embed states in this process, for use within a rollout: (N, width) → (N, V, D). Call `flush` at the end."""
        keys = state_keys(self.views.canonical(states))
        rows = {key: row for key in dict.fromkeys(keys) if (row := self._row(key)) is not None}
        if missing := [key for key in dict.fromkeys(keys) if key not in rows]:
            self._check(self._where)
            rendered = np.stack([np.frombuffer(key) for key in missing])
            embeddings = _embed_states(_Job(self.views, self.embedder, rendered))["embeddings"]
            new = dict(zip(missing, np.asarray(embeddings, np.float32), strict=True))
            self.n_embedded += len(new)
            self._new.update(new)
            rows.update(new)
        return np.stack([rows[key] for key in keys])

    def flush(self) -> None:
        """Write the results of `embed_now` to the cache."""
        if not self._new:
            return
        keys, rows = list(self._new), list(self._new.values())
        for part in chunks(len(keys), STATES_PER_SHARD):
            states = np.stack([np.frombuffer(key) for key in keys[part.start : part.stop]])
            path = self.folder / f"{artifacts.hash_arrays(states)[:20]}.npz"
            embeddings = np.stack(rows[part.start : part.stop]).astype(self.embedder.vectors, copy=False)
            write_arrays(path, {"keys": states, "embeddings": embeddings})
        self._new.clear()
        self._index_shards()


class StateEmbeddings:
    """The `EpisodeEmbeddings` of recorded simulator states."""

    unit: ClassVar[str] = "distinct_states"

    def __init__(self, embedder: StateEmbedder, states: Sequence[NDArray[np.float64]]) -> None:
        """Take the states (T+1, width) of every episode."""
        self._embedder, self._states = embedder, states

    @property
    def n_embedded(self) -> int:
        """Distinct states that were not in the cache."""
        return self._embedder.n_embedded

    def identity(self) -> list[Any]:
        """Empty: the states belong to the recorded episodes, and the views to the scorer."""
        return []

    def describe(self) -> dict[str, Any]:
        """Empty: the scorer's record holds the views."""
        return {}

    def embed(self, on_progress: Callable[[int, int], None] | None = None) -> None:
        """Embed the states that are not in the cache."""
        self._embedder.embed(np.concatenate(list(self._states)), on_progress)

    def read(self, episode: int) -> EmbeddedEpisode | None:
        """Read the shards that hold the states of an episode."""
        return self._embedder.known(self._states[episode])

    def __iter__(self) -> Iterator[EmbeddedEpisode]:
        return map(self._embedder.embedded, self._states)
