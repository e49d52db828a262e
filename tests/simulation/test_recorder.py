"""Episodes of real environments, recorded as simulator states and read as scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import gymnasium
import gymnasium_robotics  # noqa: F401  # registers its environments
import minari
import numpy as np
import pytest

from zest_rl.errors import BadInput, Notice
from zest_rl.simulation.recorder import Recorder
from zest_rl.sources import open_source


@pytest.fixture(autouse=True)
def _places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "cache"))
    (tmp_path / "minari").mkdir()


def record(env_id: str, lengths: tuple[int, ...]) -> tuple[Recorder, list[list[np.ndarray]]]:
    """Random actions; the recorder, and qpos at each step of each episode."""
    env = Recorder(gymnasium.make(env_id))
    env.action_space.seed(0)
    bare: Any = env.unwrapped
    qpos = []
    for seed, length in enumerate(lengths):
        env.reset(seed=seed)
        qpos.append([bare.data.qpos.copy()])
        for _ in range(length):
            env.step(env.action_space.sample())
            qpos[-1].append(bare.data.qpos.copy())
    return env, qpos


def test_a_recorded_dataset_holds_states_success_and_spaces_as_minari_reads_them() -> None:
    env, qpos = record("FetchPush-v4", (2, 3))
    env.reset(seed=9)  # without a step it is no episode
    env.write("push/recorded-v0", ref_min_score=-50.0, ref_max_score=-10.0)
    dataset = minari.load_dataset("push/recorded-v0")
    assert minari.get_normalized_score(dataset, np.array([-30.0])) == 0.5
    assert dataset.spec.env_spec.id == "FetchPush-v4"
    assert dataset.observation_space == env.observation_space
    for episode, states in zip(dataset, qpos, strict=True):
        np.testing.assert_array_equal(episode.infos["state"]["qpos"], states)
        assert episode.infos["state"]["mocap_pos"].shape == (len(states), 3)
        assert episode.infos["success"].tolist() == [False] * len(states)
        assert episode.truncations.tolist() == [False] * (len(states) - 2) + [True]
        assert set(episode.observations) == {"observation", "achieved_goal", "desired_goal"}


def test_where_the_model_was_changed_at_reset_it_is_restored() -> None:
    env, _ = record("AdroitHandDoor-v1", (1, 1))
    env.write("door/recorded-v0")
    frames: Any = open_source("door/recorded-v0", look_at="door").frames
    assert frames.describe()["scenery_from"][0] == "infos/state/body_pos"
    doors = [frames.states.start(episode)["body_pos"] for episode in (0, 1)]
    assert (doors[0] != doors[1]).any()
    model = frames._stage.simulation.model
    stands = [frames._stage.lookat(frames.states.start(episode), frames.body) for episode in (0, 1)]
    np.testing.assert_array_equal(model.body_pos.ravel(), doors[1], "of the state that was put last")
    np.testing.assert_allclose(np.subtract(*stands), (doors[0] - doors[1]).reshape(-1, 3)[model.body("frame").id])


def test_a_recorded_dataset_is_seen_as_a_scene() -> None:
    env, _ = record("FetchPush-v4", (2,))
    env.write("push/recorded-v0")
    frames = open_source("push/recorded-v0", n_views=1).frames
    assert frames.describe()["look_at"] == "object0"
    assert len(list(frames.read(0))) == 3


def test_what_cannot_be_recorded_is_refused() -> None:
    with pytest.raises(BadInput, match="needs an environment with a MuJoCo model"):
        Recorder(gymnasium.make("CartPole-v1"))
    with pytest.raises(BadInput, match="at least 1 episode with a step, got none"):
        Recorder(gymnasium.make("FetchPush-v4")).write("push/none-v0")


class Nested(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Tells success in a dictionary of its own, as an array."""

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, _ = self.env.step(action)
        return observation, reward, terminated, truncated, {"task": {"solved": np.array([False, True])}}


def test_success_is_recorded_by_the_key_that_is_named_and_an_environment_that_no_file_can_name_is_told() -> None:
    env = Recorder(Nested(gymnasium.make("FetchPush-v4")), success_key="task/solved")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    with pytest.warns(Notice, match="push/nested-v0 cannot name its environment"):  # of the wrapper
        env.write("push/nested-v0")
    assert minari.load_dataset("push/nested-v0")[0].infos["success"].tolist() == [False, True]
    env = Recorder(gymnasium.make("FetchPush-v4"), success_key="task/solved")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    with pytest.raises(BadInput, match="by the key 'task/solved', but no info of 1 episodes has it"):
        env.write("push/none-v0")


@pytest.mark.parametrize("references", [{"ref_min_score": 0.0}, {"ref_min_score": 0.0, "ref_max_score": -50.0}])
def test_reference_scores_that_are_no_scale_are_refused(references: dict[str, float]) -> None:
    env, _ = record("FetchPush-v4", (1,))
    with pytest.raises(BadInput, match="two finite numbers, that of 0 % below that of 100 %, or none"):
        env.write("push/none-v0", **references)
