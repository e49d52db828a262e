"""Evaluation in any environment: what a policy sees, what is scored, how episodes end, and what is refused."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zest_rl.runtime.load_order  # isort: skip
import gymnasium
import h5py
import numpy as np
import pytest
from gymnasium import spaces
from read_dataset import read
from recorded_robots import SMALL, Replay, record, write_module

import zest_rl
from zest_rl.agents import load_policy
from zest_rl.data.observations import flatten, numbers, numeric_paths, observed
from zest_rl.data.reader import Dataset
from zest_rl.errors import BadInput, Notice, ZestError
from zest_rl.evaluation.environments import find_environment
from zest_rl.evaluation.evaluate import EvaluationConfig, evaluate, evaluation_folder, read_evaluation
from zest_rl.evaluation.rollout import run_episodes
from zest_rl.rewards.scorer import SCORER_FILE
from zest_rl.rewards.state_scorer import StateScorer
from zest_rl.runtime import artifacts
from zest_rl.simulation.makers import check_named, named_by_user

SHORT = EvaluationConfig(n_episodes=2, seed=0, horizon=3)


@pytest.fixture(scope="module")
def _root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs on recordings of three environments, and the actions of these."""
    root = tmp_path_factory.mktemp("robots")
    (root / "minari").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root / "minari"))
        patch.setenv("ZEST_CACHE", str(root / "cache"))
        patch.chdir(root)
        actions = {
            "door": record("AdroitHandDoor-v1", "door/mine-v0"),
            "hopper": record("Hopper-v5", "hopper/mine-v0", n_steps=60),
            "push": record("FetchPush-v4", "push/mine-v0"),
        }
        np.savez(root / "actions.npz", **{f"{n}-{i}": a for n, of in actions.items() for i, a in enumerate(of)})
        scored = zest_rl.relabel("door/mine-v0", "episode:0", look_at="door", views=2, n_workers=1)
        zest_rl.train("rvs", scored, run_dir="door", **SMALL)
        for name in ("hopper", "push"):
            zest_rl.train("rvs", f"{name}/mine-v0", run_dir=name, **SMALL)
    return root


@pytest.fixture
def robots(_root: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(_root / "minari"))
    monkeypatch.setenv("ZEST_CACHE", str(_root / "cache"))
    monkeypatch.chdir(_root)
    return _root


def actions_of(root: Path, name: str) -> list[np.ndarray]:
    with np.load(root / "actions.npz") as arrays:
        return [arrays[key] for key in sorted(arrays.files) if key.startswith(name)]


def replay(root: Path, name: str) -> Replay:
    return Replay(load_policy(str(root / name)).meta, actions_of(root, name))


