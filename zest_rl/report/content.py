"""The items of a report's sections: frozen dataclasses, checked where they are built.

Returns are normalized, 100 % is the expert, 0 % is a robot that does nothing; or, where an item says so, sums of the
environment's own rewards. A figure that could not be computed is NaN and is displayed as "–".
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


def _check_equal_lengths(name: str, lengths: Mapping[str, int]) -> None:
    if len(set(lengths.values())) > 1:
        got = ", ".join(f"{array} {n}" for array, n in lengths.items())
        raise BadInput(f"{name}: {' and '.join(lengths)} must be equally long, got {got}; pass one value for each step")


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
    """`dataset`: the demonstrations; `method`: what is compared; `control`: what must do worse, or a bound."""
    note: str = ""
    paper_value: float | None = None
    """The paper's mean normalized return, in %; None when the paper has no such figure."""
    is_normalized: bool = True
    """Whether returns are in %; else they are sums of rewards."""

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
    """One evaluated episode: its video and its scores."""

    title: str
    method: str
    seed: int
    value: float
    """Normalized return in %, or the return itself."""
    success: bool | None
    """None where the environment does not tell it."""
    video: Path
    """MP4 file with H.264 video, which every browser plays; the page embeds it."""
    fps: float
    """Episode steps per second of video: the frame rate when every step is one frame."""
    gt_progress: FloatArray
    """(T+1,) float32, the ground-truth progress of the task's joint in [0, 1], or the environment's rewards; marked as
    evaluation only."""
    scores: FloatArray | None = None
    """(T+1,) float32, the ZeST score of every frame; None when the policy was not scored."""
    beside: tuple[str, FloatArray] | None = None
    """Another method on the same start, to the left in the video: its name and progress (T+1,) float32."""
    is_normalized: bool = True
    """Whether `value` is in %."""
    is_progress: bool = True
    """Whether `gt_progress` is progress rather than rewards."""

    @property
    def gt_name(self) -> str:
        """What `gt_progress` is."""
        return "Ground-truth progress" if self.is_progress else "Reward of the environment"

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
class Film:
    """An episode of a dataset: its video and its scores."""

    title: str
    video: bytes
    """MP4 with H.264 video."""
    fps: float
    """Steps per second of video."""
    scores: FloatArray
    """(T+1,) float32."""


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
    def finite(self) -> NDArray[np.intp]:
        """Indices (m,) of the finite points; the others are not drawn."""
        return np.flatnonzero(np.isfinite(self.x) & np.isfinite(self.y))


@dataclass(frozen=True)
class Series:
    """One line over gradient steps, or over the steps of an episode; curves of the same quantity share a chart."""

    name: str
    """Name in the legend: a method, a view, a group of episodes."""
    quantity: str
    """Label of the y axis, with its unit: `validation loss`."""
    steps: FloatArray
    """(n,) float32."""
    values: FloatArray
    """(n,) float32."""
    band: tuple[FloatArray, FloatArray] | None = None
    """(n,) float32 each, lower and upper edge of a band around `values`."""

    def __post_init__(self) -> None:
        edges = {} if self.band is None else {"low": len(self.band[0]), "high": len(self.band[1])}
        _check_equal_lengths(self.name, {"steps": len(self.steps), "values": len(self.values), **edges})


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
    """(n,) step of the episode of each frame."""
    scores: FloatArray
    """(n,) float32, normalised: 0 is the lowest and 1 the highest score of the dataset, or of the episode alone."""

    def __post_init__(self) -> None:
        _check_equal_lengths(
            self.title, {"frames": len(self.frames), "steps": len(self.steps), "scores": len(self.scores)}
        )


@dataclass(frozen=True)
class QualityRow:
    """One figure that judges rewards, for several datasets."""

    name: str
    meaning: str
    values: tuple[tuple[float, float, float] | None, ...]
    """Value, lower and upper end of its 95 % interval; None where it was not measured."""


@dataclass(frozen=True)
class QualityTable:
    """The figures that judge the rewards of several datasets."""

    datasets: tuple[str, ...]
    rows: tuple[QualityRow, ...]

    def __post_init__(self) -> None:
        for row in self.rows:
            _check_equal_lengths(row.name, {"values": len(row.values), "datasets": len(self.datasets)})


@dataclass(frozen=True)
class ScoreMatrix:
    """Mean score of the last frames of each source's episodes (rows), by the goal of each dataset (columns)."""

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
