"""The dataset as the Minari file holds it, read with h5py alone: what a library makes of an export must equal it."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest


@dataclass(frozen=True)
class Recorded:
    """One episode of T actions."""

    obs: np.ndarray
    """(T+1, obs_dim) float32."""
    actions: np.ndarray
    """(T, act_dim) float32."""
    rewards: np.ndarray
    """(T,) float32."""
    terminated: np.ndarray
    """(T,) bool."""
    truncated: np.ndarray
    """(T,) bool."""
    scores: np.ndarray
    """(T+1,) float32."""
    gt_rewards: np.ndarray
    """(T,) float32."""
    success: bool

    def __len__(self) -> int:
        return len(self.actions)


def flat(episodes: list[Recorded], field: str) -> np.ndarray:
    """One field of all episodes in a row."""
    return np.concatenate([getattr(episode, field) for episode in episodes])


@pytest.fixture(scope="session")
def folder() -> Path:
    """What make_exports.py wrote."""
    return Path(os.environ["ZEST_INTEROP"])


@pytest.fixture(scope="session")
def exports(folder: Path) -> Path:
    """One file or folder per format."""
    return folder / "exports"


@pytest.fixture(scope="session")
def dataset_id(folder: Path) -> str:
    """Of the exported dataset; `zest_rl.data.reader` finds it too."""
    os.environ["MINARI_DATASETS_PATH"] = str(folder / "minari")
    return (folder / "dataset_id").read_text()


@pytest.fixture(scope="session")
def recorded(folder: Path, dataset_id: str) -> list[Recorded]:
    """The episodes: the second one ends by itself, the third one is shorter than the others."""

    def read(group: Any) -> Recorded:
        return Recorded(
            obs=group["observations"][()],
            actions=group["actions"][()],
            rewards=group["rewards"][()].astype(np.float32),
            terminated=group["terminations"][()],
            truncated=group["truncations"][()],
            scores=group["infos/zest/score"][()].astype(np.float32),
            gt_rewards=group["infos/gt/reward"][1:].astype(np.float32),
            success=bool(group["infos/gt/success"][()].any()),
        )

    with h5py.File(folder / "minari" / dataset_id / "data/main_data.hdf5") as file:
        found = [read(file[f"episode_{i}"]) for i in range(len(file))]
    assert [bool(one.terminated[-1]) for one in found] == [False, True, False, False, False, False]
    assert len({len(one) for one in found}) == 2
    return found


@pytest.fixture
def discrete_id(folder: Path, dataset_id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A copy of the dataset whose actions are of a Discrete space with 4 actions: row t of an episode is t mod 4."""
    shutil.copytree(folder / "minari" / dataset_id, tmp_path / dataset_id)
    with h5py.File(tmp_path / dataset_id / "data/main_data.hdf5", "r+") as file:
        for episode in file.values():
            n_steps = len(episode["actions"])
            del episode["actions"]
            episode["actions"] = np.arange(n_steps) % 4
    (tmp_path / dataset_id / "zest_manifest.json").unlink(missing_ok=True)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return dataset_id
