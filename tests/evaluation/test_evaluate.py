"""Rollouts: who meets which starts, by what the return-to-go falls, and that a cut evaluation loses nothing."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from read_dataset import read
from tiny_dataset import COLLECTED, SHORT_HORIZON

from zest_rl.agents import load_policy
from zest_rl.data.reader import Dataset
from zest_rl.errors import BadInput, ZestError
from zest_rl.evaluation import evaluate as evaluation
from zest_rl.evaluation.evaluate import (
    EPISODES_PER_JOB,
    EvaluationConfig,
    evaluate,
    evaluation_folder,
    read_evaluation,
    target_return,
)
from zest_rl.evaluation.rollout import Traces, run_episodes
from zest_rl.kitchen.env import ENV_ID, HORIZON, KitchenEnv, env_spec
from zest_rl.rewards.scorer import SCORER_FILE
from zest_rl.rewards.state_scorer import StateScorer
from zest_rl.runtime import artifacts
from zest_rl.runtime.arrays import read_arrays, write_arrays

ONLINE = EvaluationConfig(n_episodes=2, seed=11)
CONSTANT = replace(ONLINE, rtg="constant")


def load_scorer(run: Path) -> StateScorer:
    return StateScorer.load(run / SCORER_FILE, n_workers=1)


class Replay:
    """A policy that decides, and is told what follows, while the actions of a recorded episode are taken."""

    def __init__(self, run: Path, actions: np.ndarray) -> None:
        self.policy = load_policy(run)
        self.agent, self.uses_return = self.policy.agent, self.policy.uses_return
        dataset = self.policy.meta["dataset"] | {"env_spec": env_spec("micro").to_json()}  # of the full length
        self.meta = self.policy.meta | {"dataset": dataset}
        self.actions = actions
        self.decided: list[np.ndarray] = []
        self.told: list[np.ndarray] = []

    def begin(self, n_episodes: int, target_return: float | None = None) -> None:
        self.policy.begin(n_episodes, target_return)

    def act(self, obs: np.ndarray) -> np.ndarray:
        self.decided.append(self.policy.act(obs))
        return self.actions[None, len(self.decided) - 1]

    def observe(self, rewards: np.ndarray) -> None:
        self.told.append(rewards.copy())
        self.policy.observe(rewards)

    def end(self) -> dict[str, np.ndarray]:
        return self.policy.end()


@pytest.fixture
def replay(trained: Path) -> Callable[..., tuple[Replay, Traces]]:
    """Roll out the policy of a run along the first recorded episode, in which the microwave opens."""
    seed = int(np.random.SeedSequence([0, 0]).generate_state(2)[0])  # as `zest_rl.kitchen.behaviour.rollout` draws it
    actions = read(COLLECTED, Dataset.episodes)[0].actions

    def play(name: str, config: EvaluationConfig = ONLINE, scorer: StateScorer | None = None) -> tuple[Replay, Traces]:
        policy = Replay(trained / name, actions)
        target = target_return(policy, config)
        seeds = range(seed, seed + 1)
        return policy, run_episodes(policy, seeds, rtg=config.rtg, target_return=target, scorer=scorer)

    return play


def assert_equal(one: Traces, other: Traces) -> None:
    assert one.keys() == other.keys()
    for name, array in one.items():
        np.testing.assert_array_equal(array, other[name], err_msg=name)


def edit_meta(run: Path, change: Callable[[dict[str, Any]], None]) -> None:
    meta = json.loads((run / "meta.json").read_text())
    change(meta)
    (run / "meta.json").write_text(json.dumps(meta))


# --- the same numbers again -------------------------------------------------------------------------------------------


def test_the_same_seeds_give_the_same_bits_with_one_worker_and_with_two(trained: Path, tmp_path: Path) -> None:
    config = EvaluationConfig(n_episodes=EPISODES_PER_JOB + 1, seed=5)
    twin = shutil.copytree(trained / "bc-0", tmp_path / "twin")
    progress: list[int] = []
    alone = evaluate(trained / "bc-0", config, score=True, n_workers=1, on_progress=progress.append)
    assert progress == [EPISODES_PER_JOB, 1]
    together = evaluate(twin, config, score=True, n_workers=2)
    assert_equal(alone.traces, together.traces)
    assert alone.episodes == together.episodes
    assert [episode.seed for episode in alone.episodes] == list(range(5, 5 + config.n_episodes))


def test_all_policies_meet_the_same_starts_and_another_seed_meets_others(trained: Path) -> None:
    bc, dt = (evaluate(trained / name, ONLINE, n_workers=1).traces["qpos"] for name in ("bc-0", "dt-0"))
    np.testing.assert_array_equal(bc[:, 0], dt[:, 0])
    assert not np.array_equal(bc, dt)
    assert not np.array_equal(bc[0, 0], bc[1, 0])
    elsewhere = evaluate(trained / "bc-0", replace(ONLINE, seed=12), n_workers=1).traces["qpos"]
    np.testing.assert_array_equal(elsewhere[0, 0], bc[1, 0])
    assert not np.array_equal(elsewhere[1, 0], bc[0, 0])


def test_an_evaluation_killed_midway_goes_on_and_ends_with_the_same_bits(trained: Path, tmp_path: Path) -> None:
    config = EvaluationConfig(n_episodes=4 * EPISODES_PER_JOB)
    run = shutil.copytree(trained / "bc-0", tmp_path / "cut")
    parts = evaluation_folder(run, config) / "parts"
    code = "import sys; from zest_rl.cli import main; sys.exit(main(sys.argv[1:]))"
    words = ["evaluate", str(run), "--n-episodes", str(config.n_episodes), "--n-workers", "1"]
    with subprocess.Popen([sys.executable, "-c", code, *words], stderr=subprocess.DEVNULL) as process:
        while not (parts.is_dir() and list(parts.glob("seeds-*.npz"))):
            assert process.poll() is None, "it ended before it could be killed"
            time.sleep(0.01)
        process.kill()
    finished = {path.name: path.stat().st_mtime_ns for path in parts.glob("seeds-*.npz")}
    assert 0 < len(finished) < 4
    assert not (parts.parent / "result.json").exists()
    resumed = evaluate(run, config, n_workers=1)
    whole = evaluate(trained / "bc-0", config, n_workers=1)
    assert all((parts / name).stat().st_mtime_ns == written for name, written in finished.items())
    assert_equal(resumed.traces, whole.traces)
    assert resumed.summary() == whole.summary()


# --- the return-to-go -------------------------------------------------------------------------------------------------


def test_the_return_to_go_falls_by_the_score_of_each_new_state(
    trained: Path, replay: Callable[..., tuple[Replay, Traces]]
) -> None:
    policy, traces = replay("dt-0", scorer=load_scorer(trained / "dt-0"))
    np.testing.assert_array_equal(np.stack(policy.told, axis=1), traces["score"][:, 1:])
    scored = load_scorer(trained / "dt-0").score_episode(traces["qpos"][0])
    np.testing.assert_allclose(traces["score"][0], scored, atol=1e-5)
    source = policy.meta["dataset"]["id"]
    np.testing.assert_allclose(traces["score"][0], read(source, Dataset.scores)[0], atol=1e-5)
    np.testing.assert_array_equal(traces["gt_reward"][0, 1:], read(source, Dataset.truth)[0].rewards)
    assert np.ptp(traces["score"]) > 0.1, "the microwave stays shut: this test could not fail"


def test_rewards_that_are_differences_of_scores_make_it_fall_by_differences(
    trained: Path, replay: Callable[..., tuple[Replay, Traces]]
) -> None:
    edit_meta(trained / "dt-0", lambda meta: meta["dataset"]["zest"]["relabel"].update(reward="difference"))
    policy, traces = replay("dt-0", scorer=load_scorer(trained / "dt-0"))
    np.testing.assert_array_equal(np.stack(policy.told, axis=1), np.diff(traces["score"], axis=1))


def test_a_constant_return_to_go_never_falls(replay: Callable[..., tuple[Replay, Traces]]) -> None:
    policy, traces = replay("dt-0", CONSTANT)
    assert "score" not in traces
    assert len(policy.told) == HORIZON
    assert not np.any(policy.told)


def test_a_scheduled_return_to_go_is_that_of_the_best_training_episode(
    replay: Callable[..., tuple[Replay, Traces]],
) -> None:
    policy, _ = replay("dt-0", replace(ONLINE, rtg="schedule"))
    schedule = np.array(policy.meta["rtg_schedule"], dtype=np.float32)
    assert len(policy.told) == len(schedule) - 1
    np.testing.assert_allclose(schedule[0] - np.cumsum(policy.told), schedule[1:], atol=1e-4)


def test_a_policy_of_the_ground_truth_is_told_the_ground_truth(replay: Callable[..., tuple[Replay, Traces]]) -> None:
    policy, traces = replay("gt-0")
    np.testing.assert_array_equal(np.stack(policy.told, axis=1), traces["gt_reward"][:, 1:])
    assert traces["gt_reward"].max() > 0.5


def test_the_ground_truth_never_reaches_a_policy_of_the_scores(
    trained: Path, replay: Callable[..., tuple[Replay, Traces]], monkeypatch: pytest.MonkeyPatch
) -> None:
    scorer = load_scorer(trained / "dt-0")

    def decisions(name: str, scorer: StateScorer | None = None) -> np.ndarray:
        return np.stack(replay(name, scorer=scorer)[0].decided)

    of_scores, of_truth = decisions("dt-0", scorer), decisions("gt-0")
    rng = np.random.default_rng(0)
    true_info = KitchenEnv._info

    def false_info(env: KitchenEnv) -> dict[str, Any]:
        return true_info(env) | {"gt": {"reward": np.float32(rng.uniform(-9, 9)), "success": rng.random() < 0.5}}

    monkeypatch.setattr(KitchenEnv, "_info", false_info)
    np.testing.assert_array_equal(decisions("dt-0", scorer), of_scores)
    assert not np.array_equal(decisions("gt-0"), of_truth), "false rewards changed nothing: this test could not fail"


def test_the_target_is_a_quantile_of_the_training_returns(trained: Path) -> None:
    policy = load_policy(trained / "dt-0")
    quantiles = policy.meta["return_quantiles"]
    assert target_return(policy, ONLINE) == quantiles[-1] == max(quantiles)
    assert target_return(policy, replace(ONLINE, target_quantile=0.5)) == pytest.approx(quantiles[50])
    between = target_return(policy, replace(ONLINE, target_quantile=0.255))
    assert between == pytest.approx((quantiles[25] + quantiles[26]) / 2)
    assert target_return(load_policy(trained / "bc-0"), ONLINE) is None


# --- what is left -----------------------------------------------------------------------------------------------------


def test_results_are_sums_over_the_traces_and_can_be_read_again(trained: Path) -> None:
    result = evaluate(trained / "bc-0", ONLINE, score=True, n_workers=1)
    for i, episode in enumerate(result.episodes):
        assert episode.n_steps == SHORT_HORIZON
        assert episode.gt_return == pytest.approx(float(result.traces["gt_reward"][i, 1:].sum()))
        assert episode.zest_return == pytest.approx(float(result.traces["score"][i, 1:].sum()), abs=1e-4)
        assert episode.success == bool(result.traces["gt_success"][i].any())
    np.testing.assert_allclose(result.returns(), [100 * e.gt_return / 70 for e in result.episodes])
    summary = result.summary()
    assert summary["normalized_return"]["value"] == pytest.approx(result.returns().mean())
    assert summary["n_episodes"] == 2
    assert summary["target_return"] is None
    again = read_evaluation(evaluation_folder(trained / "bc-0", ONLINE))
    assert (again.episodes, again.config, again.summary()) == (result.episodes, ONLINE, summary)
    assert_equal(again.traces, result.traces)


def test_a_finished_evaluation_is_not_run_again_and_other_settings_have_a_folder_of_their_own(
    trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = evaluate(trained / "bc-0", CONSTANT, n_workers=1)
    monkeypatch.setattr(evaluation, "run_episodes", lambda *arguments, **options: pytest.fail("it rolls out"))
    again = evaluate(trained / "bc-0", CONSTANT, n_workers=1)
    assert_equal(again.traces, first.traces)
    folders = {evaluation_folder(trained, replace(CONSTANT, **change)) for change in (
        {}, {"n_episodes": 3}, {"seed": 1}, {"rtg": "schedule"}, {"target_quantile": 0.5},
    )}  # fmt: skip
    assert len(folders) == 5


def test_a_damaged_part_is_run_again_and_reading_it_says_so(trained: Path) -> None:
    first = evaluate(trained / "bc-0", CONSTANT, n_workers=1)
    folder = evaluation_folder(trained / "bc-0", CONSTANT)
    (part,) = (folder / "parts").glob("*.npz")
    part.write_bytes(part.read_bytes()[:-100])
    with pytest.raises(ZestError, match=r"missing or damaged \(seeds-.*\); run the command again"):
        read_evaluation(folder)
    assert_equal(evaluate(trained / "bc-0", CONSTANT, n_workers=1).traces, first.traces)


def change_part(folder: Path, change: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    (part,) = (folder / "parts").glob("*.npz")
    arrays = read_arrays(part)
    assert arrays is not None
    write_arrays(part, change(arrays))


@pytest.mark.parametrize(
    "change",
    [
        lambda a: {name: array for name, array in a.items() if name != "gt_success"},
        lambda a: a | {"surprise": a["gt_reward"]},
        lambda a: a | {"gt_reward": a["gt_reward"][:, :, None]},
        lambda a: a | {"gt_reward": a["gt_reward"][:, :1]},
        lambda a: a | {"gt_reward": np.full_like(a["gt_reward"], np.nan)},
        lambda a: a | {"gt_reward": a["gt_reward"].astype("U9")},
        lambda a: a | {"gt_success": a["gt_success"][:1]},
        lambda a: a | {"qpos": a["qpos"][..., :3]},
    ],
)
def test_parts_of_somebody_else_that_hold_other_arrays_are_refused(
    change: Callable[[dict[str, Any]], dict[str, Any]], trained: Path
) -> None:
    folder = evaluate(trained / "bc-0", CONSTANT, n_workers=1).folder
    change_part(folder, change)
    for read_again in (lambda: read_evaluation(folder), lambda: evaluate(trained / "bc-0", CONSTANT, n_workers=1)):
        with pytest.raises(BadInput, match=r"parts is not as this package writes it.*evaluate again"):
            read_again()


def test_a_result_that_contradicts_its_parts_is_refused(trained: Path) -> None:
    folder = evaluate(trained / "bc-0", CONSTANT, n_workers=1).folder
    change_part(folder, lambda arrays: arrays | {"gt_reward": arrays["gt_reward"] + np.float32(0.1)})
    with pytest.raises(BadInput, match="its episodes are not those of its parts"):
        read_evaluation(folder)


# --- refusals ---------------------------------------------------------------------------------------------------------


def test_settings_out_of_range_are_named_all_at_once() -> None:
    with pytest.raises(BadInput) as caught:
        EvaluationConfig(n_episodes=0, seed=-1, rtg="onlin", target_quantile=1.5)  # type: ignore[arg-type]
    for problem in (
        "n_episodes must be at least 1, got 0",
        "seed must be at least 0, got -1",
        "unknown rtg 'onlin'; did you mean 'online'?",
        "target_quantile must be in [0, 1], got 1.5",
    ):
        assert problem in str(caught.value)


def test_scores_without_a_scorer_are_refused_before_anything_runs(trained: Path) -> None:
    with pytest.raises(BadInput, match=r"gt-0 has no zest_scorer.safetensors.*--rtg constant"):
        evaluate(trained / "gt-0", ONLINE, score=True)
    (trained / "dt-0" / SCORER_FILE).unlink()
    with pytest.raises(BadInput, match=r"dt-0 has no zest_scorer.safetensors"):
        evaluate(trained / "dt-0", ONLINE)
    with pytest.raises(BadInput, match="rtg 'online' needs a scorer; give it"):
        run_episodes(load_policy(trained / "dt-0"), range(1))
    assert not (trained / "dt-0" / "evaluations").exists()


def test_a_run_that_is_not_finished_or_no_run_is_refused(trained: Path) -> None:
    (trained / "bc-0" / "meta.json").unlink()
    with pytest.raises(BadInput, match=r"bc-0 is not finished; type its `zest train` command again"):
        evaluate(trained / "bc-0", ONLINE)
    with pytest.raises(BadInput, match="give a folder that `zest train` or `zest adopt` left"):
        evaluate(trained / "bc-9", ONLINE)


def test_weights_that_were_changed_are_refused(trained: Path) -> None:
    path = trained / "bc-0" / "model.safetensors"
    weights = bytearray(path.read_bytes())
    weights[-1] ^= 1
    path.write_bytes(weights)
    with pytest.raises(ZestError, match=r"model.safetensors is damaged: its sha256 is"):
        evaluate(trained / "bc-0", ONLINE)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"entry_point": "os:system"}, "would run code of 'os:system'"),
        (
            {"additional_wrappers": [{"name": "w", "entry_point": "os:system", "kwargs": {}}]},
            "would run code of 'os:system'",
        ),
        (
            {"id": "CartPole-v1", "entry_point": "gymnasium.envs:CartPole"},
            "CartPole-v1 would run code of 'gymnasium.envs:CartPole', but is registered as",
        ),
        ({"entry_point": "zest_rl.cli:main"}, f"{ENV_ID} would run code of 'zest_rl.cli:main', but is registered as"),
        ({"max_episode_steps": None}, "with max_episode_steps None"),
        ({"max_episode_steps": 10**12}, "with max_episode_steps 1000000000000"),
        ({"kwargs": {"x": 1}}, "takes a task and an init_noise, got {'x': 1}"),
        ({"kwargs": {"init_noise": "a"}}, "init_noise must be float, got 'a'"),
        ({"kwargs": {"init_noise": float("nan")}}, "init_noise must be float, got nan"),
        ({"kwargs": {"task": ["micro"]}}, "task must be str"),
        (
            {
                "additional_wrappers": [
                    {
                        "name": "v",
                        "entry_point": "gymnasium.wrappers:RecordVideo",
                        "kwargs": {"video_folder": "/tmp"},
                    }
                ]
            },
            "is evaluated without wrappers",
        ),
        ({"unheard_of": 1}, "the environment of the run is not the JSON of a Gymnasium EnvSpec"),
    ],
)
def test_a_run_from_elsewhere_cannot_bring_an_environment_of_its_own(
    trained: Path, change: dict[str, Any], complaint: str
) -> None:
    def edit(meta: dict[str, Any]) -> None:
        meta["dataset"]["env_spec"] = json.dumps(json.loads(meta["dataset"]["env_spec"]) | change)

    edit_meta(trained / "bc-0", edit)
    with pytest.raises(BadInput, match=complaint.replace("(", r"\(")):
        evaluate(trained / "bc-0", CONSTANT, n_workers=1)


def test_result_json_tells_what_was_run_and_by_what(trained: Path) -> None:
    evaluate(trained / "dt-0", CONSTANT, n_workers=1)
    folder = evaluation_folder(trained / "dt-0", CONSTANT)
    result = artifacts.read_json(folder / "result.json")
    assert result["config"] == {"n_episodes": 2, "seed": 11, "rtg": "constant", "target_quantile": 1.0}
    assert result["agent"] == "dt"
    assert result["references"] == {"minimum": 0.0, "expert": 70.0}
    assert [episode["seed"] for episode in result["episodes"]] == [11, 12]
    assert all((folder / "parts" / f"{name}.npz").exists() for name in result["parts"])
    assert result["provenance"]["versions"]["gymnasium"] == gymnasium.__version__
