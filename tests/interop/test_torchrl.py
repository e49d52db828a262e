"""TorchRL: the folder and the TensorDict hold the dataset, its samplers and its IQL work on them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import Recorded, flat
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Categorical, ImmutableDatasetWriter, SliceSampler, TensorDictReplayBuffer, TensorStorage
from torchrl.data.datasets import D4RLExperienceReplay, MinariExperienceReplay
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, QValueActor, TanhNormal
from torchrl.objectives import DiscreteCQLLoss, IQLLoss, SoftUpdate

from zest_rl.export import export, to_torchrl


@pytest.fixture(params=["folder", "to_torchrl"])
def data(request: pytest.FixtureRequest, exports: Path, dataset_id: str) -> TensorDict:
    if request.param == "to_torchrl":
        return to_torchrl(dataset_id)
    return TensorDict.load_memmap(exports / "torchrl")


def test_every_entry_is_the_dataset_s(data: TensorDict, recorded: list[Recorded]) -> None:
    n = sum(map(len, recorded))
    own = {
        "observation": np.concatenate([one.obs[:-1] for one in recorded]),
        "action": flat(recorded, "actions"),
        "episode": np.repeat(np.arange(len(recorded)), [len(one) for one in recorded]),
        "gt_episode_success": np.concatenate([np.full((len(one), 1), one.success) for one in recorded]),
        ("next", "observation"): np.concatenate([one.obs[1:] for one in recorded]),
        ("next", "reward"): flat(recorded, "rewards")[:, None],
        ("next", "terminated"): flat(recorded, "terminated")[:, None],
        ("next", "truncated"): flat(recorded, "truncated")[:, None],
        ("next", "done"): (flat(recorded, "terminated") | flat(recorded, "truncated"))[:, None],
        ("next", "zest_score"): np.concatenate([one.scores[1:, None] for one in recorded]),
        ("next", "gt_reward"): flat(recorded, "gt_rewards")[:, None],
    }
    assert data.batch_size == torch.Size([n])
    assert set(data.keys(include_nested=True, leaves_only=True)) == set(own)
    for key, values in own.items():
        np.testing.assert_array_equal(data[key].numpy(), values, err_msg=str(key))
        assert data[key].numpy().dtype == values.dtype


def test_its_offline_datasets_open_the_folder_as_one_of_theirs(exports: Path, recorded: list[Recorded]) -> None:
    replay = D4RLExperienceReplay("torchrl", batch_size=32, root=exports, download=False)
    assert len(replay) == sum(map(len, recorded))
    np.testing.assert_array_equal(replay[:]["action"].numpy(), flat(recorded, "actions"))


def test_slices_stay_within_one_episode(data: TensorDict) -> None:
    torch.manual_seed(0)
    sampler = SliceSampler(slice_len=10, traj_key="episode", strict_length=True)
    replay = TensorDictReplayBuffer(
        storage=TensorStorage(data), sampler=sampler, writer=ImmutableDatasetWriter(), batch_size=200
    )
    slices = replay.sample().reshape(20, 10)
    assert (slices["episode"] == slices["episode"][:, :1]).all()
    torch.testing.assert_close(slices["observation"][:, 1:], slices["next", "observation"][:, :-1], rtol=0, atol=0)


class Q(nn.Module):
    def __init__(self, obs_dim: int, act_dim: int) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(obs_dim + act_dim, 64), nn.ReLU(), nn.Linear(64, 1))

    def forward(self, obs: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return self.net(torch.cat([obs, action], -1))


def test_iql_trains(data: TensorDict) -> None:
    torch.manual_seed(0)
    obs_dim, act_dim = data["observation"].shape[-1], data["action"].shape[-1]
    net = nn.Sequential(nn.Linear(obs_dim, 64), nn.ReLU(), nn.Linear(64, 2 * act_dim), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictSequential(TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"])),
        in_keys=["loc", "scale"], distribution_class=TanhNormal,
    )  # fmt: skip
    qvalue = TensorDictModule(Q(obs_dim, act_dim), in_keys=["observation", "action"], out_keys=["state_action_value"])
    value = TensorDictModule(
        nn.Sequential(nn.Linear(obs_dim, 64), nn.ReLU(), nn.Linear(64, 1)), in_keys=["observation"],
        out_keys=["state_value"],
    )  # fmt: skip
    loss = IQLLoss(actor, qvalue, value)
    loss.make_value_estimator(gamma=0.99)
    targets = SoftUpdate(loss, eps=0.995)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    replay = TensorDictReplayBuffer(storage=TensorStorage(data), writer=ImmutableDatasetWriter(), batch_size=64)
    history = []
    for _ in range(300):
        losses = loss(replay.sample())
        total = losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_value"]
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        targets.step()
        history.append(losses["loss_actor"].item())
    assert np.isfinite(history).all()
    assert np.mean(history[-30:]) < np.mean(history[:30])


@pytest.mark.parametrize("way", ["folder", "to_torchrl"])
def test_discrete_actions_are_learnt_from_as_categories(way: str, discrete_id: str, tmp_path: Path) -> None:
    torch.manual_seed(0)
    data = (
        to_torchrl(discrete_id)
        if way == "to_torchrl"
        else TensorDict.load_memmap(export(discrete_id, "torchrl", tmp_path / "data").path)
    )
    assert (data["action"].dtype, data["action"].shape) == (torch.int64, data.batch_size)
    net = nn.Sequential(nn.Linear(data["observation"].shape[-1], 64), nn.ReLU(), nn.Linear(64, 4))
    loss = DiscreteCQLLoss(QValueActor(net, in_keys=["observation"], spec=Categorical(4)), action_space="categorical")
    loss.make_value_estimator(gamma=0.99)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    replay = TensorDictReplayBuffer(storage=TensorStorage(data), writer=ImmutableDatasetWriter(), batch_size=64)
    history = []
    for _ in range(200):
        losses = loss(replay.sample())
        optimizer.zero_grad()
        (losses["loss_qvalue"] + losses["loss_cql"]).backward()
        optimizer.step()
        history.append(losses["loss_cql"].item())
    assert np.mean(history[-20:]) < np.mean(history[:20])


def test_its_own_loader_of_minari_datasets_still_returns_zeros(
    folder: Path, dataset_id: str, recorded: list[Recorded], tmp_path: Path
) -> None:
    """When this fails, TorchRL has mended `MinariExperienceReplay`: say so in docs/interop.md."""
    replay = MinariExperienceReplay(
        dataset_id, batch_size=8, root=tmp_path, download=False, load_from_local_minari=True
    )
    assert len(replay) == sum(map(len, recorded))
    for key in ("observation", "action", ("next", "reward")):
        assert not replay[:][key].any()
    assert flat(recorded, "actions").any()
