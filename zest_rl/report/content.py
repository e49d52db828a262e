"""What the sections of a report are made of: frozen dataclasses, checked where they are built.

Returns are normalized: 100 % is the expert, 0 % is the robot that does nothing. A figure that could not be computed is
NaN and is shown as "–".
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from zest_rl.errors import BadInput, nearest
from zest_rl.types import FloatArray, Frame

Kind = Literal["dataset", "method", "control"]


def _check_equal_lengths(what: str, lengths: Mapping[str, int]) -> None:
    if len(set(lengths.values())) > 1:
        got = ", ".join(f"{name} {n}" for name, n in lengths.items())
        raise BadInput(f"{what}: {' and '.join(lengths)} must be equally long, got {got}; pass one value for each step")


@dataclass(frozen=True)
class MethodRow:
    """One row of the results table."""

    method: str
    mean: float
    """Mean normalized return, in %."""
    ci_low: float
    """Lower end of the 95 % confidence interval of `mean`, in %."""
    ci_high: float
    """Upper end, in %."""
    iqm: float
    """Interquartile mean of the normalized returns, in %."""
    success_rate: float
    """Share of successful episodes, in [0, 1]."""
    n_seeds: int
    n_episodes: int
    """Evaluated episodes, over all seeds."""
    kind: Kind = "method"
    """`dataset`: the demonstrations; `method`: what is compared; `control`: what must do worse or is a bound."""
    note: str = ""
    paper_value: float | None = None
    """The paper's mean normalized return, in %; None when the paper has no such figure."""

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise BadInput(f"{self.method}: unknown kind {self.kind!r}; {nearest(self.kind, get_args(Kind))}")


@dataclass(frozen=True)
class GoalPanel:
    """How one goal was specified, and how well its ZeST return ranks episodes."""

    name: str
    start: tuple[Frame | str, ...]
    """Images (H, W, 3) uint8 RGB, or sentences, of the state at the start."""
    goal: tuple[Frame | str, ...]
    """The same for the goal state."""
    spearman: float | None = None
    """Rank correlation of ZeST return and ground-truth return, in [-1, 1]; None when not computed."""
    n_episodes: int = 0
    """Episodes behind `spearman`."""

    def __post_init__(self) -> None:
        for item in (*self.start, *self.goal):
            if not isinstance(item, str) and (item.ndim != 3 or item.shape[2] != 3 or item.dtype != np.uint8):
                raise BadInput(
                    f"{self.name}: an image must have shape (H, W, 3) and dtype uint8, "
                    f"got shape {item.shape} and dtype {item.dtype}; convert it to RGB"
                )


@dataclass(frozen=True)
class EpisodePanel:
    """One evaluated episode: its video beside its scores."""

    title: str
    method: str
    seed: int
    normalized_return: float
    """In %."""
    success: bool
    video: Path
    """MP4 file with H.264 video, which every browser plays; it is embedded."""
    fps: float
    """Episode steps per second of video: the frame rate when every step is one frame."""
    gt_progress: FloatArray
    """(T+1,) float32, the ground-truth progress of the task's joint in [0, 1]; shown as evaluation only."""
    scores: FloatArray | None = None
    """(T+1,) float32, the ZeST score of every frame; None when the policy was not scored."""
    beside: tuple[str, FloatArray] | None = None
    """Another method on the same start, to the left in the video: its name and progress (T+1,) float32."""

    def __post_init__(self) -> None:
        if not 0 < self.fps < math.inf:
            raise BadInput(
                f"{self.title}: fps must be positive and finite, got {self.fps}; pass the steps per second of the video"
            )
        if len(self.gt_progress) < 2:
            raise BadInput(
                f"{self.title}: an episode must have at least 2 frames, got {len(self.gt_progress)}; drop it"
            )
        if self.scores is not None:
            _check_equal_lengths(self.title, {"scores": len(self.scores), "gt_progress": len(self.gt_progress)})
        if self.beside is not None:
            _check_equal_lengths(self.title, {"beside": len(self.beside[1]), "gt_progress": len(self.gt_progress)})


