"""Embeds datasets in a process of its own, so that the page answers meanwhile; the two share the cache on disk."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from types import FrameType
from typing import TYPE_CHECKING, Any

from zest_rl.errors import BadInput, ZestError, nearest
from zest_rl.runtime.parallel import cause_of_death, prepare_child, starting_children

if TYPE_CHECKING:
    from zest_rl.rewards.embeddings import EpisodeEmbeddings
    from zest_rl.sources import Source

STOPS_WITHIN = 10.0
"""Seconds."""
EMBEDDING = {
    "embedder": "efficientnet-lite0", "precision": "auto", "device": "auto", "backend": "auto", "vectors": "float32",
}  # fmt: skip
"""Arguments of `open_embeddings`, with their defaults."""
OPTIONS = (
    "frames", "camera", "env", "robot", "look_at", "views", "show_robot", "tolerance", "skip_incomplete", "masks",
    "n_workers", *EMBEDDING,
)  # fmt: skip
"""Arguments of `zest_rl.rewards.relabel.relabel` that say what is seen."""


@dataclass(frozen=True)
class Choice:
    """A dataset, and which frames of it are seen by what embedder."""

    dataset: str
    options: Mapping[str, Any]
    """Some of `OPTIONS`, by name."""

    def __post_init__(self) -> None:
        if unknown := self.options.keys() - set(OPTIONS):
            raise BadInput(f"unknown argument {min(unknown)!r}; {nearest(min(unknown), OPTIONS)}")

    @property
    def embedding(self) -> dict[str, Any]:
        """The arguments of `EMBEDDING`, in that order."""
        return {name: self.options.get(name, default) for name, default in EMBEDDING.items()}

    def find(self) -> tuple[Source, EpisodeEmbeddings]:
        """Find episodes and frames, and open the cache; raises as `open_source` and `open_embeddings`."""
        from zest_rl.rewards.preview import seen_source  # takes a second, in which the server starts, too
        from zest_rl.rewards.relabel import open_embeddings

        source = seen_source(self.dataset, **self.options)
        return source, open_embeddings(source, n_workers=self.options.get("n_workers"), **self.embedding)


def _stop(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt(number)  # upon which a pool ends its workers


def _embed(send: Any, choices: Sequence[Choice]) -> None:
    prepare_child()
    signal.signal(signal.SIGTERM, _stop)
    with suppress(KeyboardInterrupt, BrokenPipeError):
        _embed_each(send, choices)


def _embed_each(send: Any, choices: Sequence[Choice]) -> None:
    for i, choice in enumerate(choices):
        problem = ""
        try:
            choice.find()[1].embed(lambda done, total, i=i: send.send((i, done / total, "")))  # type: ignore[misc]
        except ZestError as error:
            problem = str(error)
        except Exception as error:
            problem = f"{type(error).__name__}: {error}"
        send.send((i, 1.0, problem))


class BackgroundEmbedding:
    """A process that embeds one dataset after the other; what is finished when it stops stays in the cache."""

    def __init__(self, choices: Sequence[Choice]) -> None:
        """Start it."""
        context = multiprocessing.get_context("spawn")
        self._receive, send = context.Pipe(duplex=False)
        self._child = context.Process(target=_embed, args=(send, choices))
        self._done, self._problems = [0.0] * len(choices), [""] * len(choices)
        with starting_children():
            self._child.start()
        send.close()

    def progress(self, i: int) -> tuple[float, str]:
        """Return the share of dataset `i` that is embedded, and what ended it early, if anything."""
        try:
            while self._receive.poll():
                number, self._done[number], self._problems[number] = self._receive.recv()
        except EOFError:  # the process has ended
            self._child.join()
            if self._done[i] < 1 and not self._problems[i]:
                how = cause_of_death(self._child.exitcode)
                self._problems[i] = f"the embedding process died ({how}); start zest explore again to go on"
        return self._done[i], self._problems[i]

    def stop(self) -> None:
        """End the process and its workers."""
        self._child.terminate()
        self._child.join(STOPS_WITHIN)
        self._child.kill()
        self._child.join()
