"""The arguments of `zest_rl.kitchen.collect.collect_dataset`. Importing this module loads no simulator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from zest_rl.errors import BadInput
from zest_rl.kitchen.tasks import get_task

LARGEST = {"noise_max": 2.0, "stop_share": 1.0, "slow_max": 0.9, "bias_max": 1.0, "grip_max": 0.1}
"""Largest values of the expert's flaws, any of which can be calibrated."""

OF_RL = ("noise_max", "bias_max")
"""The flaws that an expert found by RL can have: those of its actions. Others need the script's plan."""
MAX_EPISODES = 1_000_000
"""75 GB, all of which are in memory when they are written."""


def check_flaws(flaws: Mapping[str, float]) -> None:
    """Check that values are in [0, `LARGEST`]; raises `BadInput`."""
    for name, value in flaws.items():
        if not 0 <= value <= LARGEST[name]:
            raise BadInput(f"{name} must be in [0, {LARGEST[name]}], got {value}")


def check_n_episodes(n_episodes: int) -> None:
    """Check that a number of episodes is in [1, `MAX_EPISODES`]; raises `BadInput`."""
    if n_episodes < 1:
        raise BadInput(f"n-episodes must be at least 1, got {n_episodes}")
    if n_episodes > MAX_EPISODES:
        raise BadInput(f"n-episodes must be at most {MAX_EPISODES}, got {n_episodes}; collect several datasets")


@dataclass(frozen=True)
class CollectConfig:
    """An imperfect expert of one task; one of its flaws may be calibrated so that the dataset meets `level`."""

    task: str = "micro"
    """Which of the kitchen's tasks (knob2, knob3, ldoor, rdoor, sdoor, micro)."""
    n_episodes: int = 100
    """Episodes of 100 steps."""
    noise_max: float | Literal["calibrate"] = "calibrate"
    """Largest level of the action noise, drawn per episode (1 = the whole action range)."""
    stop_share: float | Literal["calibrate"] = 0.0
    """Share of the episodes in which the expert stops early."""
    slow_max: float | Literal["calibrate"] = 0.0
    """Largest share of its speed that the expert lacks, drawn per episode."""
    bias_max: float | Literal["calibrate"] = 0.0
    """Largest constant error of the actions, drawn per episode."""
    grip_max: float | Literal["calibrate"] = 0.0
    """Largest error of the grip in m, drawn per episode."""
    level: float = 81.19
    """Mean normalized return to calibrate to, in percent of the expert; the default is the paper's "Demo"."""
    seed: int = 0
    """Of starts, noise levels and noise."""
    expert: Literal["scripted", "rl"] = "scripted"
    """Who acts: a script, or a policy that soft actor-critic found, whose actions are samples of its Gaussian."""
    dataset: str = "zest/kitchen-{task}-noisy-v0"
    """Id of the new Minari dataset; {task} stands for the task."""

    def __post_init__(self) -> None:
        check_n_episodes(self.n_episodes)
        if not 0 < self.level <= 100:
            raise BadInput(f"level must be in (0, 100] percent of the expert, got {self.level}")
        if self.seed < 0:
            raise BadInput(f"seed must be 0 or positive, got {self.seed}")
        calibrated = [name for name in LARGEST if name not in self.given_flaws]
        if len(calibrated) > 1:
            raise BadInput(f"one number can be calibrated, got {' and '.join(calibrated)}; give the others a value")
        get_task(self.task)
        check_flaws(self.given_flaws)
        if self.expert not in ("scripted", "rl"):
            raise BadInput(f"expert must be scripted or rl, got {self.expert!r}")
        wrong = [name for name in LARGEST if name not in OF_RL and getattr(self, name) != 0.0]
        if self.expert == "rl" and wrong:
            raise BadInput(f"an expert found by RL has the flaws {' and '.join(OF_RL)}, got {', '.join(wrong)}")

    @property
    def dataset_id(self) -> str:
        """Id of the dataset of this task."""
        return self.dataset.replace("{task}", self.task)

    @property
    def given_flaws(self) -> dict[str, float]:
        """The flaws that have a value, without the one that is calibrated."""
        flaws = {name: getattr(self, name) for name in LARGEST}
        return {name: value for name, value in flaws.items() if value != "calibrate"}

    @property
    def calibrated(self) -> str | None:
        """Name of the flaw that is calibrated."""
        return next((name for name in LARGEST if name not in self.given_flaws), None)
