"""Which episodes are worth keeping: the rule on plain scores, and datasets that are real and stay as they are."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from read_dataset import read

import zest_rl
from zest_rl.analysis.curation import NOTHING, rank_episodes
from zest_rl.data.folders import DATA_FILE, METADATA_FILE, dataset_path
from zest_rl.data.provenance import CurateRecord, DatasetRecord
from zest_rl.data.reader import Dataset, open_dataset
from zest_rl.errors import BadInput
from zest_rl.rewards.scorer import SCORER_FILE
from zest_rl.runtime import artifacts

Zest = Callable[..., dict[str, Any]]


def scores(*episodes: list[float]) -> list[np.ndarray]:
    return [np.array(episode, dtype=np.float32) for episode in episodes]


def test_worth_equals_a_loop_over_frames() -> None:
    rng = np.random.default_rng(0)
    episodes = [rng.normal(size=length).astype(np.float32) for length in (2, 9, 5, 7)]
    for ranked in rank_episodes(episodes):
        episode, best, dip, same = episodes[ranked.index].astype(float), -np.inf, 0.0, 0
        for t, score in enumerate(episode):
            best = max(best, score)
            dip = max(dip, best - score)
            same += t > 0 and score == episode[t - 1]
        mean = sum(episode[1:]) / (len(episode) - 1)
        assert ranked.worth == pytest.approx((mean + episode[-1]) / 2)
        assert (ranked.mean, ranked.end, ranked.dip) == pytest.approx((mean, episode[-1], dip))
        assert (ranked.progress, ranked.still) == pytest.approx((best - episode[0], same / (len(episode) - 1)))


def test_the_best_episode_comes_first_and_of_equals_the_earlier_one() -> None:
    ranking = rank_episodes(scores([0, 0, 0], [0, 0.5, 1], [0, 0, 0], [0, 0.5, 1]))
    assert [episode.index for episode in ranking] == [1, 3, 0, 2]


def test_words_tell_what_is_worse_than_in_most_others() -> None:
    good = [[0, 0.4, 0.8 + 0.01 * i] for i in range(5)]
    words = {each.index: each.words for each in rank_episodes(scores(*good, [0, 0, 0], [0, 1.1, 0.3]))}
    assert words[5] == (
        "mean score 0.000 (100 % of the others have more); ends at 0.000 (100 % end higher); gains at most 0.000 (100 "
        "% gain more); stands still in 100 % of its steps (100 % do less)"
    )
    assert words[6] == "ends at 0.300 (83 % end higher); falls by 0.800 after a better frame (100 % fall less)"
    assert words[4] == NOTHING


@pytest.mark.parametrize(
    ("episodes", "message"),
    [
        ([], "there must be at least 1 episode to rank, got 0"),
        ([[0, 1], [0, np.nan, np.inf]], r"episode 1 must have .* finite scores, got \(3,\) with 2 that are not"),
        ([[0, 1], [0]], r"episode 1 must have \(T \+ 1 >= 2,\) finite scores, got \(1,\)"),
    ],
)
def test_scores_that_rank_nothing_are_refused(episodes: list[list[float]], message: str) -> None:
    with pytest.raises(BadInput, match=message):
        rank_episodes(scores(*episodes))


@pytest.fixture
def scored(trained: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> str:
    """Four noisy episodes of which one fails, relabeled; the working folder is this test's own."""
    monkeypatch.chdir(tmp_path)
    return str(artifacts.read_json(trained / "bc-0" / "meta.json")["dataset"]["id"])


def arrays(dataset_id: str) -> list[dict[str, np.ndarray]]:
    episodes = []
    with h5py.File(dataset_path(dataset_id) / DATA_FILE) as file:
        for i in range(len(file)):
            found: dict[str, np.ndarray] = {}
            file[f"episode_{i}"].visititems(
                lambda name, node, found=found: found.update({name: node[()]} if isinstance(node, h5py.Dataset) else {})
            )
            episodes.append(found)
    return episodes


