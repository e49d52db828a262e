"""robomimic: its SequenceDataset returns the dataset, and its behaviour cloning learns from it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import robomimic.utils.file_utils as FileUtils
import robomimic.utils.obs_utils as ObsUtils
import torch
from conftest import Recorded, flat
from robomimic.algo import algo_factory
from robomimic.config import config_factory
from robomimic.utils.dataset import SequenceDataset
from torch.utils.data import DataLoader

KEYS = ("actions", "rewards", "dones", "terminals", "timeouts", "zest_score", "gt_reward", "gt_episode_success")


@pytest.fixture
def config() -> object:
    config = config_factory(algo_name="bc")
    with config.values_unlocked():
        config.observation.modalities.obs.low_dim = ["flat"]
        config.algo.actor_layer_dims = (64, 64)
    ObsUtils.initialize_obs_utils_with_config(config)
    return config


def sequences(path: Path, keys: tuple[str, ...], mask: str | None = None, length: int = 1) -> SequenceDataset:
    return SequenceDataset(
        hdf5_path=str(path), obs_keys=("flat",), dataset_keys=keys, seq_length=length, hdf5_cache_mode="all",
        filter_by_attribute=mask,
    )  # fmt: skip


def test_every_item_is_the_dataset_s(config: object, exports: Path, recorded: list[Recorded]) -> None:
    dataset = sequences(exports / "robomimic", KEYS)
    assert dataset.n_demos == len(recorded)
    items = [dataset[i] for i in range(len(dataset))]
    terminated, truncated = flat(recorded, "terminated"), flat(recorded, "truncated")
    own = {
        "actions": flat(recorded, "actions"),
        "rewards": flat(recorded, "rewards"),
        "terminals": terminated,
        "timeouts": truncated,
        "dones": (terminated | truncated).astype(np.int64),
        "zest_score": np.concatenate([one.scores[1:] for one in recorded]),
        "gt_reward": flat(recorded, "gt_rewards"),
        "gt_episode_success": np.concatenate([np.full(len(one), one.success) for one in recorded]),
    }
    assert set(own) == set(KEYS)
    for key, values in own.items():
        np.testing.assert_array_equal(np.concatenate([item[key] for item in items]), values, err_msg=key)
    for key, values in (
        ("obs", np.concatenate([one.obs[:-1] for one in recorded])),
        ("next_obs", np.concatenate([one.obs[1:] for one in recorded])),
    ):
        np.testing.assert_array_equal(np.concatenate([item[key]["flat"] for item in items]), values, err_msg=key)


def test_a_sequence_runs_on_within_its_episode(config: object, exports: Path, recorded: list[Recorded]) -> None:
    dataset = sequences(exports / "robomimic", ("actions",), length=10)
    np.testing.assert_array_equal(dataset[5]["actions"], recorded[0].actions[5:15])
    last = len(recorded[0]) - 1
    np.testing.assert_array_equal(dataset[last]["actions"], np.repeat(recorded[0].actions[-1:], 10, axis=0))
    np.testing.assert_array_equal(dataset[last + 1]["actions"], recorded[1].actions[:10])


def test_the_masks_part_the_episodes(config: object, exports: Path, recorded: list[Recorded]) -> None:
    parts = [sequences(exports / "robomimic", ("actions",), mask) for mask in ("train", "valid")]
    assert sum(part.n_demos for part in parts) == len(recorded)
    assert not set(parts[0].demos) & set(parts[1].demos)


def test_behaviour_cloning_trains(config: object, exports: Path) -> None:
    torch.manual_seed(0)
    path = str(exports / "robomimic")
    shapes = FileUtils.get_shape_metadata_from_dataset(dataset_path=path, all_obs_keys=["flat"])
    model = algo_factory("bc", config, shapes["all_shapes"], shapes["ac_dim"], torch.device("cpu"))
    model.set_train()
    loader = DataLoader(sequences(exports / "robomimic", ("actions",), "train"), batch_size=64, shuffle=True)
    losses = []
    for epoch in range(1, 41):
        for batch in loader:
            ready = model.postprocess_batch_for_training(model.process_batch_for_training(batch), None)
            losses.append(model.log_info(model.train_on_batch(ready, epoch))["Loss"])
    assert len(losses) >= 200
    assert np.mean(losses[-20:]) < 0.8 * np.mean(losses[:20])


def test_its_own_script_trains_by_the_config_of_the_documentation(exports: Path, tmp_path: Path) -> None:
    config = {
        "algo_name": "bc",
        "experiment": {"rollout": {"enabled": False}, "epoch_every_n_steps": 20},
        "train": {"output_dir": str(tmp_path / "out"), "num_epochs": 1, "cuda": False},
        "observation": {"modalities": {"obs": {"low_dim": ["flat"]}}},
    }
    (tmp_path / "bc.json").write_text(json.dumps(config))
    script = [sys.executable, "-m", "robomimic.scripts.train", "--config", str(tmp_path / "bc.json")]
    done = subprocess.run([*script, "--dataset", str(exports / "robomimic")], capture_output=True, text=True)
    assert "finished run successfully!" in done.stdout, done.stdout + done.stderr
