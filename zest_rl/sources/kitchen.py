"""Recorded states of zest/Kitchen-v1, rendered from a ring of views; with the robot hidden, as in the paper."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zest_rl.data.reader import Dataset, open_dataset
from zest_rl.data.writer import DatasetCopy
from zest_rl.kitchen.scene import shared_renderer
from zest_rl.kitchen.views import Views, canonical_states
from zest_rl.runtime import artifacts
from zest_rl.sources.base import Source
from zest_rl.types import Frame


@dataclass(frozen=True, eq=False)
class KitchenStates:
    """`EpisodeFrames` of the kitchen's states. Equal states have equal frames, so each is rendered once."""

    states: Sequence[NDArray[np.float64]]
    """(T+1, nq) simulator positions of every episode."""
    ring: Views

    @property
    def views(self) -> Sequence[str]:
        """Pose of each camera."""
        return [f"azimuth {c.azimuth:g}°, elevation {c.elevation:g}°, {c.distance:g} m" for c in self.ring.cameras]

    def describe(self) -> dict[str, Any]:
        """The views that are rendered."""
        return {"kind": "kitchen", "views": list(self.views), "ring": asdict(self.ring)}

    def digest(self, episode: int) -> str:
        """Hash the states as they are rendered, and the views."""
        states = canonical_states(self.states[episode], self.ring)
        return artifacts.hash_json([artifacts.hash_arrays(states), self.ring.fingerprint()])

    def read(self, episode: int) -> Iterator[Sequence[Frame]]:
        """Render each state."""
        renderer = self.ring.shared_renderer()
        for state in canonical_states(self.states[episode], self.ring):
            yield list(renderer.render(state))

    def at(self, episode: int, step: int, view: int | None = None) -> Sequence[Frame]:
        """Render one state."""
        (state,) = canonical_states(self.states[episode][[step]], self.ring)
        if view is None:
            return self.ring.render(state)
        return list(shared_renderer(self.ring.render_config, (self.ring.cameras[view],)).render(state))


def kitchen_source(dataset_id: str, ring: Views) -> Source:
    """Open a dataset of the kitchen, seen from a ring of views; raises as `Dataset.states`."""
    with open_dataset(dataset_id) as ds:
        return read_kitchen(ds, ring)


def read_kitchen(ds: Dataset, ring: Views) -> Source:
    """As `kitchen_source`, for an open dataset."""
    return Source(DatasetCopy.of(ds), KitchenStates(ds.states(), ring))
