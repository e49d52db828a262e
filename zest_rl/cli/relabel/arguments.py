"""The flags of ``zest relabel``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from zest_rl.rewards.scores import Features, Similarity, check_goal_share, check_names, check_reward


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
    """Cameras of the environment's model, to render recorded states from with the robot in view, averaged as views; or
    "default", that of env.render(). Without: a ring of views round what is moved, and the robot hidden."""
    env: str | None = None
    """package.module:make, a function that makes the environment of recorded states. Default: the dataset names it."""
    robot: tuple[str, ...] = ()
    """Bodies of the model that are hidden, with all below them. Default: what is driven."""
    look_at: str | None = None
    """Body of the model in the middle of the views. Default: the undriven one that moves most."""
    goal: str = "same-scene"
    """Folder with init/ and goal/ pictures, "text:closed microwave -> open microwave", or "episode:3", its ends; for
    the kitchen "same-scene", "toys" (toy scenes of the task), "text" (its sentences), "drawings" (a wrong goal)."""
    preview: Path | None = None
    """Write one picture of what the scorer will see, FILE.png, and stop: all views of an episode's ends, the goal."""
    embedder: str = "efficientnet-lite0"
    """Frozen network: efficientnet-lite0, open_clip:MODEL/PRETRAINED, torchvision:resnet50, timm:NAME, …@/path,
    transformers:/folder, or a family that another package registers."""
    features: Features = "delta"
    """Compare changes against the start, or the frames themselves; or a reward to compare with: VLM-RM's regularised
    similarity, the share of the distance to the goal that is covered, a classifier of goal against start."""
    similarity: Similarity = "cos"
    """Cosine, or minus the Euclidean distance."""
    reward: str = "level"
    """level, the score after each action; difference, its change (an ablation); or the folder of a run of `zest train
    trex`, whose learned rewards are written: then neither goal nor embedder is used."""
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
    masks: tuple[str, ...] = ()
    """Folders with a mask for each frame (white: the robot), one per view, as videos or PNGs like --frames; what they
    hide is filled from the frames in which it is seen. The cameras must not move."""
    skip_incomplete: bool = False
    """Leave out the episodes of a LeRobot folder that have no steps, or whose files were not downloaded."""
    precision: Literal["auto", "fp32", "bf16"] = "auto"
    """Of the embedder; auto: bf16 where the hardware has it, fp32 for the default embedder."""
    backend: Literal["auto", "torch"] = "auto"
    """Of the default embedder on a CPU; auto: ONNX Runtime, in half the time, equal to 1e-5; no part of the name."""
    vectors: Literal["float32", "float16"] = "float32"
    """To which embeddings are rounded; float16 halves the cache, and changes scores by less than .5 % of their span."""
    device: str = "auto"
    """auto, cpu, cuda, cuda:1, …"""
    n_workers: int | None = None
    """Processes; default one per core."""
    engine: Literal["local", "ray"] = "local"
    """Processes of this machine, or workers of the Ray cluster at RAY_ADDRESS (else one on this machine is started)."""

    def __post_init__(self) -> None:
        check_names(self.features, self.similarity)
        check_reward(self.reward)
        check_goal_share(self.goal_share)
