"""LeRobot: the folder opens as a LeRobotDataset that holds the dataset; ACT, buffer and RA-BC weights work on it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

os.environ |= {"HF_HUB_OFFLINE": "1", "HF_HOME": os.environ["ZEST_INTEROP"] + "/huggingface"}

import numpy as np
import pytest
import torch
from conftest import Recorded, flat
from lerobot.configs.types import FeatureType
from lerobot.datasets.dataset_tools import delete_episodes
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.act.processor_act import make_act_pre_post_processors
from lerobot.rewards.sarm.rabc import RABCWeights
from lerobot.rl.buffer import ReplayBuffer
from lerobot.utils.feature_utils import dataset_to_policy_features

FPS = 12


@pytest.fixture
def opened(exports: Path) -> Any:
    """Open the folder, with keywords of `LeRobotDataset`."""

    def open_(**options: Any) -> LeRobotDataset:
        return LeRobotDataset("zest/interop", root=exports / "lerobot", **options)

    return open_


def test_every_frame_is_the_dataset_s(opened: Any, recorded: list[Recorded]) -> None:
    dataset = opened()
    lengths = [len(one) for one in recorded]
    terminated, truncated = flat(recorded, "terminated"), flat(recorded, "truncated")
    obs = np.concatenate([one.obs[:-1] for one in recorded])
    frame = np.concatenate([np.arange(length) for length in lengths])
    own = {
        "observation.state": obs,
        "observation.environment_state": obs,
        "action": flat(recorded, "actions"),
        "next.observation.state": np.concatenate([one.obs[1:] for one in recorded]),
        "next.reward": flat(recorded, "rewards"),
        "next.done": terminated | truncated,
        "next.truncated": truncated,
        "next.zest_score": np.concatenate([one.scores[1:] for one in recorded]),
        "next.gt_reward": flat(recorded, "gt_rewards"),
        "gt_episode_success": np.concatenate([np.full(len(one), one.success) for one in recorded]),
        "timestamp": (frame / FPS).astype(np.float32),
        "frame_index": frame,
        "episode_index": np.repeat(np.arange(len(recorded)), lengths),
        "index": np.arange(sum(lengths)),
        "task_index": np.zeros(sum(lengths), np.int64),
    }
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (len(recorded), sum(lengths), FPS)
    assert set(dataset.features) == set(own)
    found = dataset.hf_dataset.with_format("numpy")[:]
    for key, values in own.items():
        np.testing.assert_array_equal(found[key], values, err_msg=key)
    for i in (0, lengths[0], sum(lengths) - 1):
        item = dataset[i]
        assert item["task"] == "open microwave"
        for key in ("observation.state", "action", "next.reward"):
            np.testing.assert_array_equal(item[key].numpy(), own[key][i])


def test_one_episode_can_be_read_alone(opened: Any, recorded: list[Recorded]) -> None:
    dataset = opened(episodes=[2])
    assert len(dataset) == len(recorded[2])
    np.testing.assert_array_equal(dataset[0]["action"].numpy(), recorded[2].actions[0])


def test_windows_stay_within_their_episode(opened: Any, recorded: list[Recorded]) -> None:
    dataset = opened(delta_timestamps={"action": [step / FPS for step in range(10)]})
    np.testing.assert_array_equal(dataset[5]["action"].numpy(), recorded[0].actions[5:15])
    last = dataset[len(recorded[0]) - 1]
    assert last["action_is_pad"].tolist() == [False] + [True] * 9
    np.testing.assert_array_equal(last["action"][0].numpy(), recorded[0].actions[-1])


def test_statistics_are_those_of_all_frames(opened: Any, recorded: list[Recorded]) -> None:
    stats = opened().meta.stats
    actions = flat(recorded, "actions")
    for name, values in (("mean", actions.mean(0)), ("std", actions.std(0)), ("max", actions.max(0))):
        np.testing.assert_allclose(stats["action"][name], values, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(stats["action"]["q50"], np.quantile(actions, 0.5, axis=0), atol=1e-6)
    assert stats["next.reward"]["count"].tolist() == [len(actions)]


def test_its_tools_edit_the_dataset(opened: Any, recorded: list[Recorded], tmp_path: Path) -> None:
    fewer = delete_episodes(opened(), [0], output_dir=tmp_path / "fewer", repo_id="zest/fewer")
    assert fewer.num_episodes == len(recorded) - 1
    np.testing.assert_array_equal(fewer[0]["action"].numpy(), recorded[1].actions[0])


def test_its_replay_buffer_holds_the_transitions(opened: Any, recorded: list[Recorded]) -> None:
    buffer = ReplayBuffer.from_lerobot_dataset(opened(), device="cpu", state_keys=["observation.state"], use_drq=False)
    n = sum(map(len, recorded))
    obs = np.concatenate([one.obs[:-1] for one in recorded])
    np.testing.assert_array_equal(buffer.states["observation.state"][:n].numpy(), obs)
    np.testing.assert_array_equal(buffer.actions[:n].numpy(), flat(recorded, "actions"))
    np.testing.assert_array_equal(buffer.rewards[:n].numpy(), flat(recorded, "rewards"))
    dones = flat(recorded, "terminated") | flat(recorded, "truncated")
    np.testing.assert_array_equal(buffer.dones[:n].numpy(), dones)
    after = np.concatenate([one.obs[1:] for one in recorded])
    np.testing.assert_array_equal(buffer.next_states["observation.state"][:n].numpy()[~dones], after[~dones])


@pytest.mark.parametrize("side_car", ["lerobot/sarm_progress.parquet", "lerobot-progress"])
def test_reward_aligned_cloning_weighs_frames_by_the_scores(
    exports: Path, recorded: list[Recorded], side_car: str
) -> None:
    weights = RABCWeights(exports / side_car, chunk_size=10, device=torch.device("cpu"))
    scores = np.concatenate([one.scores[:-1] for one in recorded])
    progress = (scores - scores.min()) / np.ptp(scores)
    assert list(weights.progress_lookup) == list(range(len(scores)))
    np.testing.assert_allclose(list(weights.progress_lookup.values()), progress, atol=1e-6)
    starts = np.cumsum([0, *map(len, recorded[:-1])])
    index = np.concatenate([start + np.arange(len(one) - 10) for start, one in zip(starts, recorded, strict=True)])
    found, _ = weights.compute_batch_weights({"index": torch.as_tensor(index)})
    gained = progress[index + 10] - progress[index]
    assert (gained < -1e-6).any()
    assert (gained > 0.02).any()
    assert not found[torch.as_tensor(gained < -1e-6)].any()
    assert (found[torch.as_tensor(gained > 0.02)] > 0).all()


def test_act_trains(opened: Any) -> None:
    torch.manual_seed(0)
    dataset = opened(delta_timestamps={"action": [step / FPS for step in range(10)]})
    features = dataset_to_policy_features(dataset.features)
    config = ACTConfig(
        input_features={key: feature for key, feature in features.items() if feature.type is not FeatureType.ACTION},
        output_features={key: feature for key, feature in features.items() if feature.type is FeatureType.ACTION},
        chunk_size=10, n_action_steps=10, dim_model=64, n_heads=4, dim_feedforward=128, n_encoder_layers=1,
        use_vae=False, optimizer_lr=1e-3, device="cpu",
    )  # fmt: skip
    assert set(config.input_features) == {"observation.state", "observation.environment_state"}
    policy = ACTPolicy(config)
    prepare, _ = make_act_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    optimizer = torch.optim.Adam(policy.parameters(), lr=1e-3)
    loader = torch.utils.data.DataLoader(dataset, batch_size=16, shuffle=True, drop_last=True)
    losses = []
    for _ in range(6):
        for batch in loader:
            loss, _ = policy.forward(prepare(batch))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
    assert len(losses) >= 200
    assert np.mean(losses[-20:]) < 0.8 * np.mean(losses[:20])


def test_its_own_command_trains_without_further_settings_of_the_dataset(exports: Path, tmp_path: Path) -> None:
    small = ("--policy.dim_model=32", "--policy.n_heads=4", "--policy.dim_feedforward=64", "--policy.device=cpu")
    done = subprocess.run(
        [
            Path(sys.executable).with_name("lerobot-train"), "--dataset.repo_id=zest/interop",
            f"--dataset.root={exports / 'lerobot'}", "--policy.type=act", "--policy.push_to_hub=false", *small,
            "--steps=20", "--batch_size=8", "--num_workers=0", "--save_checkpoint=false",
            f"--output_dir={tmp_path / 'out'}",
        ],
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "End of training" in done.stdout + done.stderr
