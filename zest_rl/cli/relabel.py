"""``zest relabel``: a dataset and a goal → a copy whose rewards are ZeST scores."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import tyro

from zest_rl.cli.ui import Ui, progress_in_parts
from zest_rl.errors import BadInput
from zest_rl.scores import Features, Similarity, check_names


@dataclass(frozen=True)
class Config:
    """Relabel a dataset: rewards become the similarity of the change in its frames to the change in the goal."""

    dataset: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATASET")]
    """Minari dataset with recorded simulator state."""
    goal: str = "same-scene"
    """Folder with init/ and goal/ pictures, "drawings", "same-scene", "text" (the task's own sentences), or
    "text:closed microwave -> open microwave"."""
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

    def __post_init__(self) -> None:
        check_names(self.features, self.similarity)
        if not 0 < self.goal_share <= 1:
            raise BadInput(f"goal_share must be in (0, 1], got {self.goal_share}")
        if self.views < 1:
            raise BadInput(f"the number of views must be at least 1, got {self.views}")


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Render, embed, score, write."""
    import time

    import numpy as np

    from zest_rl import data
    from zest_rl.frames import Views
    from zest_rl.relabel import relabel
    from zest_rl.scorer import ScorerConfig

    started = time.monotonic()
    views = Views(
        task=data.task_name(config.dataset),
        n_views=config.views,
        robot=config.show_robot,
        tolerance=config.tolerance,
    )
    scorer_config = ScorerConfig(
        views,
        config.goal,
        config.embedder,
        config.features,
        config.similarity,
        config.precision,
        config.goal_share,
    )
    with progress_in_parts(ui, "rendering and embedding") as on_progress:
        relabeled = relabel(
            config.dataset,
            scorer_config,
            reward=config.reward,
            shuffle=config.shuffle,
            device=config.device,
            n_workers=config.n_workers,
            on_progress=on_progress,
        )
    if relabeled.already_there:
        ui.say(f"{relabeled.dataset_id} is there already, nothing to do")
    returns = np.array([episode.rewards.sum() for episode in data.read_episodes(relabeled.dataset_id)])
    if np.ptp(returns) == 0:
        ui.warn("all episodes have the same return: this goal and embedder tell nothing apart")
    return {
        "dataset": relabeled.dataset_id,
        "path": str(relabeled.path),
        "n_frames": relabeled.n_frames,
        "n_distinct_states_embedded": relabeled.scorer.states.n_embedded,
        "n_still_frames": relabeled.n_still,
        "return_min": float(returns.min()),
        "return_max": float(returns.max()),
        "seconds": round(time.monotonic() - started, 2),
        "next": f"zest train dt {relabeled.dataset_id}",
    }