def edited(root: Path, name: str, tmp_path: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """A copy of a run with another ``meta.json``."""
    (tmp_path / name).mkdir()
    for file in (root / name).iterdir():
        if file.is_file():
            (tmp_path / name / file.name).write_bytes(file.read_bytes())
    meta = artifacts.read_json(tmp_path / name / "meta.json")
    change(meta)
    artifacts.write_json(tmp_path / name / "meta.json", meta)
    return tmp_path / name


# --- what is seen, told and scored ------------------------------------------------------------------------------------


def test_a_rollout_is_scored_online_as_relabel_scored_the_same_episode(robots: Path) -> None:
    policy = replay(robots, "door")
    scorer = StateScorer.load(robots / "door" / SCORER_FILE, n_workers=1)
    environment = find_environment(policy.meta, horizon=10)
    traces = run_episodes(policy, range(3), environment=environment, scorer=scorer)
    stored = read(policy.meta["dataset"]["id"], Dataset.scores)
    np.testing.assert_allclose(traces["score"], stored, atol=1e-4)
    assert np.ptp(stored) > 0.1, "nothing moves: this test could not fail"
    np.testing.assert_array_equal(np.stack(policy.told, axis=1), traces["score"][:, 1:])
    np.testing.assert_array_equal(traces["gt_reward"][:, 1:], read("door/mine-v0", Dataset.rewards))
    assert {"qpos", "door_body_pos"} <= set(environment.state), "a door stands where its episode put it"


def test_a_policy_sees_what_it_saw_in_training(robots: Path) -> None:
    policy = replay(robots, "push")
    traces = run_episodes(policy, range(3), environment=find_environment(policy.meta, horizon=10))
    recorded = read("push/mine-v0", Dataset.episodes)
    np.testing.assert_array_equal(np.stack(policy.seen, axis=1), [episode.obs[:-1] for episode in recorded])
    assert "score" not in traces
    np.testing.assert_array_equal(np.stack(policy.told, axis=1), traces["gt_reward"][:, 1:]), "its own rewards"


def test_nested_observations_are_flattened_as_those_of_a_file() -> None:
    space = spaces.Dict(
        {
            "b": spaces.Dict({"x": spaces.Box(-1, 1, (2, 2), np.float64), "b-y": spaces.Discrete(4)}),
            "a-z": spaces.Box(0, 9, (3,), np.int64),
            "a": spaces.Tuple([spaces.MultiBinary(2), spaces.Box(-1, 1, (1,))]),
            "camera": spaces.Box(0, 255, (16, 16, 3), np.uint8),
            "said": spaces.Text(5),
        }
    )
    space.seed(0)
    rows = [space.sample() for _ in range(3)]
    arrays = observed(rows)
    paths = numeric_paths(rows)
    assert paths == ("a/_index_0", "a/_index_1", "a-z", "b/b-y", "b/x")
    with h5py.File("any", "w", driver="core", backing_store=False) as file:
        for path, array in arrays.items():
            if array.dtype.kind != "U":
                file[f"observations/{path}"] = array
        np.testing.assert_array_equal(flatten({path: arrays[path] for path in paths}), numbers(file["observations"]))


def test_episodes_that_end_early_are_cut_where_they_ended(robots: Path) -> None:
    environment = find_environment(replay(robots, "hopper").meta, horizon=60)
    together = run_episodes(replay(robots, "hopper"), range(3), environment=environment)
    lengths = [len(actions) for actions in actions_of(robots, "hopper")]
    assert together["n_steps"].tolist() == lengths
    assert len(set(lengths)) > 1
    assert max(lengths) < 60
    for i, length in enumerate(lengths):
        assert not together["gt_reward"][i, length + 1 :].any()
        np.testing.assert_array_equal(
            together["qpos"][i, length:], together["qpos"][i, length : length + 1].repeat(61 - length, 0)
        )
        recorded = read("hopper/mine-v0", Dataset.rewards)[i]
        np.testing.assert_array_equal(together["gt_reward"][i, 1 : length + 1], recorded)
    assert "gt_success" not in together, "nothing tells it"


def test_results_tell_lengths_returns_and_success_and_can_be_read_again(robots: Path) -> None:
    hopper = evaluate(robots / "hopper", EvaluationConfig(n_episodes=2, horizon=200), n_workers=1)
    assert [episode.success for episode in hopper.episodes] == [None, None]
    assert hopper.summary().keys() == {"return", "iqm", "n_episodes", "target_return", "mean_length"}
    assert hopper.summary()["mean_length"] == np.mean([episode.n_steps for episode in hopper.episodes]) < 200
    np.testing.assert_array_equal(hopper.returns(), [episode.gt_return for episode in hopper.episodes])
    assert not hopper.is_normalized
    push = evaluate(robots / "push", SHORT, n_workers=1)
    assert push.summary()["success"]["value"] in (0, 0.5, 1)
    for evaluation in (hopper, push):
        again = read_evaluation(evaluation.folder)
        assert (again.episodes, again.config, again.environment) == (
            evaluation.episodes, evaluation.config, evaluation.environment,
        )  # fmt: skip
        assert again.summary() == evaluation.summary()


def test_returns_are_normalized_where_the_dataset_has_both_references(robots: Path, tmp_path: Path) -> None:
    run = edited(robots, "push", tmp_path, lambda meta: meta["dataset"].update(ref_min_score=-3.0, ref_max_score=0.0))
    result = evaluate(run, EvaluationConfig(n_episodes=2), n_workers=1)
    np.testing.assert_allclose(result.returns(), [100 * (e.gt_return + 3) / 3 for e in result.episodes])
    assert "normalized_return" in result.summary()
    with pytest.warns(Notice, match=r"returns over 3 steps are not normalized: .* push/mine-v0 are of 10 steps"):
        assert not evaluate(run, SHORT, n_workers=1).is_normalized
    one = edited(robots, "hopper", tmp_path, lambda meta: meta["dataset"].update(ref_min_score=-3.0))
    assert not evaluate(one, SHORT, n_workers=1).is_normalized


def test_parallel_parts_and_the_same_seeds_give_the_same_bits(robots: Path, tmp_path: Path) -> None:
    twin = edited(robots, "hopper", tmp_path, lambda meta: None)
    config = EvaluationConfig(n_episodes=6, horizon=30)
    one, two = evaluate(robots / "hopper", config, n_workers=1), evaluate(twin, config, n_workers=2)
    assert one.episodes == two.episodes
    for name, array in one.traces.items():
        np.testing.assert_array_equal(array, two.traces[name], err_msg=name)


def test_the_folder_of_an_evaluation_in_the_kitchen_is_that_of_earlier_versions() -> None:
    config = EvaluationConfig()
    before = {"n_episodes": 50, "seed": 1_000_000, "rtg": "online", "target_quantile": 1.0}
    assert evaluation_folder(Path("run"), config).name == artifacts.hash_json(before)[:8]


# --- which environment ------------------------------------------------------------------------------------------------


def test_wrappers_that_were_recorded_are_made_again(robots: Path) -> None:
    env = gymnasium.wrappers.TimeAwareObservation(gymnasium.make("InvertedPendulum-v5", max_episode_steps=70))
    meta = {"dataset": {"id": "a/b-v0", "env_spec": env.spec.to_json()}, "obs_dim": 5, "act_dim": 1}
    made = find_environment(meta, horizon=5)
    assert made.make().observation_space.shape == (5,), "4 without the wrapper"
    assert made.horizon == 5
    assert find_environment(meta).horizon == 70, "as recorded"
    assert find_environment({**meta, "max_steps": 9}).horizon == 9, "the longest episode of the data"


def test_success_is_what_the_user_names(robots: Path) -> None:
    meta = load_policy(robots / "push").meta
    assert find_environment(meta).success_key == "is_success"
    write_module(
        robots,
        "tells_more",
        "class Tells(gymnasium.Wrapper):",
        "    def step(self, action):",
        "        *rest, info = self.env.step(action)",
        "        return *rest, {**info, 'task': {'solved': 1.0}}",
        "def make(): return Tells(gymnasium.make('FetchPush-v4'))",
    )
    config = EvaluationConfig(2, 0, env="tells_more:make", horizon=3, success_key="task/solved")
    assert [episode.success for episode in evaluate(robots / "push", config, n_workers=1).episodes] == [True, True]
    with pytest.raises(
        BadInput, match=r"--success-key: in an episode of tells_more:make .*'solved'; .*is_success, task/s"
    ):
        find_environment(meta, env="tells_more:make", success_key="solved")


def test_success_may_be_an_array_that_is_told_at_the_end_alone(robots: Path) -> None:
    write_module(
        robots,
        "tells_late",
        "import numpy as np",
        "class Late(gymnasium.Wrapper):",
        "    def step(self, action):",
        "        *rest, truncated, info = self.env.step(action)",
        "        info.pop('is_success')",
        "        return *rest, truncated, {**info, 'success': np.array([False, True])} if truncated else info",
        "def make(): return Late(gymnasium.make('FetchPush-v4', max_episode_steps=4))",
    )
    config = EvaluationConfig(2, 0, env="tells_late:make")
    result = evaluate(robots / "push", config, n_workers=1)
    assert [(episode.success, episode.n_steps) for episode in result.episodes] == [(True, 4), (True, 4)]
    with pytest.warns(Notice, match=r"info of tells_late:make tells no success \(it has .*\); name it with --success"):
        assert find_environment(load_policy(robots / "push").meta, env="tells_late:make", horizon=2).success_key is None


def test_a_function_whose_code_was_changed_is_evaluated_again(robots: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_module(
        robots,
        "my_push",
        "from my_reward import REWARD",
        "def make():",
        "    return gymnasium.wrappers.TransformReward(gymnasium.make('FetchPush-v4'), lambda reward: REWARD)",
    )
    config, returns = EvaluationConfig(2, 0, env="my_push:make", horizon=3), []
    for reward in (1.0, 2.0):
        (robots / "my_reward.py").write_text(f"REWARD = {reward}")
        for module in ("my_push", "my_reward"):
            monkeypatch.delitem(sys.modules, module, raising=False)
        importlib.invalidate_caches()
        result = evaluate(robots / "push", config, n_workers=1, videos=True)
        returns.append(result.episodes[0].gt_return)
        best = (result.folder / "best.mp4").stat().st_mtime_ns
    assert returns == [3.0, 6.0]
    assert evaluate(robots / "push", config, n_workers=1, videos=True).episodes[0].gt_return == 6
    assert (result.folder / "best.mp4").stat().st_mtime_ns == best, "nothing was run again"


@pytest.mark.parametrize("module", ["envs", "package.envs", "package.inner"])
def test_a_function_of_the_same_name_in_another_folder_was_not_named(
    module: str, robots: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    for place in ("mine", "theirs"):
        (tmp_path / place / "package" / "inner").mkdir(parents=True)
        for name in ("envs", "package/envs", "package/inner/__init__"):
            write_module(tmp_path / place, name, "raise SystemExit('this was run')")
    monkeypatch.chdir(tmp_path / "mine")
    assert named_by_user(f"{module}:make") == f"{module}:make"
    check_named(f"{module}:make", "a dataset")
    sys.path.remove(str(tmp_path / "mine"))
    monkeypatch.chdir(tmp_path / "theirs")
    importlib.invalidate_caches()
    with pytest.raises(BadInput, match=rf"names {module}:make \(.*theirs.*\.py\) .* did not name on this machine"):
        check_named(f"{module}:make", "a dataset")
    sys.path.remove(str(tmp_path / "theirs"))
    monkeypatch.chdir(tmp_path)
    importlib.invalidate_caches()
    with pytest.raises(BadInput, match=r"no such module in .*: go to the folder that holds it"):
        check_named(f"{module}:make", "a dataset")


def test_an_environment_that_no_file_can_name_is_made_by_the_function_that_was_named(
    robots: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_module(robots, "my_door", "def make(): return gymnasium.make('AdroitHandDoor-v1')")

    class NoSpec(gymnasium.Wrapper[Any, Any, Any, Any]):
        spec = None

    record(NoSpec(gymnasium.make("AdroitHandDoor-v1")), "door/unnamed-v0")
    scored = zest_rl.relabel("door/unnamed-v0", "episode:0", env="my_door:make", look_at="door", views=1, n_workers=1)
    run = zest_rl.train("rvs", scored, run_dir=tmp_path / "run", **SMALL)
    own = zest_rl.train("bc", "door/unnamed-v0", run_dir=tmp_path / "own", **SMALL)
    with pytest.raises(BadInput, match=r"unnamed-v0 names no environment.*give --env package\.module:make"):
        evaluate(own, SHORT)
    assert (
        evaluate(own, EvaluationConfig(2, 0, env="my_door:make", horizon=3), n_workers=1).summary()["n_episodes"] == 2
    )
    result = evaluate(run, SHORT, n_workers=1, videos=True)
    assert result.episodes[0].zest_return is not None, "who named it to relabel need not name it again"
    assert (result.folder / "best.mp4").exists()
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "of somebody else"))
    with pytest.raises(BadInput, match=r"names my_door:make \(.*my_door\.py\) .* did not name .* give --env my_door:m"):
        evaluate(run, SHORT)


@pytest.mark.parametrize(
    ("lines", "env", "message"),
    [
        ([], "no_module:make", r"--env no_module:make: there is no module 'no_module' in .* or among the installed"),
        (["def make(): pass"], "mine:mak", r"mine:mak: mine .*mine\.py\) has no function 'mak'; did you mean 'make'\?"),
        (["def make(size): pass"], "mine:make", r"make\(size\) must be called without arguments .*'size'"),
        (["def make(): return 3"], "mine:make", r"--env mine:make must return a gymnasium\.Env, got int"),
        (["def make(): return len(3)"], "mine:make", r"here \(TypeError: object of type 'int'.*mend the function"),
        (["import not_there"], "mine:make", r"mine:make cannot be made here \(ModuleNotFoundError.*'not_there'"),
        ([], "FetchPush-v4", r"--env must be package\.module:make, .* got 'FetchPush-v4'"),
        (["def make(): return gymnasium.make('CartPole-v1')"], "mine:make", r"continuous actions \(Box\), but mine"),
        (
            ["def make(): return gymnasium.make('FetchReach-v4')"], "mine:make",
            r"observations of mine:make are not those of the training: the policy has 31 numbers, the environment 16",
        ),
        (
            ["def make(): return gymnasium.make('AdroitHandDoor-v1')"], "mine:make",
            r"observations of mine:make are not those of the training: the policy has 31 numbers, the environment 39",
        ),
    ],
)  # fmt: skip
def test_a_function_that_makes_no_environment_of_the_run_is_refused(
    lines: list[str], env: str, message: str, robots: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    monkeypatch.syspath_prepend(str(tmp_path))
    write_module(tmp_path, "mine", *lines)
    with pytest.raises(ZestError, match=message):
        find_environment(load_policy(robots / "push").meta, env=env)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"entry_point": "os:system"}, r"would run code of 'os:system'.*give --env package\.module:make"),
        ({"id": "FetchPush-v99"}, r"FetchPush-v99 is not registered .* which have .*FetchPush-v4; install"),
        (
            {"kwargs": {"colour": "red"}},
            r"FetchPush-v4 cannot be made here \(.*TypeError.*'colour'.*version that it was",
        ),
        (
            {
                "additional_wrappers": [
                    {
                        "name": "RecordVideo",
                        "entry_point": "gymnasium.wrappers.rendering:RecordVideo",
                        "kwargs": {"video_folder": "x"},
                    }
                ]
            },
            r"recorded with the wrapper RecordVideo .* not made because a file says so; give --env",
        ),
        ({"kwargs": {"model_path": "/dev/zero"}}, "/dev/zero"),
    ],
)
def test_data_make_no_environment_but_a_registered_one_of_trusted_packages(
    change: dict[str, Any], message: str, robots: Path
) -> None:
    meta = load_policy(robots / "push").meta
    spec = json.loads(meta["dataset"]["env_spec"]) | change
    with pytest.raises(ZestError, match=message):
        find_environment({**meta, "dataset": {**meta["dataset"], "env_spec": json.dumps(spec)}})