def test_the_kept_episodes_are_a_dataset_of_their_own_and_the_source_stays(scored: str, zest: Zest) -> None:
    folder = dataset_path(scored)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    made = zest("curate", scored, "--keep", "0.75")
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    (dropped,) = made["dropped"]
    kept = [i for i in range(4) if i != dropped]
    for own, source in zip(arrays(made["dataset"]), [arrays(scored)[i] for i in kept], strict=True):
        assert own.keys() == source.keys()
        for name, array in own.items():
            np.testing.assert_array_equal(array, source[name], err_msg=name)
    scorer = dataset_path(made["dataset"]) / SCORER_FILE
    assert scorer.read_bytes() == (folder / SCORER_FILE).read_bytes()
    with open_dataset(made["dataset"]) as ds:
        assert (ds.metadata["total_episodes"], ds.metadata["total_steps"]) == (3, 300)
        record = ds.record.curate
        assert record is not None
        assert (record.source, record.episodes) == (scored, tuple(kept))
        assert "provenance" not in ds.describe()["zest"]["curate"]
        assert ds.record.relabel is not None
    with h5py.File(dataset_path(made["dataset"]) / DATA_FILE) as file:
        assert [int(file[f"episode_{i}"].attrs["id"]) for i in range(3)] == [0, 1, 2]
    assert zest("curate", scored, "--keep", "0.75")["dataset"] == made["dataset"]
    assert made["next"] == f"zest train bc {made['dataset']}"
    run = zest(*made["next"].split()[1:], "--n-updates", "2", "--hidden-size", "8", "--run-dir", "run")
    assert DatasetRecord.of_run(artifacts.read_json(Path(run["run"]) / "meta.json")).curate == CurateRecord(
        scored, tuple(kept)
    )
    again = zest("curate", made["dataset"], "--keep", "0.5")
    assert [row["name"] for row in again["episodes"]] == [str(kept[row["episode"]]) for row in again["episodes"]]
    last = read(again["dataset"], lambda ds: ds.record.curate)
    assert last is not None
    assert set(last.episodes) < set(kept)


def test_the_table_gives_each_episode_a_weight_and_a_reason(scored: str, zest: Zest) -> None:
    made = zest("curate", scored)
    with Path(made["table"]).open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["episode"]) for row in rows] == [row["episode"] for row in made["episodes"]]
    assert [row["keep"] for row in rows] == ["0", "1", "1", "1"]
    assert (float(rows[0]["weight"]), float(rows[-1]["weight"])) == (0, 1)
    assert rows[0]["words"] == made["episodes"][0]["words"]


def test_the_proposal_is_compared_with_the_failures(scored: str, capsys: pytest.CaptureFixture[str]) -> None:
    curation = zest_rl.curate(scored, dry_run=True)
    (failed,) = [i for i, each in enumerate(read(scored, Dataset.truth)) if not each.success]
    quality = curation.quality
    assert quality is not None
    assert (quality.bad, quality.n_bad, quality.n_dropped, quality.at_random) == ("failures", 1, 1, 0.25)
    place = [episode.index for episode in reversed(curation.ranking)].index(failed) + 1
    assert quality.auprc.value == pytest.approx(1 / place)
    assert quality.precision.value == quality.recall == (place == 1)
    assert quality.auprc_by_length.value == 0.25, "all episodes are equally long"
    from zest_rl import cli

    assert cli.main(["curate", scored, "--dry-run"]) == 0
    told = capsys.readouterr().out
    assert "of failures (1), " in told
    assert "kept: 3 of 4 episodes" in told


def test_a_dry_run_writes_nothing(scored: str, zest: Zest) -> None:
    before = sorted(Path().rglob("*"))
    made = zest("curate", scored, "--dry-run", "--keep", "0.5")
    assert sorted(Path().rglob("*")) == before
    assert (made["dataset"], made["table"], made["next"]) == (None, None, f"zest curate {scored} --keep 0.5")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--keep", "0"), "--keep must be above 0 and at most 1, got 0.0"),
        (("--keep", "1.5"), "--keep must be above 0 and at most 1, got 1.5"),
        (("--keep", "nan"), "--keep must be above 0 and at most 1, got nan"),
        (("--keep", "1"), "--keep 1.0 of 4 episodes drops none; give at most 0.75"),
        (("--output", "table.txt"), "the table is a CSV file, got --output table.txt"),
        (("--source", "nothing.hdf5"), "--source must be a robomimic HDF5 file or a LeRobot folder"),
    ],
)
def test_what_cannot_be_curated_is_refused(
    words: tuple[str, ...], message: str, scored: str, refusal: Callable[..., tuple[int, str]]
) -> None:
    code, error = refusal("curate", scored, *words)
    assert (code, message in error) == (2, True), error


def test_datasets_without_their_own_scores_are_refused(scored: str) -> None:
    source = read(scored, lambda ds: ds.record.source_id)
    with pytest.raises(BadInput, match=f"holds no ZeST scores; run `zest relabel {source}`"):
        zest_rl.curate(source)
    path = dataset_path(scored) / METADATA_FILE
    metadata = json.loads(path.read_text())
    metadata["zest"]["relabel"]["shuffle"] = 0
    path.write_text(json.dumps(metadata))
    (dataset_path(scored) / "zest_manifest.json").unlink()
    with pytest.raises(BadInput, match="has the scores of other episodes"):
        zest_rl.curate(scored)
