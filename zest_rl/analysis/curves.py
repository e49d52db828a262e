"""One film and two pictures → a score per frame, to look at in a notebook before any dataset is relabeled.

The scores are those that `zest_rl.rewards.relabel` writes for the same frames.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from zest_rl.data.images import decode_image, list_images, read_image
from zest_rl.data.video import frame_times, iter_frames
from zest_rl.embedders import DEFAULT_EMBEDDER, Precision
from zest_rl.errors import BadInput
from zest_rl.rewards.frame_embeddings import STEPS_PER_BATCH
from zest_rl.rewards.goals import TEXT, GoalSpec, read_folder, read_text
from zest_rl.rewards.scorer import Scorer, ScorerConfig
from zest_rl.rewards.scores import Features, Similarity
from zest_rl.runtime import artifacts
from zest_rl.runtime.files import is_there, user_path
from zest_rl.types import FloatArray, Frame

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Picture: TypeAlias = str | Path | Image.Image | Frame
"""A file, or a picture in memory: of PIL, or (H, W, 3) uint8 RGB."""
Film: TypeAlias = str | Path | NDArray[np.uint8] | Iterable[Picture]
"""A video file, a folder of pictures in the order of their names, (T, H, W, 3) uint8 RGB, or pictures in order."""
State: TypeAlias = Picture | NDArray[np.uint8] | Sequence[Picture]
"""What the start or the goal looks like: a picture, several (also as a folder, or (N, H, W, 3)), or a sentence as
``"text:closed drawer"``."""

THUMBNAIL = 160
"""Longer side, in pixels, of the pictures in a notebook."""
_MEND = "put channels last with numpy.moveaxis, and turn floats in [0, 1] into (255 * x).round().astype('uint8')"


@dataclass(frozen=True, eq=False, repr=False)
class Curve:
    """How much each frame of a film looks like the goal. `numpy.asarray` gives the scores."""

    scores: FloatArray
    """(T,) float32, φ of each frame."""
    times: NDArray[np.float64]
    """(T,) when each frame is shown, in `unit`."""
    unit: str
    """``s`` of a video file, ``step`` of other films."""
    film: str
    """Name of the film."""
    goal: GoalSpec
    """Start and goal, as they were read."""
    first: Frame
    """The first frame, against which the change is taken."""
    last: Frame

    def __len__(self) -> int:
        return len(self.scores)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.array(self.scores, dtype=dtype, copy=copy)

    def __repr__(self) -> str:
        best = int(self.scores.argmax())
        when = f"{self.times[best]:.4g} s" if self.unit == "s" else f"step {self.times[best]:g}"
        return (
            f"Curve of {self.film}: {len(self)} scores, first {self.scores[0]:.3f}, last {self.scores[-1]:.3f}, "
            f"highest {self.scores[best]:.3f} at {when}"
        )

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the scores over time with matplotlib, into `ax` or a figure of its own, and return the axes."""
        if ax is None:
            from matplotlib import pyplot

            ax = pyplot.subplots(figsize=(7, 2.6), layout="constrained")[1]
        ax.plot(self.times, self.scores)
        ax.set(xlabel="time, s" if self.unit == "s" else self.unit, ylabel="ZeST score")
        ax.set_title(self.film, parse_math=False)
        ax.grid(alpha=0.3)
        return ax

    def to_csv(self, path: str | Path) -> Path:
        """Write one line per frame, its time and its score, and return the path."""
        lines = [f"{self.unit},score", *(f"{t:.10g},{score}" for t, score in zip(self.times, self.scores, strict=True))]
        artifacts.write_bytes(user_path(path), ("\n".join(lines) + "\n").encode())
        return user_path(path)

    def _repr_html_(self) -> str:
        """Return the curve as SVG below start, goal, first and last frame; notebooks show it."""
        from matplotlib.figure import Figure

        figure, svg = Figure(figsize=(7, 2.6), layout="constrained"), io.StringIO()
        self.plot(figure.subplots())
        figure.savefig(svg, format="svg")
        pictures: dict[str, Any] = (
            {} if self.goal.is_text else {"start": self.goal.starts[0], "goal": self.goal.goals[0]}
        )
        pictures |= {"first frame": self.first, "last frame": self.last}
        shown = "".join(_figure(caption, frame) for caption, frame in pictures.items())
        return f"<div>{escape(repr(self))}</div><div>{shown}</div>{svg.getvalue()[svg.getvalue().index('<svg') :]}"