def test_a_horizon_out_of_range_is_refused(robots: Path) -> None:
    with pytest.raises(BadInput, match="horizon must be 1 to 10000 steps, got 0; leave it out for that of the dataset"):
        EvaluationConfig(horizon=0)
    meta = load_policy(robots / "push").meta
    with pytest.raises(BadInput, match="horizon must be 1 to 10000 steps, got 0; leave it out"):
        find_environment(meta, horizon=0)


def test_frames_that_are_no_states_cannot_be_scored_online(robots: Path, tmp_path: Path) -> None:
    run = edited(robots, "door", tmp_path, lambda meta: None)
    (run / SCORER_FILE).unlink()
    with pytest.raises(BadInput, match=r"its frames are from elsewhere.*use --rtg schedule or const"):
        evaluate(run, SHORT)
    assert evaluate(run, EvaluationConfig(2, 0, "schedule", horizon=3), n_workers=1).episodes[0].zest_return is None


def test_an_environment_that_cannot_be_drawn_is_evaluated_without_videos(robots: Path, tmp_path: Path) -> None:
    write_module(
        robots,
        "no_model",
        "import numpy as np",
        "class Blind(gymnasium.Env):",
        "    observation_space = gymnasium.spaces.Box(-1, 1, (31,), np.float32)",
        "    action_space = gymnasium.spaces.Box(-1, 1, (4,), np.float32)",
        "    def reset(self, seed=None, options=None):",
        "        super().reset(seed=seed)",
        "        return np.zeros(31, np.float32), {}",
        "    def step(self, action):",
        "        return np.zeros(31, np.float32), float(action.sum()), False, False, {}",
    )
    config = EvaluationConfig(2, 0, env="no_model:Blind", horizon=3)
    with pytest.warns(Notice, match="no videos of no_model:Blind are drawn: it has no MuJoCo model"):
        result = evaluate(robots / "push", config, n_workers=1, videos=True)
    assert result.traces.keys() == {"gt_reward", "n_steps"}
    with pytest.raises(BadInput, match=r"the scorer looks at states of AdroitHandDoor-v1 \(body_pos.*has none of them"):
        run_episodes(
            replay(robots, "push"), range(3), environment=result.environment,
            scorer=StateScorer.load(robots / "door" / SCORER_FILE, n_workers=1),
        )  # fmt: skip