@dataclass(frozen=True)
class Scatter:
    """One point for each episode of a dataset, or for whatever `point` names."""

    name: str
    x: FloatArray
    """(n,) float32."""
    y: FloatArray
    """(n,) float32."""
    spearman: float
    """Rank correlation of `x` and `y`, in [-1, 1]."""
    ci: tuple[float, float] | None = None
    """95 % confidence interval of `spearman`."""
    x_name: str = "ground-truth return"
    y_name: str = "ZeST return"
    point: str = "episode"

    def __post_init__(self) -> None:
        _check_equal_lengths(self.name, {"x": len(self.x), "y": len(self.y)})

    @property
    def shown(self) -> NDArray[np.intp]:
        """(m,) indices of the points that are finite, which alone are drawn."""
        return np.flatnonzero(np.isfinite(self.x) & np.isfinite(self.y))


@dataclass(frozen=True)
class Curve:
    """One line over gradient steps, or over the steps of an episode; curves of the same quantity share a chart."""

    name: str
    """What the legend calls it: a method, a view, a group of episodes."""
    quantity: str
    """What is drawn upward, with its unit: `validation loss`."""
    steps: FloatArray
    """(n,) float32."""
    values: FloatArray
    """(n,) float32."""
    low: FloatArray | None = None
    """(n,) float32, lower edge of the band around `values`; needs `high`."""
    high: FloatArray | None = None
    """(n,) float32, upper edge."""

    def __post_init__(self) -> None:
        if (self.low is None) != (self.high is None):
            raise BadInput(f"{self.name}: a band needs both low and high, got one of them; pass both or neither")
        arrays = {"steps": self.steps, "values": self.values, "low": self.low, "high": self.high}
        _check_equal_lengths(self.name, {name: len(a) for name, a in arrays.items() if a is not None})

    @property
    def band(self) -> tuple[FloatArray, FloatArray] | None:
        """Lower and upper edge, where there are both."""
        return None if self.low is None or self.high is None else (self.low, self.high)


@dataclass(frozen=True)
class TaskTable:
    """The results of one task within a report over several."""

    task: str
    rows: tuple[MethodRow, ...]
    page: str
    """File name, beside the report, of the task's own report."""


@dataclass(frozen=True)
class Strip:
    """Frames of one episode in a row, with their scores below."""

    title: str
    frames: tuple[Frame, ...]
    steps: NDArray[np.intp]
    """(n,) which step of the episode each is."""
    scores: FloatArray
    """(n,) float32, normalised: 0 is the lowest and 1 the highest score of the dataset, or of the episode alone."""

    def __post_init__(self) -> None:
        _check_equal_lengths(
            self.title, {"frames": len(self.frames), "steps": len(self.steps), "scores": len(self.scores)}
        )


@dataclass(frozen=True)
class QualityRow:
    """One figure that judges rewards, for each of several datasets."""

    name: str
    meaning: str
    values: tuple[tuple[float, float, float] | None, ...]
    """Value, lower and upper end of its 95 % interval; None where it was not measured."""


@dataclass(frozen=True)
class QualityTable:
    """What the rewards of several datasets are worth."""

    datasets: tuple[str, ...]
    rows: tuple[QualityRow, ...]

    def __post_init__(self) -> None:
        for row in self.rows:
            _check_equal_lengths(row.name, {"values": len(row.values), "datasets": len(self.datasets)})


@dataclass(frozen=True)
class Matrix:
    """Mean score of where the episodes of each source (rows) end, by the goal of each dataset (columns)."""

    episodes: tuple[str, ...]
    goals: tuple[str, ...]
    values: FloatArray
    """(n_episodes, n_goals) float32."""
    low: FloatArray
    """Lower ends of their 95 % intervals, of the same shape."""
    high: FloatArray
    """Upper ends."""

    def __post_init__(self) -> None:
        shape = (len(self.episodes), len(self.goals))
        for values in (self.values, self.low, self.high):
            if values.shape != shape:
                raise BadInput(
                    f"a matrix of {shape[0]} sources and {shape[1]} goals must have shape {shape}, got {values.shape}"
                )

    @property
    def highest(self) -> NDArray[np.intp]:
        """(n_goals,) the row that each goal scores highest."""
        return np.asarray(self.values.argmax(axis=0))
