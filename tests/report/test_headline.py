"""The sentence that a comparison opens with says what its rows say, whichever way they fall."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest

from zest_rl.metrics.statistics import Estimate
from zest_rl.report.content import Kind, MethodRow
from zest_rl.report.headline import headline


def row(method: str, mean: float, half: float = 2.0, kind: Kind = "method", n_episodes: int = 20) -> MethodRow:
    return MethodRow(method, mean, mean - half, mean + half, mean, 1.0, 1, n_episodes, kind)


def meta(agent: str, goal: str | None = "same-scene", config: dict[str, Any] | None = None, **relabel: Any) -> Any:
    """The parts of a run's meta.json that say what it learned from."""
    scorer = {"config": {"goal": goal, "embedder": "e", "features": "delta", "similarity": "cos", "views": None}}
    hashes = {"goal_sha256": "", "embedder_sha256": ""}
    frames = {"views": ["camera"]}
    record = {"source": "a/b-v0", "source_sha256": "", "reward": "level", "scorer": {**scorer, **hashes}}
    zest = {} if goal is None else {"relabel": {**record, "frames": frames, **relabel}}
    config = {"top_fraction": 1.0, "condition_on_return": True} | (config or {})
    return {"agent": agent, "config": config, "dataset": {"id": "a/b-v0", "zest": zest}}


DATA = row("Demo", 82.6, kind="dataset", n_episodes=60)
METAS = {
    "BC": meta("bc"),
    "ZeST+RvS": meta("rvs"),
    "ZeST+DT": meta("dt"),
    "by a sentence": meta("dt", "text:closed -> open"),
    "GT": meta("dt", None),
    "shuffled": meta("dt", shuffle=0),
    "without return": meta("rvs", config={"condition_on_return": False}),
    "BC on the best": meta("bc", config={"top_fraction": 0.25}),
}
SAME = "Trained on the same 60 episodes, which themselves reach 83 % of the expert, "
PICTURE = "which learned from a picture's rewards, reaches"
MORE, LESS = Estimate(13.2, 9.04, 17.0), Estimate(-2.12, -4.0, 0.5)


@pytest.mark.parametrize(
    ("rows", "difference", "sentence"),
    [
        (
            [row("BC", 83.1), row("ZeST+RvS", 97.4), row("ZeST+DT", 96.0)],
            MORE,
            f"ZeST+DT, {PICTURE} 96 % and behaviour cloning 83 %: 13.2 points more from the same starts (95 % interval "
            "of the difference 9.0 to 17.0).",
        ),
        (
            [row("BC", 99.0), row("by a sentence", 96.9)],
            LESS,
            "by a sentence, which learned from a sentence's rewards, reaches 97 % and behaviour cloning 99 %: 2.1 "
            "points less from the same starts (95 % interval of the difference −4.0 to 0.5); as 0 lies in it, the "
            "difference may be chance.",
        ),
        (
            [row("BC", 83.0), row("ZeST+DT", 90.0), row("ZeST+RvS", 95.0)],
            None,
            f"ZeST+DT, {PICTURE} 90 % and behaviour cloning 83 %, from other starts (95 % intervals 88.0 to 92.0 and "
            "81.0 to 85.0).",
        ),
        (
            [row("BC", 83.0), row("ZeST+RvS", 86.0)],
            None,
            f"ZeST+RvS, {PICTURE} 86 % and behaviour cloning 83 %, from other starts (95 % intervals 84.0 to 88.0 and "
            "81.0 to 85.0); as these overlap, the difference may be chance.",
        ),
        (
            [
                row("BC on the best", 95.0),
                row("BC", 83.0),
                row("GT", 99.0),
                row("shuffled", 98.0),
                row("without return", 97.0),
                row("ZeST+DT", 90.0, kind="control"),
                row("ZeST+RvS", 89.0),
            ],
            MORE,
            f"ZeST+RvS, {PICTURE} 89 % and behaviour cloning 83 %: 13.2 points more from the same starts (95 % "
            "interval of the difference 9.0 to 17.0).",
        ),
    ],
    ids=["the highest is not asked about", "less", "other starts", "overlap", "other rewards and controls"],
)
def test_the_decision_transformer_on_zest_rewards_is_compared_with_cloning(
    rows: Sequence[MethodRow], difference: Estimate | None, sentence: str
) -> None:
    asked = []

    def gain(before: str, after: str) -> Estimate | None:
        asked.append((before, after))
        return difference

    assert headline([DATA, *rows], METAS, gain) == SAME + sentence
    assert asked == [("BC", sentence.split(",")[0])]


def test_several_datasets_are_told() -> None:
    told = headline([DATA, row("BC", 83.0), row("ZeST+DT", 90.0)], METAS, lambda *_: MORE, n_datasets=6)
    assert told.startswith("Trained on the same 60 episodes of 6 datasets, which")


@pytest.mark.parametrize(
    "without", [lambda row: row.kind == "dataset", lambda row: row.method == "BC"], ids=["no dataset", "no cloning"]
)
def test_without_the_dataset_or_cloning_the_best_method_is_told(without: Callable[[MethodRow], bool]) -> None:
    rows = [each for each in (DATA, row("BC", 83.0), row("GT", 92.0), row("ZeST+DT", 90.0)) if not without(each)]
    assert headline(rows, METAS, lambda *_: MORE) == (
        "GT reaches 92.0 % of the expert's return (95 % interval 90.0 to 94.0, 1 seed, 20 episodes)."
    )
    assert headline([], {}, lambda *_: MORE) == ""
