"""A policy as its run describes it, read without torch: what a finished evaluation needs to know of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from zest_rl.agents.configs import config_of
from zest_rl.runtime.artifacts import read_checked, read_json
from zest_rl.runtime.records import from_json, reading_record


@dataclass(frozen=True)
class RecordedPolicy:
    """A policy that was trained here."""

    meta: dict[str, Any]
    """The run's ``meta.json``."""
    config: Any
    """Of its agent."""
    weights: bytes
    """Of ``model.safetensors``, which are those that ``meta.json`` names."""

    @property
    def agent(self) -> str:
        """Name in the registry."""
        return str(self.meta["agent"])

    @property
    def uses_return(self) -> bool:
        """As `zest_rl.agents.base.Policy` has it."""
        return bool(getattr(self.config, "condition_on_return", False))


def recorded_policy(run_dir: Path) -> RecordedPolicy:
    """Read the policy of a finished run.

    Raises:
        BadInput: ``meta.json`` is not as this package writes it, or its agent is unknown here.
        ZestError: the run is not finished, or its weights differ from those that ``meta.json`` names.
    """
    path = run_dir / "meta.json"
    meta: dict[str, Any] = read_json(path)
    with reading_record(path):
        config_class, sha256 = config_of(meta["agent"]), str(meta["model_sha256"])
        config = from_json(config_class, meta["config"])
    mend = "restore it from a copy or train again into a new folder"
    return RecordedPolicy(meta, config, read_checked(run_dir / "model.safetensors", sha256, mend))
