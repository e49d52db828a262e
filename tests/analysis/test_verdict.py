"""The verdict on rewards that are known to be good or bad, with ground truth and without."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import gymnasium
import gymnasium_robotics  # noqa: F401  # registers its environments
import numpy as np
import pytest
from PIL import Image
from read_dataset import read

from zest_rl.analysis.inspection import inspect
from zest_rl.analysis.reward_figures import measure_rewards
from zest_rl.analysis.verdict import Verdict, judge
from zest_rl.data.reader import Dataset
from zest_rl.metrics.statistics import Estimate
from zest_rl.rewards.relabel import relabel
from zest_rl.runtime.gl import select_gl_backend
from zest_rl.simulation.recorder import Recorder
from zest_rl.types import FloatArray, GroundTruth

N_STEPS = 40
Episodes: TypeAlias = list[FloatArray]
Corrupt = Callable[[Episodes, np.random.Generator], Episodes]


def progress(n_episodes: int, rng: np.random.Generator) -> Episodes:
    """True progress of a door that starts to open at any time and stops anywhere, (T,) per episode."""
    time = np.arange(N_STEPS)
    starts, ends = rng.uniform(5, 25, n_episodes), rng.uniform(0.1, 1, n_episodes)
    return [np.float32(end / (1 + np.exp(-(time - start - 5) / 2))) for start, end in zip(starts, ends, strict=True)]


def verdicts_on(rewards: Episodes, true: Episodes) -> tuple[Verdict, Verdict]:
    """Judge levels, whose x_0 scores 0, by the ground truth and without it."""
    scores = [np.concatenate([[0], episode]).astype(np.float32) for episode in rewards]
    figures = measure_rewards(rewards, scores, None, None, [GroundTruth(episode, None) for episode in true])
    return judge(rewards, figures), without_truth(rewards, figures)


def without_truth(rewards: Episodes, figures: Mapping[str, Estimate]) -> Verdict:
    need_truth = ("spearman", "kendall", "pairwise", "epic", "auprc", "successes")
    return judge(rewards, {key: figure for key, figure in figures.items() if key not in need_truth})


def test_an_interval_from_bad_to_good_is_of_too_few_episodes() -> None:
    rewards = progress(6, np.random.default_rng(0))
    rho = Estimate(0.79, -0.11, 1.0)
    assert judge(rewards, {"spearman": rho}).advice == "too few episodes to tell"
    assert judge(rewards, {"spearman": replace(rho, low=0.2)}).advice == "train on it"
    assert judge(rewards, {"spearman": Estimate(0.2, -0.1, 0.45)}).advice == "do not"


def test_what_the_record_tells_decides() -> None:
    rewards = progress(6, np.random.default_rng(0))
    rising = {"value_order": Estimate(0.8, 0.7, 0.9), "fallen": Estimate(0.0, 0.0, 0.0)}
    assert judge(rewards, rising).advice == "train on it"
    assert judge(rewards, rising, view_cannot_tell=True).why == (
        "one view that shows the robot cannot tell what the goal changes"
    )
    assert judge(rewards, rising, shuffled=True).why == "these are the scores of other episodes"
    longer = [np.linspace(0, 1, 8 * i, dtype=np.float32) for i in range(2, 8)]
    assert judge(longer, rising).why == "the returns follow the episodes' length, ρ = 1.00"


def noisy(true: Episodes, rng: np.random.Generator) -> Episodes:
    return [np.float32(0.3 * episode + rng.normal(0, 0.01, N_STEPS)) for episode in true]


def exchanged(true: Episodes, rng: np.random.Generator) -> Episodes:
    return noisy([true[i - 1] for i in range(len(true))], rng)


def reversed_(true: Episodes, rng: np.random.Generator) -> Episodes:
    return [-episode for episode in noisy(true, rng)]


def constant(true: Episodes, rng: np.random.Generator) -> Episodes:
    return [np.full(N_STEPS, 0.7, np.float32) for _ in true]


def random(true: Episodes, rng: np.random.Generator) -> Episodes:
    return [rng.normal(0, 0.1, N_STEPS).astype(np.float32) for _ in true]


def of_time(true: Episodes, rng: np.random.Generator) -> Episodes:
    return [np.float32(rng.uniform(0.5, 1) * np.arange(1, N_STEPS + 1) / N_STEPS) for _ in true]


def clock(true: Episodes, rng: np.random.Generator) -> Episodes:
    return [np.float32(np.sqrt(np.arange(N_STEPS)) + rng.normal(0, 0.05, N_STEPS)) for _ in true]


@pytest.mark.parametrize(
    ("corrupt", "n_episodes", "with_truth", "without"),
    [
        (noisy, 60, "train on it: the returns rank the 60 episodes", "train on it: in the 60 episodes the score rises"),
        (exchanged, 60, "do not: the returns hardly rank", "train on it"),  # nothing but the truth or states tells
        (reversed_, 60, "do not: the higher the return, the worse the episode", "do not: in the 60 episodes the score"),
        (constant, 60, "do not: all frames score the same", "do not: all frames score the same"),
        (random, 60, "do not: the returns hardly rank", "do not: in the 60 episodes the score does not rise"),
        (of_time, 60, "do not: the returns hardly rank", "do not: in every episode, good or bad, the score is prop"),
        (clock, 60, "do not: the returns hardly rank", "do not: the step number alone tells the score"),
        (random, 8, "too few episodes to tell: 8 leave open", "too few episodes to tell: 8 leave open"),
        (noisy, 4, "too few episodes to tell: 4, and 5 are the least", "too few episodes to tell: 4, and 5 are"),
    ],
)
def test_rewards_known_to_be_good_or_bad_are_judged_so(
    corrupt: Corrupt, n_episodes: int, with_truth: str, without: str
) -> None:
    rng = np.random.default_rng(0)
    true = progress(n_episodes, rng)
    rewards = corrupt(true, rng)
    by_truth, by_itself = verdicts_on(rewards, true)
    print(f"{corrupt.__name__}, {n_episodes} episodes: {by_truth}\n  without ground truth: {by_itself}")
    assert str(by_truth).startswith(with_truth)
    assert str(by_itself).startswith(without)
    assert len(by_truth.figures) == len(by_itself.figures) == 2
    assert Verdict.from_json(by_truth.to_json()) == by_truth


def test_where_the_truth_or_the_order_in_time_ranks_nothing_the_other_rules_decide() -> None:
    rng = np.random.default_rng(0)
    rewards = noisy(progress(60, rng), rng)
    by_truth, by_itself = verdicts_on(rewards, [np.ones(N_STEPS, np.float32)] * 60)
    assert by_truth == by_itself
    assert by_truth.advice == "train on it"
    of_one_step = [np.array([level], np.float32) for level in np.linspace(0.1, 1, 8)]
    by_itself = verdicts_on(of_one_step, of_one_step)[1]
    assert str(by_itself) == (
        "too few episodes to tell: 8 leave open whether the score rises in an episode; Episodes that end lower 0.00"
    )


def random_actions(env_id: str, dataset_id: str) -> str:
    """Record 20 short episodes of random actions."""
    recorder = Recorder(gymnasium.make(env_id))
    recorder.action_space.seed(0)
    for seed in range(20):
        recorder.reset(seed=seed)
        for _ in range(20):
            recorder.step(recorder.action_space.sample())
    recorder.write(dataset_id)
    return dataset_id


def nearly_equal_pictures(env_id: str, folder: Path) -> Path:
    """Render an environment before and after a tiny movement, as start and goal."""
    env = gymnasium.make(env_id, render_mode="rgb_array", width=224, height=224)
    env.reset(seed=5)
    for part in ("init", "goal"):
        (folder / part).mkdir(parents=True)
        Image.fromarray(env.render()).save(folder / part / "0.png")
        env.step(0.05 * env.action_space.sample())
    env.close()
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env_id", "goal", "with_truth", "without"),
    [
        (
            "AdroitHandDoor-v1", "open_cabinet",
            "do not: the returns hardly rank the 20 episodes", "too few episodes to tell: 20 leave open",
        ),
        (
            "FetchReach-v4", "nearly equal",
            "do not: in the 20 episodes the score does not rise", "do not: in the 20 episodes the score does not rise",
        ),
    ],
)  # fmt: skip
def test_rewards_of_random_actions_in_real_environments_are_not_recommended(
    env_id: str,
    goal: str,
    with_truth: str,
    without: str,
    request: pytest.FixtureRequest,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "cache"))
    (tmp_path / "minari").mkdir()
    select_gl_backend()
    if goal == "nearly equal":
        pictures = nearly_equal_pictures(env_id, tmp_path / "goal")
    else:
        pictures = request.getfixturevalue("visual_tasks") / "real_imgs" / goal
    made = relabel(random_actions(env_id, "robot/random-v0"), str(pictures), camera=("default",), n_workers=1)
    found = inspect(made.dataset_id)
    by_itself = without_truth(read(made.dataset_id, Dataset.rewards), found.figures)
    print(f"{env_id}, random actions, {goal} pictures: {found.verdict}\n  without ground truth: {by_itself}")
    assert str(found.verdict).startswith(with_truth)
    assert str(by_itself).startswith(without)
    assert "nan" not in " ".join(found.warnings)
    assert any("All true returns are equal" in said for said in found.warnings) == (env_id == "FetchReach-v4")
