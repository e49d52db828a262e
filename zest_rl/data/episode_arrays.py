"""The arrays of one episode in a Minari file, each checked where it is read: T or T + 1 rows of finite numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from zest_rl.data.hdf5 import check_rows, read_array
from zest_rl.data.observations import acts_discretely, entries, numbers
from zest_rl.data.picture_forms import PictureForm
from zest_rl.errors import BadInput
from zest_rl.types import FloatArray, check_finite


@dataclass(frozen=True)
class EpisodeArrays:
    """An episode of T steps; the layout is drawn in `zest_rl.data.reader`."""

    group: h5py.Group
    n_steps: int
    """T."""

    def read(
        self, name: str, dtype: type = np.float32, *, n_more: int = 0, ndim: int | None = 1, finite: bool = True
    ) -> NDArray[Any]:
        """Read an array of T + `n_more` rows.

        Args:
            name: its path in the episode.
            dtype: of the result.
            n_more: 1 where there is one row per frame, 0 where there is one per action.
            ndim: number of dimensions; None: any.
            finite: whether NaN and infinity are refused.

        Raises:
            BadInput: there is none, or it breaks one of these rules.
        """
        node = self._find(name)
        if not isinstance(node, h5py.Dataset):
            raise BadInput(f"{name!r} in {self.group.name} must be one flat array, got a group")
        check_rows(name, node, self.n_steps, n_more)
        if ndim is not None and len(node.shape) != ndim:
            raise BadInput(f"{name} must have {ndim} dimensions, got shape {node.shape}; repair or drop the episode")
        values = read_array(node, dtype)
        return check_finite(name, values) if finite else values

    def is_terminated(self) -> bool:
        """Whether the last step ended the task."""
        return bool(self.read("terminations")[-1])

    def observed(self) -> dict[str, h5py.Dataset]:
        """Return the entries of the observations by their paths, of T + 1 rows each; none is read."""
        observed = entries(self._find("observations"), "observations")
        for path, entry in observed.items():
            check_rows(path, entry, self.n_steps, 1)
        return observed

    def observations(self, forms: Mapping[str, PictureForm]) -> FloatArray:
        """Read the observations (T+1, obs_dim); a Dict is flattened. `forms`: of the first episode, see `numbers`."""
        observed = self.observed()
        if list(observed) == ["observations"] and observed["observations"].ndim == 2:
            return read_array(observed["observations"], np.float32)
        return numbers(self.group["observations"], forms)

    def actions(self, discrete: bool) -> FloatArray:
        """Read the actions (T, act_dim), flattened; whole numbers only if `discrete`."""
        actions, is_discrete = self.read("actions", ndim=None), acts_discretely(self.group)
        if is_discrete and not discrete:
            raise BadInput("its actions are discrete, a policy here acts by continuous ones; `zest export` takes them")
        return (
            actions.reshape(len(actions), math.prod(actions.shape[1:])) if actions.ndim > 1 or is_discrete else actions
        )

    def _find(self, name: str) -> Any:
        node = self.group.get(name)
        if node is None:
            raise BadInput(
                f"there is no {name!r} in {self.group.name}; record it when the dataset is made (zest_rl.data.reader "
                "describes the layout)"
            )
        return node
