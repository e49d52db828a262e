"""What every kind of input provides: the `Trajectories` that get the rewards, and their frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from zest_rl.data.writer import Trajectories
from zest_rl.types import Frame


class EpisodeFrames(Protocol):
    """The frames of every episode, from one or more views. Sent to worker processes, so it is small and frozen."""

    @property
    def views(self) -> Sequence[str]:
        """Names of the V views, for provenance."""

    def describe(self) -> dict[str, Any]:
        """JSON-ready, for provenance: where the frames come from."""

    def digest(self, episode: int) -> str:
        """64 hex digits over everything that the frames of an episode depend on; the key of cached embeddings."""

    def read(self, episode: int) -> Iterator[Sequence[Frame]]:
        """Yield the V frames of x_0, x_1, …, each (H, W, 3) uint8 RGB, with few in memory.

        T + 1 steps, or T: then x_T repeats x_{T-1}. A step that is the same object as the one before has equal frames.
        """


@runtime_checkable
class RenderedFrames(Protocol):
    """`EpisodeFrames` of which one of an episode can be had without those before."""

    def at(self, episode: int, step: int, view: int | None = None) -> Sequence[Frame]:
        """Return the V frames of a step, or that of one view alone; step −1 is x_T."""


class StateViews(Protocol):
    """How states are rendered, each a row of numbers: of recorded episodes and of running environments alike.

    Sent to worker processes, so it is small and frozen.
    """

    @property
    def n_drawn(self) -> int:
        """V, without views that are left out."""

    @property
    def width(self) -> int:
        """Numbers in a state."""

    def fingerprint(self) -> str:
        """Hash of everything that a frame depends on besides the state."""

    def read(self, env: Any, first: NDArray[np.float64] | None) -> NDArray[np.float64]:
        """Return the state (width,) of an environment without its wrappers; `first`: that of x_0, None at x_0."""

    def canonical(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the states that are rendered instead, (N, width) → (N, width); equal ones have equal frames."""

    def render(self, state: NDArray[np.float64]) -> Sequence[Frame]:
        """Draw a canonical state: V frames (H, W, 3)."""


@dataclass(frozen=True)
class Source:
    """A dataset to relabel."""

    trajectories: Trajectories
    frames: EpisodeFrames
