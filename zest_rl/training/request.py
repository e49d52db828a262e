"""What a training is asked for, and what a run folder holds of it; nothing here imports torch."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

from zest_rl.agents.configs import config_of
from zest_rl.agents.rules import Rules, check_fields
from zest_rl.errors import BadInput
from zest_rl.runtime import artifacts
from zest_rl.types import Episode


@dataclass(frozen=True)
class RunConfig:
    """Where a policy is trained, and what of it is kept."""

    seed: int = 0
    """Of weights, batches and dropout."""
    device: str = "auto"
    """auto (CUDA where there is a GPU), cpu, cuda, cuda:1, …"""
    threads: int | None = None
    """CPU threads; default torch's own. The last digits of the result depend on it."""
    checkpoint_every: int = 500
    """Updates, or steps in the environment, between checkpoints, from which an interrupted run goes on."""
    log_every: int = 50
    """Updates, or steps, between log rows (metrics.csv, TensorBoard), which hold means over these updates."""
    snapshot_every: int | None = None
    """Updates, or steps, between policies kept in RUN/snapshots, which `zest evaluate` takes too; default none."""

    def __post_init__(self) -> None:
        check_fields("training", self, self.rules())

    def rules(self) -> Rules:
        """Return the rules of the fields."""
        return {
            "seed": (self.seed >= 0, "0 or positive"),
            "threads": (self.threads is None or self.threads >= 1, "at least 1, or None"),
            "checkpoint_every": (self.checkpoint_every >= 1, "at least 1"),
            "log_every": (self.log_every >= 1, "at least 1"),
            "snapshot_every": (self.snapshot_every is None or self.snapshot_every >= 1, "at least 1, or None"),
        }


@dataclass(frozen=True)
class TrainingConfig(RunConfig):
    """How long and where a policy is trained on a dataset; each algorithm has its own config besides."""

    n_updates: int = 5000
    """Gradient steps."""

    def rules(self) -> Rules:
        """Return the rules of the fields."""
        return {**super().rules(), "n_updates": (self.n_updates >= 1, "at least 1")}


class OnProgress(Protocol):
    """Called after every logged row."""

    def __call__(self, n: int, **fields: float) -> None:
        """Take the number of updates since the last call (at first, since update 0), and the row by `COLUMNS`."""


def data_sha256(episodes: Sequence[Episode]) -> str:
    """Hash everything that is learned from."""
    return artifacts.hash_arrays(*(array for e in episodes for array in (e.obs, e.actions, e.rewards)))


def asked(agent: str, agent_config: Any, episodes: Sequence[Episode], config: TrainingConfig) -> dict[str, Any]:
    """Return what ``run.json`` holds of a training; None for what the machine decides, if it is left to it."""
    return {
        "agent": agent,
        "config": asdict(agent_config),
        "n_updates": config.n_updates,
        "seed": config.seed,
        "device": None if config.device == "auto" else config.device,
        "threads": config.threads,
        "snapshot_every": config.snapshot_every,
        "precision": None,
        "data_sha256": data_sha256(episodes),
    }


def is_finished(run_dir: Path, request: Mapping[str, Any]) -> bool:
    """Whether a folder holds this training, finished, by whatever machine.

    Args:
        run_dir: the run's folder.
        request: what `asked` returned, or `zest_rl.online.runs.train` asks for, and the facts about the data.
    """
    path = run_dir / "run.json"
    if not (path.exists() and (run_dir / "meta.json").exists()) or (run_dir / "checkpoints").exists():
        return False
    left_open = [key for key in ("device", "threads", "precision") if request[key] is None]
    return not differences(artifacts.read_json(path) | dict.fromkeys(left_open), request)


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return in words what differs between two requests; options newer than the first had their defaults there."""
    defaults = _flat({"config": asdict(config_of(now["agent"])())})
    was, is_now = defaults | _flat(before), _flat(json.loads(json.dumps(now)))
    return [
        f"{key} (was {was.get(key)!r}, is {is_now.get(key)!r})"
        for key in sorted(was.keys() | is_now.keys())
        if was.get(key) != is_now.get(key)
    ]


def default_run_dir(label: str, dataset_id: str, seed: int) -> Path:
    """Return ``runs/DATASET-LABEL-seedN``, where the label is the agent or the adopted policy's name."""
    return Path("runs") / f"{dataset_id.split('/')[-1]}-{label}-seed{seed}"


def check_request(run_dir: Path, request: dict[str, Any]) -> None:
    """Write ``run.json``, or check that the existing one holds the same arguments.

    Raises:
        BadInput: it holds others, or the folder other files.
    """
    path = run_dir / "run.json"
    if path.exists():
        if differing := differences(artifacts.read_json(path), request):
            raise BadInput(
                f"{run_dir} holds a run with other arguments: {'; '.join(differing)}; repeat the arguments of that "
                "run, or give another --run-dir"
            )
    elif run_dir.exists() and any(not entry.name.startswith(".") for entry in run_dir.iterdir()):
        raise BadInput(f"{run_dir} is not empty and holds no run; give another --run-dir")
    else:
        artifacts.write_json(path, request)


def snapshot_folder(run_dir: Path, update: int) -> Path:
    """Return the folder of the policy after `update` updates, whether or not it is kept."""
    return run_dir / "snapshots" / f"update-{update:09d}"


def snapshots(run_dir: Path) -> list[Path]:
    """Return the folders of the policies that a training kept along the way, the earliest first."""
    return sorted((run_dir / "snapshots").glob("update-*"))


def _flat(value: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested objects as one, with dotted keys."""
    items: dict[str, Any] = {}
    for key, entry in value.items():
        items |= _flat(entry, f"{prefix}{key}.") if isinstance(entry, dict) else {f"{prefix}{key}": entry}
    return items