def _figure(caption: str, frame: Frame) -> str:
    thumbnail, file = Image.fromarray(frame), io.BytesIO()
    thumbnail.thumbnail((THUMBNAIL, THUMBNAIL))
    thumbnail.save(file, "JPEG", quality=85)
    source = f"data:image/jpeg;base64,{base64.b64encode(file.getvalue()).decode()}"
    picture = f'<img src="{source}" alt="{caption}"><figcaption>{caption}</figcaption>'
    return f'<figure style="display:inline-block;margin:4px;text-align:center">{picture}</figure>'


def score(
    film: Film,
    start: State | None = None,
    goal: State | None = None,
    *,
    stride: int = 1,
    embedder: str = DEFAULT_EMBEDDER,
    features: Features = "delta",
    similarity: Similarity = "cos",
    precision: Precision = "auto",
    device: str = "auto",
) -> Curve:
    """Score the frames of a film by how much they changed as the goal differs from the start.

    Args:
        film: a video file, a folder of pictures in the order of their names, an array (T, H, W, 3) of uint8 RGB, or a
            list of pictures.
        start: a picture, several, or a sentence ("text:closed drawer"); None: the first frame of the film, or what
            `goal` says of it.
        goal: likewise; without a start also a folder with ``init/`` and ``goal/``, or "text:closed drawer -> open
            drawer", as `zest relabel` takes them.
        stride: score every so many frames; 1: all.
        embedder: as in `zest relabel`; likewise the others.
        features: compare changes since the first frame, or the frames themselves; `zest_rl.rewards.scores` has more.
        similarity: cosine, or minus the Euclidean distance.
        precision: of the embedder.
        device: where the embedder runs.

    Raises:
        BadInput: the film, the start or the goal cannot be read; the film has fewer than 2 frames; start and goal are
            equal, or one of them is a sentence and the other is not, or the embedder reads no text.
    """
    if stride < 1:
        raise BadInput(f"stride must be at least 1, got {stride}; 1 scores all frames, 10 every tenth")
    frames = islice(_frames(film), 0, None, stride)
    first = next(frames, None)
    if first is None:
        raise BadInput("a film must have at least 2 frames, got 0; give the frames of an episode in order")
    spec = read_states(start, goal, first)
    scorer = Scorer.build(ScorerConfig(spec.name, embedder, features, similarity, precision), spec, device=device)
    scorer.check_goal(device)
    network, parts, last = scorer.config.load_embedder(device), [], first
    rest = chain([first], frames)
    while batch := list(islice(rest, STEPS_PER_BATCH)):
        parts.append(network.embed_images(batch))
        last = batch[-1]
    embeddings = np.concatenate(parts)
    if len(embeddings) < 2:
        raise BadInput(
            f"a film must have at least 2 frames, as scores tell changes since the first, got 1 with stride {stride}; "
            "give the frames of an episode in order"
        )
    times, unit = _times(film, len(embeddings), stride)
    name = user_path(film).name if isinstance(film, str | Path) else f"{len(embeddings)} frames"
    return Curve(scorer.score(embeddings[:, None]), times, unit, name, spec, first, last)


def read_states(start: State | None, goal: State | None, first: Frame) -> GoalSpec:
    """Read what start and goal look like; `first` is the start where there is none.

    Raises:
        BadInput: as in `score`.
    """
    spec = _read(start, goal, first)
    starts, goals = (
        {state if isinstance(state, str) else artifacts.hash_arrays(state) for state in states}
        for states in (spec.starts, spec.goals)
    )
    if starts & goals:
        raise BadInput(
            "start and goal must differ, but both have the same "
            + ("sentence" if spec.is_text else "picture")
            + (" (without a start, it is the first frame of the film)" if start is None else "")
            + "; give what the task looks like before and after"
        )
    return spec


