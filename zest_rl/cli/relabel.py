"""``zest relabel``: a dataset and a goal → a copy whose rewards are ZeST scores."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from zest_rl.cli.ui import Ui, progress_in_parts
from zest_rl.errors import BadInput
from zest_rl.rewards.scores import Features, Similarity, check_goal_share, check_names

if TYPE_CHECKING:
    from zest_rl.data.reader import Dataset


@dataclass(frozen=True)
class Config:
    """Relabel a dataset: rewards become the similarity of the change in its frames to the change in the goal."""

    dataset: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATASET")]
    """Minari dataset: of zest/Kitchen-v1, or of any robot, with pictures among its observations or recorded
    MuJoCo states; or the path of a robomimic HDF5 file or a LeRobot v3 folder."""
    frames: tuple[str, ...] = ()
    """Where the frames are: entries with pictures (observations/KEY), or folders with episode_0.mp4, … or episode_0/
    with pictures; several are views that are averaged. Default: the only pictures there are, else recorded states."""
    camera: tuple[str, ...] = ()
    """Cameras of the environment's model, to render recorded states from, averaged as views. Default: its own."""
    goal: str = "same-scene"
    """Folder with init/ and goal/ pictures, or "text:closed microwave -> open microwave"; and for the kitchen
    "drawings", "same-scene", or "text" (the task's own sentences)."""
    embedder: str = "efficientnet-lite0"
    """Frozen network: efficientnet-lite0, open_clip:MODEL/PRETRAINED, torchvision:resnet50, timm:NAME, …@/path,
    transformers:/folder, or a family that another package registers."""
    features: Features = "delta"
    """Compare changes against the start, or the frames themselves; or a reward to compare with: VLM-RM's regularised
    similarity, the share of the distance to the goal that is covered, a classifier of goal against start."""
    similarity: Similarity = "cos"
    """Cosine, or minus the Euclidean distance."""
    reward: Literal["level", "difference"] = "level"
    """The score after each action, or its change (an ablation)."""
    goal_share: float = 1.0
    """Share of the goal pictures to use: those that the dataset's episodes end nearest to."""
    shuffle: int | None = None
    """Null control: give each episode the scores of another one, drawn with this seed."""
    views: int = 8
    """Cameras around the object; scores are averaged over them."""
    show_robot: bool = False
    """Keep the robot in view (the paper removes it)."""
    tolerance: float = 1e-3
    """States that agree to this many rad or m are rendered and embedded once; 0: only equal states."""
    precision: Literal["auto", "fp32", "bf16"] = "auto"
    """Of the embedder; auto: bf16 where the hardware has it, fp32 for the default embedder."""
    device: str = "auto"
    """auto, cpu, cuda, cuda:1, …"""
    n_workers: int | None = None
    """Processes; default one per core."""
    engine: Literal["local", "ray"] = "local"
    """Processes of this machine, or workers of the Ray cluster at RAY_ADDRESS (else one on this machine is started)."""

    def __post_init__(self) -> None:
        check_names(self.features, self.similarity)
        check_goal_share(self.goal_share)
        if self.views < 1:
            raise BadInput(f"the number of views must be at least 1, got {self.views}")


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Render or read, embed, score, write."""
    import time

    import numpy as np

    from zest_rl.data.reader import open_dataset
    from zest_rl.rewards.relabel import relabel

    started = time.monotonic()
    with progress_in_parts(ui, "embedding frames") as on_progress:
        relabeled = relabel(**vars(config), on_progress=on_progress)
    if relabeled.already_there:
        ui.say(f"{relabeled.dataset_id} is there already, nothing to do")
    if relabeled.source.frames.describe().get("qpos_is_noisy"):
        ui.warn("states are read from observations that the environment blurred: what is shown trembles a little")
    with open_dataset(relabeled.dataset_id) as ds:
        returns = np.array([rewards.sum() for rewards in ds.rewards()])
        command = _next_command(ds)
    if np.ptp(returns) == 0:
        ui.warn("all episodes have the same return: this goal and embedder tell nothing apart")
    return {
        "dataset": relabeled.dataset_id,
        "path": str(relabeled.path),
        "n_frames": relabeled.n_frames,
        "views": list(relabeled.source.frames.views),
        f"n_{relabeled.unit}_embedded": relabeled.n_embedded,
        "n_still_frames": relabeled.n_still,
        "return_min": float(returns.min()),
        "return_max": float(returns.max()),
        "seconds": round(time.monotonic() - started, 2),
        "next": command,
    }


def _next_command(ds: Dataset) -> str:
    """Name a command that works on what a dataset observes and how it acts."""
    import numpy as np

    from zest_rl.data.observations import acts_discretely, entries, is_numbers

    groups = list(ds.groups.values())
    if not any(map(is_numbers, entries(groups[0]["observations"]).values())):
        return f"zest inspect {ds.id}"
    trains = all(not acts_discretely(group) and np.abs(group["actions"][()]).max() <= 1 for group in groups)
    return f"zest train dt {ds.id}" if trains else f"zest export {ds.id} --to npz"
