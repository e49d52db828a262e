"""The arguments of ``zest select footage``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro

from zest_rl.cli.config import expand_variables
from zest_rl.errors import BadInput
from zest_rl.rewards.scores import Features, Similarity, check_names


@dataclass(frozen=True, kw_only=True)
class ClipArguments:
    """Selection on real video (Cui et al. §5.2): one clip specifies the goal by its first and last frame; do the frames
    of other clips that score highest come from the end of a clip?
    """

    what: ClassVar[str] = "footage"
    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER")]
    """Clips of one action by object, FOLDER/OBJECT/CLIP.mp4 or FOLDER/OBJECT/CLIP/ with pictures, or laid out as
    Something-Something V2. In a recipe, $NAME stands for an environment variable."""
    goals: Path | None = None
    """Folder of other clips, which specify the goals, for instance of rendered objects (the paper's sim2real); default
    FOLDER's own clips in turn."""
    ask: Literal["goals", "actions"] = "goals"
    """goals: does the frame reach the goal of the same object? actions: does it show the action, done to any object?
    The latter takes --pool all."""
    template: str = "Opening [something]"
    """With Something-Something V2: the action."""
    pool: Literal["single", "all"] = "single"
    """Candidates of the goal's object alone (narrow), or of all objects (diverse)."""
    context: Literal["same", "different"] = "same"
    """x_0 of a candidate: of its own clip, or of another one."""
    embedder: str = "efficientnet-lite0"
    """As in `zest relabel`."""
    features: Features = "delta"
    """As in `zest relabel`."""
    similarity: Similarity = "cos"
    """As in `zest relabel`."""
    top: int = 25
    """N of the Top-N success rate; fewer where fewer candidates reach the goal."""
    n_frames: int = 24
    """Frames of each clip, evenly spaced."""
    n_repeats: int = 10
    """Clips per object that specify the goal in turn."""
    max_clips: int | None = None
    """Clips per object to use, at least 3; default all."""
    precision: Literal["auto", "fp32", "bf16"] = "auto"
    """Of the embedder."""
    device: str = "auto"
    """auto, cpu, cuda, cuda:1, …"""

    def __post_init__(self) -> None:
        check_names(self.features, self.similarity)
        if min(self.top, self.n_repeats) < 1 or (self.max_clips is not None and self.max_clips < 3):
            raise BadInput("--top and --n-repeats must be at least 1, and --max-clips at least 3")
        if self.ask == "actions" and (self.pool, self.context) != ("all", "same"):
            raise BadInput("actions are sought among all objects, each clip against its own start; give --pool all")
        for folder in (self.folder, self.goals):
            if folder is not None:
                expand_variables(folder)
