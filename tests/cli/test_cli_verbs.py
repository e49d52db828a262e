"""The verbs from train to report, as they are typed, and the recipes that come with the package."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import pytest
from PIL import Image
from read_dataset import read
from tiny_dataset import COLLECTED

from zest_rl.cli import collect as collect_verb
from zest_rl.cli import follow, select, train
from zest_rl.cli.config import parse_config
from zest_rl.cli.reproduce.comparison import read_comparison
from zest_rl.cli.reproduce.reward_study import read_reward_study
from zest_rl.cli.reproduce.study import read_study
from zest_rl.data import reader
from zest_rl.data.reader import Dataset
from zest_rl.runtime import artifacts

ROOT = Path(__file__).resolve().parents[2]
SMALL = ["--hidden-size", "16", "--n-layers", "1", "--n-updates", "4", "--log-every", "2", "--threads", "1"]


@pytest.fixture(autouse=True)
def _short(short_videos: None) -> None:
    """Videos cost more than all else here."""


# --- train, evaluate, report ------------------------------------------------------------------------------------------


def test_each_verb_ends_with_the_next_command_and_that_command_works(
    collected: str, zest: Callable[..., dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    trained = zest("train", "bc", collected, *SMALL)
    assert trained.keys() == {"run", "agent", "n_params", "n_updates", "train_seconds", "next"}
    assert trained["run"] == "runs/kitchen-micro-tiny-v0-bc-seed0"
    assert trained["next"] == "zest evaluate runs/kitchen-micro-tiny-v0-bc-seed0"
    evaluated = zest(*shlex.split(trained["next"])[1:], "--n-episodes", "2", "--n-workers", "1")
    assert evaluated.keys() == {
        "run", "normalized_return", "iqm", "success", "n_episodes", "target_return", "result", "videos", "seconds",
        "next",
    }  # fmt: skip
    assert evaluated["normalized_return"].keys() == evaluated["success"].keys() == {"value", "low", "high"}
    assert Path(evaluated["result"]).is_file()
    assert evaluated["videos"].keys() == {"best", "median", "worst"}
    assert all(Path(video).is_file() for video in evaluated["videos"].values())
    reported = zest(*shlex.split(evaluated["next"])[1:])
    assert reported["report"] == "report.html"
    assert reported["rows"].keys() == {"Demo", "BC"}
    assert reported["rows"]["BC"] == round(evaluated["normalized_return"]["value"], 2)
    assert reported["unit"] == "% of the expert"
    assert reported["sentence"].startswith("BC reaches")
    assert "BC" in Path("report.html").read_text(encoding="utf-8")


def test_a_folder_with_a_space_is_quoted_in_the_next_command(
    collected: str, zest: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    run = tmp_path / "my run"
    trained = zest("train", "bc", collected, *SMALL, "--run-dir", run)
    evaluated = zest(*shlex.split(trained["next"])[1:], "--n-episodes", "1", "--n-workers", "1", "--no-videos")
    assert evaluated["videos"] == {}
    assert shlex.split(evaluated["next"]) == ["zest", "report", str(run)]


def test_training_on_scores_leaves_their_scorer_beside_the_policy(
    trained: Path, zest: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    dataset = artifacts.read_json(trained / "dt-0" / "meta.json")["dataset"]["id"]
    zest("train", "bc", dataset, *SMALL, "--run-dir", tmp_path / "scored")
    zest("train", "bc", COLLECTED, *SMALL, "--run-dir", tmp_path / "truth")
    name = "zest_scorer.safetensors"
    assert (tmp_path / "scored" / name).read_bytes() == (reader.dataset_path(dataset) / name).read_bytes()
    assert not (tmp_path / "truth" / name).exists()


@pytest.mark.parametrize("verb", ["inspect", "train bc", "relabel"])
def test_a_dataset_is_hashed_walked_through_and_opened_once_however_much_is_read_of_it(
    verb: str, trained: Path, zest: Callable[..., dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = artifacts.read_json(trained / "dt-0" / "meta.json")["dataset"]["id"]
    path = reader.dataset_path(dataset)
    hash_file, open_file = artifacts.hash_file, h5py.File.__init__
    hashed, opened = [], []

    def counted_hash(file: Path) -> str:
        hashed.append(file)
        return hash_file(file)

    def counted_open(self: h5py.File, name: Any, *arguments: Any, **options: Any) -> None:
        opened.append(name)
        open_file(self, name, *arguments, **options)

    monkeypatch.setattr(artifacts, "hash_file", counted_hash)
    monkeypatch.setattr(h5py.File, "__init__", counted_open)
    options = {
        "inspect": ("--output", tmp_path / "page.html", "--n-workers", "1"),
        "train bc": (*SMALL, "--run-dir", tmp_path / "run"),
        "relabel": ("--views", "1", "--tolerance", "0.05", "--n-workers", "1"),
    }
    zest(*verb.split(), dataset, *options[verb])
    files = [path / name for name in artifacts.read_json(path / reader.MANIFEST_FILE)]
    assert sorted(file for file in hashed if file.is_relative_to(path)) == sorted(files)
    assert [name for name in opened if name == path / reader.DATA_FILE] == [path / reader.DATA_FILE] * 2


def test_a_rerun_of_a_finished_verb_changes_nothing(
    collected: str, zest: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    words = [
        ("train", "bc", collected, *SMALL, "--run-dir", tmp_path / "run"),
        ("evaluate", tmp_path / "run", "--n-episodes", "1", "--n-workers", "1"),
    ]
    first = [zest(*line) for line in words]
    kept = [tmp_path / "run" / "meta.json", *map(Path, first[1]["videos"].values())]
    written = [path.stat().st_mtime_ns for path in kept]
    second = [zest(*line) for line in words]
    assert [path.stat().st_mtime_ns for path in kept] == written
    assert second[0] == first[0]
    assert {**second[1], "seconds": 0} == {**first[1], "seconds": 0}


def test_a_policy_on_the_kitchen_relabeled_by_other_frames_is_evaluated_but_not_scored_online(
    collected: str, zest: Callable[..., dict[str, Any]], refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    for part, colour in (("init", "black"), ("goal", "white")):
        (tmp_path / part).mkdir()
        Image.new("RGB", (16, 16), colour).save(tmp_path / part / "0.png")
    for i, episode in enumerate(read(collected, Dataset.episodes)):
        (tmp_path / "films" / f"episode_{i}").mkdir(parents=True)
        for t in range(len(episode) + 1):
            Image.new("L", (8, 8), t).save(tmp_path / "films" / f"episode_{i}" / f"{t}.png")
    words = ("--goal", tmp_path, "--frames", tmp_path / "films", "--n-workers", "1")
    made = zest("relabel", collected, *words)["dataset"]
    run = tmp_path / "run"
    assert zest("train", "bc", made, *SMALL, "--run-dir", run)["next"] == f"zest evaluate {shlex.quote(str(run))}"
    code, message = refusal("evaluate", run, "--score")
    assert (code, "its frames are from elsewhere, so scores cannot be made online" in message) == (2, True)
    zest("evaluate", run, "--n-episodes", "1", "--n-workers", "1", "--no-videos")


def test_what_cannot_be_done_has_an_exit_code_and_says_what_to_do(
    trained: Path, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    for words, code, complaint in (
        (("train", "bc", "zest/kitchen-micro-tini-v0"), 2, "`minari download zest/kitchen-micro-tini-v0`"),
        (("train", "bc", COLLECTED, "--run-dir", trained / "bc-0"), 2, "of that run, or give another --run-dir"),
        (("train", "bc", COLLECTED, "--top-fraction", "2", "--run-dir", tmp_path / "x"), 2, "top_fraction must be in"),
        (("evaluate", tmp_path / "nothing"), 2, "is not the folder of a training"),
        (("evaluate", trained / "gt-0", "--score"), 2, "was not trained on a relabeled dataset"),
        (("evaluate", trained / "gt-0", "--n-episodes", "0"), 2, "n_episodes must be at least 1, got 0"),
        (("evaluate", trained / "gt-0", "--rtg", "offline"), 2, "--rtg"),
        (("report",), 2, "needs at least 1 run folder"),
        (("report", trained / "gt-0"), 2, f"holds no evaluation; run `zest evaluate {trained / 'gt-0'}` first"),
        (("report", tmp_path), 2, "is not the folder of a training"),
    ):
        got, message = refusal(*words)
        assert (got, complaint in message) == (code, True), message
    (trained / "gt-0" / "model.safetensors").write_bytes(b"")
    code, message = refusal("evaluate", trained / "gt-0")
    assert code == 1
    assert "is damaged" in message


def test_a_report_has_one_row_per_method_and_one_scatter_per_goal(
    trained: Path, zest: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    for name in ("bc-0", "bc-1", "gt-0"):
        zest("evaluate", trained / name, "--n-episodes", "1", "--n-workers", "1", "--no-videos")
    html = tmp_path / "out" / "compare.html"
    runs = [trained / name for name in ("bc-0", "bc-1", "gt-0", "bc-0")]
    reported = zest("report", *runs, "--output", html, "--title", "Two rewards")
    assert list(reported["rows"]) == ["Demo", "BC", "DT on ground truth"]
    text = html.read_text()
    for part in ("Two rewards", "DT on ground truth", "same-scene", "data:video/mp4;base64,"):
        assert part in text


# --- recipes that come with the package -------------------------------------------------------------------------------


EVAL = sorted((ROOT / "eval").glob("*.toml"))
OF_A_VERB = [path for path in EVAL if "\nverb = " in path.read_text()]


@pytest.mark.parametrize("path", [path for path in EVAL if path not in OF_A_VERB], ids=lambda path: path.name)
def test_a_recipe_of_a_table_is_valid_and_found_from_anywhere(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for variable in ("ZEST_VISUAL_TASKS", "ZEST_FOOTAGE", "ZEST_RENDERED"):
        monkeypatch.setenv(variable, str(tmp_path))
    text = path.read_text(encoding="utf-8")
    if '\nstudy = "trex"' in text:
        assert read_reward_study(Path("eval") / path.name).tables.title
        return
    if "\nstudy = " in text:
        study = read_study(Path("eval") / path.name)
        assert study.tables.title
        assert study.settings
        assert bool(study.collect) == (study.tables.study != "footage")
        return
    comparison = read_comparison(Path("eval") / path.name)
    assert comparison.tables.title
    assert comparison.methods.keys() == comparison.tables.methods.keys()
    assert comparison.tasks


@pytest.mark.parametrize(
    "path",
    sorted([*(ROOT / "train").glob("*.toml"), *(ROOT / "datasets").glob("*.toml"), *OF_A_VERB]),
    ids=lambda path: path.name,
)
def test_a_recipe_of_a_verb_is_valid(path: Path) -> None:
    verb = next(line for line in path.read_text(encoding="utf-8").splitlines() if line.startswith("verb")).split('"')[1]
    configs: dict[str, Any] = {"collect": collect_verb.Config}
    configs |= {f"train {agent}": config for agent, config in train.CONFIGS.items()}
    configs |= {f"follow {what}": config for what, config in follow.CONFIGS.items()}
    configs |= {f"select {what}": config for what, config in select.CONFIGS.items()}
    words = ["zest/some-v0"] if verb.startswith(("train", "select")) else []
    config, _ = parse_config(configs[verb], [*words, "--recipe", str(path)], verb)
    assert isinstance(config, configs[verb])


def test_recipes_of_all_three_kinds_come_with_the_package() -> None:
    assert all(list((ROOT / folder).glob("*.toml")) for folder in ("datasets", "train", "eval"))