def _read(start: State | None, goal: State | None, first: Frame) -> GoalSpec:
    if goal is None:
        raise BadInput(
            "a score needs a goal, got none; give goal='open.png', several pictures, or, with an embedder that reads "
            "text, goal='text:open drawer'"
        )
    if start is None and isinstance(goal, str | Path):
        if str(goal).startswith(TEXT):
            return read_text(str(goal))
        if (user_path(goal) / "init").is_dir():
            return read_folder(user_path(goal), str(goal))
    starts = (first,) if start is None else _pictures(start, "start")
    goals = _pictures(goal, "goal")
    if isinstance(starts, str) and isinstance(goals, str):
        return read_text(f"{starts} -> {goals.removeprefix(TEXT)}")
    if isinstance(starts, str) or isinstance(goals, str):
        raise BadInput(
            "start and goal must both be pictures or both sentences, but only the "
            f"{'start' if isinstance(starts, str) else 'goal'} is a sentence; describe the other one, too"
        )
    return GoalSpec(str(goal) if isinstance(goal, str | Path) else "pictures", starts, goals)


def _pictures(state: State, what: str) -> str | tuple[Frame, ...]:
    """Read the pictures of a state; a sentence is returned as it is."""
    if isinstance(state, str) and state.startswith(TEXT):
        return state
    if isinstance(state, str | Path):
        path = user_path(state)
        if not is_there(path):
            raise BadInput(
                f"the {what} {str(state)!r} does not exist; give a picture, a folder of pictures, or a sentence that "
                f"starts with {TEXT!r}, as in 'text:open drawer'"
            )
        return tuple(map(read_image, list_images(path))) if path.is_dir() else (read_image(path),)
    if not isinstance(state, Iterable) or (isinstance(state, np.ndarray) and state.ndim != 4):
        return (_picture(state, f"the {what}"),)
    return tuple(_picture(picture, f"picture {i} of the {what}") for i, picture in enumerate(state))


def _picture(picture: Picture, what: str) -> Frame:
    """Return one picture as (H, W, 3) uint8 RGB, upright, transparency on white."""
    if isinstance(picture, str | Path):
        return read_image(user_path(picture))
    if isinstance(picture, Image.Image):
        upright, file = ImageOps.exif_transpose(picture), io.BytesIO()
        if not upright.has_transparency_data and upright.mode[0] not in "IF":
            return np.asarray(upright.convert("RGB"))
        try:
            upright.save(file, "PNG", compress_level=0)
        except OSError as error:
            raise BadInput(
                f"{what} is a PIL image of mode {upright.mode}, which is not read; convert it to RGB"
            ) from error
        return decode_image(file.getvalue(), what)
    if not isinstance(picture, np.ndarray) or picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
        raise BadInput(
            f"{what} must be a file, a PIL image, or an array of shape (H, W, 3) and dtype uint8, "
            f"got {_form(picture)}; {_MEND}"
        )
    return picture


def _form(value: object) -> str:
    return f"shape {value.shape} and dtype {value.dtype}" if isinstance(value, np.ndarray) else type(value).__name__


def _frames(film: Film) -> Iterator[Frame]:
    if isinstance(film, str | Path):
        return iter_frames(user_path(film))
    if isinstance(film, np.ndarray) and (film.ndim != 4 or film.shape[3] != 3 or film.dtype != np.uint8):
        raise BadInput(
            "a film as an array must have shape (T, H, W, 3) and dtype uint8 (RGB, 0 to 255), "
            f"got {_form(film)}; {_MEND}"
        )
    if not isinstance(film, Iterable):
        raise BadInput(
            "a film must be a video file, a folder of pictures, an array (T, H, W, 3) of uint8, or a list of pictures, "
            f"got {_form(film)}"
        )
    return (_picture(frame, f"frame {i}") for i, frame in enumerate(film))


def _times(film: Film, n: int, stride: int) -> tuple[NDArray[np.float64], str]:
    """Return when n frames are shown: in seconds where the film is a file that tells it of each, else steps."""
    if isinstance(film, str | Path) and user_path(film).is_file():
        times = frame_times(user_path(film))[::stride]
        if len(times) == n:
            return times, "s"
    return np.arange(n, dtype=np.float64) * stride, "step"
