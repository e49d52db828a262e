"""What every kind of input gives: frames by episode, beside the `Trajectories` that get the rewards."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from zest_rl.data.writer import Trajectories
from zest_rl.types import Frame


class EpisodeFrames(Protocol):
    """The frames of every episode, from one view or several. It is sent to worker processes: small, and frozen."""

    @property
    def views(self) -> Sequence[str]:
        """Names of the V views, for provenance."""

    def describe(self) -> dict[str, Any]:
        """Where the frames come from, JSON-ready, for provenance."""

    def digest(self, episode: int) -> str:
        """64 hex digits over all that the frames of an episode depend on; embeddings are cached by it."""

    def read(self, episode: int) -> Iterator[Sequence[Frame]]:
        """Yield the V frames of x_0, x_1, …, each (H, W, 3) uint8 RGB, holding few in memory.

        T + 1 of them, or T: then x_T is taken to look like x_{T-1}.
        """


@dataclass(frozen=True)
class Source:
    """A dataset to relabel."""

    trajectories: Trajectories
    frames: EpisodeFrames
