"""The verbs from train to report, as they are typed; and `zest reproduce`, which joins them all."""

from __future__ import annotations

import json
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import COLLECTED

from zest_rl import artifacts, cli, collect, comparison, data, videos
from zest_rl.cli import collect as collect_verb
from zest_rl.cli import reproduce, train
from zest_rl.cli.recipes import parse_config

ROOT = Path(__file__).resolve().parent.parent
SMALL = ["--hidden-size", "16", "--n-layers", "1", "--n-updates", "4", "--log-every", "2", "--threads", "1"]


def short_video(states: np.ndarray, path: Path, **_: object) -> Path:
    """Write a video of the first 2 states only."""
    return WRITE_VIDEO(states[:2], path, size=64)


WRITE_VIDEO = videos.write_video


@pytest.fixture(autouse=True, scope="module")
def _short_videos() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(videos, "write_video", short_video)
        patch.setattr(comparison, "write_video", short_video)
        yield


@pytest.fixture
def zest(capsys: pytest.CaptureFixture[str]) -> Callable[..., dict[str, Any]]:
    """Run a verb that must succeed, and return its JSON document."""

    def run(*words: str | Path) -> dict[str, Any]:
        code = cli.main([*map(str, words), "--json"])
        out, err = capsys.readouterr()
        assert code == 0, err
        document: dict[str, Any] = json.loads(out)
        return document

    return run


@pytest.fixture
def refusal(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    """Run a verb that must fail, and return its exit code and message."""

    def run(*words: str | Path) -> tuple[int, str]:
        code = cli.main(list(map(str, words)))
        out, err = capsys.readouterr()
        assert out == ""
        assert "Traceback" not in err
        return code, err

    return run


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
    assert "BC" in Path("report.html").read_text()


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
    assert (tmp_path / "scored" / name).read_bytes() == (data.dataset_path(dataset) / name).read_bytes()
    assert not (tmp_path / "truth" / name).exists()


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


def test_what_cannot_be_done_has_an_exit_code_and_says_what_to_do(
    trained: Path, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    for words, code, complaint in (
        (("train", "bc", "zest/kitchen-micro-tini-v0"), 2, "did you mean 'zest/kitchen-micro-tiny-v0'"),
        (("train", "bc", COLLECTED, "--run-dir", trained / "bc-0"), 2, "holds a run with other arguments"),
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


@pytest.mark.parametrize("path", sorted((ROOT / "eval").glob("*.toml")), ids=lambda path: path.name)
def test_a_recipe_of_a_table_is_valid_and_found_from_anywhere(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    plan = reproduce.read_plan(Path("eval") / path.name)
    assert plan.recipe.title
    assert plan.methods.keys() == plan.training.keys()
    assert all(entry.goal is None or entry.goal in plan.goals for entry in plan.methods.values())


@pytest.mark.parametrize(
    "path", sorted([*(ROOT / "train").glob("*.toml"), *(ROOT / "datasets").glob("*.toml")]), ids=lambda path: path.name
)
def test_a_recipe_of_a_verb_is_valid(path: Path) -> None:
    verb = next(line for line in path.read_text().splitlines() if line.startswith("verb")).split('"')[1]
    configs: dict[str, Any] = {"collect": collect_verb.Config}
    configs |= {f"train {agent}": config for agent, config in train.CONFIGS.items()}
    words = ["zest/some-v0"] if verb.startswith("train") else []
    config, _ = parse_config(configs[verb], [*words, "--recipe", str(path)], verb)
    assert isinstance(config, configs[verb])


def test_recipes_of_all_three_kinds_come_with_the_package() -> None:
    assert all(list((ROOT / folder).glob("*.toml")) for folder in ("datasets", "train", "eval"))


# --- reproduce --------------------------------------------------------------------------------------------------------

RECIPE = """
title = "A tiny comparison"
seeds = [0]
caveats = ["Tiny."]
paper_demo = 81.19

[collect]
task = "micro"
n_episodes = 4
noise_max = 1.0
dataset = "zest/kitchen-micro-whole-v0"

[relabel]
views = 1
tolerance = 0.05

[goals.scene]
goal = "same-scene"

[train]
n_updates = 20
hidden_size = 32
n_layers = 1
warmup_updates = 0
log-every = 10

[methods.BC]
agent = "bc"
goal = "scene"
kind = "control"
paper = 80.67

[methods."ZeST+DT"]
agent = "dt"
goal = "scene"
context_len = 5

[evaluate]
n_episodes = 2
videos = false
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "tiny.toml"
    path.write_text(text)
    return path


@dataclass(frozen=True)
class Reproduced:
    recipe: Path
    output: Path
    result: dict[str, Any]


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """An empty Minari root and an empty cache; the expert is measured on few episodes."""
    folder = tmp_path_factory.mktemp("reproduce")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
        patch.setenv("ZEST_CACHE", str(folder / "cache"))
        patch.setattr(collect, "N_REFERENCE", 2)
        patch.setattr(collect, "N_NOTHING", 1)
        yield folder


@pytest.fixture(scope="module")
def whole(places: Path) -> Reproduced:
    """A recipe that ran to its end."""
    recipe, output = write(places, RECIPE), places / "whole"
    config = reproduce.Config(recipe, output, n_workers=1)
    return Reproduced(recipe, output, reproduce.run(config, reproduce.SilentUi()))


@pytest.fixture
def again(whole: Reproduced, tmp_path: Path, zest: Callable[..., dict[str, Any]]) -> Callable[[], dict[str, Any]]:
    """Run the recipe again, on a copy of its output in ``tmp_path / "copy"``."""
    copy = shutil.copytree(whole.output, tmp_path / "copy")
    return lambda: zest("reproduce", whole.recipe, "--output", copy, "--n-workers", "1")


def cell(output: Path, method: str) -> Path:
    (folder,) = (output / "cells").glob(f"{method}-seed0-*")
    return folder


def test_a_recipe_becomes_datasets_policies_a_table_and_a_report(whole: Reproduced) -> None:
    assert [(name, row["kind"], row["n_seeds"], row["n_episodes"]) for name, row in whole.result["rows"].items()] == [
        ("Demo", "dataset", 1, 4),
        ("BC", "control", 1, 2),
        ("ZeST+DT", "method", 1, 2),
    ]
    assert whole.result["n_cells_run"] == 2
    assert whole.result["rows"]["BC"]["paper"] == 80.67
    assert whole.result["rows"]["Demo"]["paper"] == 81.19
    assert data.exists("zest/kitchen-micro-whole-v0")
    assert any("-zest-" in name for name in data.list_datasets())
    evaluated = artifacts.read_json(next(cell(whole.output, "zest-dt").glob("evaluations/*/result.json")))
    value = evaluated["summary"]["normalized_return"]["value"]
    assert whole.result["rows"]["ZeST+DT"]["normalized_return"] == value
    written = artifacts.read_json(whole.output / "result.json")
    assert written == json.loads(json.dumps({key: whole.result[key] for key in written}))
    assert written["seconds_by_cell"].keys() == {cell(whole.output, name).name for name in ("bc", "zest-dt")}
    html = (whole.output / "report.html").read_text()
    assert all(part in html for part in ("A tiny comparison", "ZeST+DT", "Tiny.", "same-scene"))


def test_the_table_as_text_shows_every_row_and_goal(whole: Reproduced) -> None:
    lines = reproduce.summary(whole.result).splitlines()
    assert [line.split()[0] for line in lines[1:4]] == ["Demo", "BC", "ZeST+DT"]
    assert "80.67" in lines[2]
    assert lines[4].startswith("goal scene: Spearman ρ of ZeST and true returns ")
    undefined = reproduce.summary({**whole.result, "spearman_of_zest_and_true_returns": {"scene": None}})
    assert "true returns undefined" in undefined


def test_a_second_run_finds_everything_done_and_says_so(
    whole: Reproduced, again: Callable[[], dict[str, Any]], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    result = again()
    assert result["n_cells_run"] == 0
    assert result["rows"] == whole.result["rows"]
    cli.main(["reproduce", str(whole.recipe), "--output", str(tmp_path / "copy"), "--n-workers", "1"])
    out, err = capsys.readouterr()
    assert "all cells were done already" in err
    assert err.count("is there already, nothing to do") == 2, "neither collected nor relabeled"
    assert "0 cells run" in out


def test_a_deleted_cell_is_run_again_alone_and_to_the_same_numbers(
    whole: Reproduced, again: Callable[[], dict[str, Any]], tmp_path: Path
) -> None:
    kept = cell(tmp_path / "copy", "bc") / "meta.json"
    before = kept.stat().st_mtime_ns
    gone = cell(tmp_path / "copy", "zest-dt")
    weights = (gone / "model.safetensors").read_bytes()
    shutil.rmtree(gone)
    result = again()
    assert result["n_cells_run"] == 1
    assert result["rows"] == whole.result["rows"]
    assert (gone / "model.safetensors").read_bytes() == weights
    traces = [comparison.latest_evaluation(folder).traces for folder in (gone, cell(whole.output, "zest-dt"))]
    np.testing.assert_array_equal(traces[0]["qpos"], traces[1]["qpos"])
    assert kept.stat().st_mtime_ns == before


def test_a_deleted_evaluation_is_run_again_without_training(
    whole: Reproduced, again: Callable[[], dict[str, Any]], tmp_path: Path
) -> None:
    bc = cell(tmp_path / "copy", "bc")
    before = (bc / "meta.json").stat().st_mtime_ns
    shutil.rmtree(bc / "evaluations")
    result = again()
    assert result["n_cells_run"] == 1
    assert result["rows"] == whole.result["rows"]
    assert (bc / "meta.json").stat().st_mtime_ns == before


def test_another_evaluation_of_a_cell_does_not_slip_into_the_table(
    whole: Reproduced, again: Callable[[], dict[str, Any]], zest: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    zest("evaluate", cell(tmp_path / "copy", "bc"), "--n-episodes", "1", "--n-workers", "1", "--no-videos")
    result = again()
    assert result["n_cells_run"] == 0
    assert result["rows"] == whole.result["rows"]


def test_whatever_a_result_depends_on_makes_a_cell_of_its_own(whole: Reproduced, tmp_path: Path) -> None:
    source = whole.result["dataset"]["dataset"]
    goals = {"scene": next(name for name in data.list_datasets() if "-zest-" in name)}

    def cells(old: str = "", new: str = "") -> dict[str, str]:
        plan = reproduce.read_plan(write(tmp_path, RECIPE.replace(old, new)))
        planned = reproduce.plan_cells(plan, source, goals, whole.output)
        return {each.method: each.run.name for each in planned}

    first = cells()
    assert all((whole.output / "cells" / name).is_dir() for name in first.values())
    assert cells("A tiny", "Another") == first
    for old, new in (("n_updates = 20", "n_updates = 21"), ("n_episodes = 2", "n_episodes = 3")):
        assert not set(cells(old, new).values()) & set(first.values())
    longer = cells("context_len = 5", "context_len = 6")
    assert longer["BC"] == first["BC"]
    assert longer["ZeST+DT"] != first["ZeST+DT"]


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("[evaluate]", "[evalute]", "unknown key 'evalute'; did you mean 'evaluate'"),
        ('title = "A tiny comparison"', "", "'title' is required"),
        ("seeds = [0]", 'seeds = ["0"]', "'seeds' must be a list of an integer, got ['0']"),
        ("seeds = [0]", "seeds = [0, 0]", "seeds must be at least 1 number, all different"),
        ("[relabel]", "[relabel.all]", "[goals.'scene']: unknown key 'all'"),
        ("[methods.BC]", "[methods]", "'methods' must be a table of tables"),
        ("noise_max = 1.0", "noise-maxx = 1.0", "[collect]: unknown key 'noise-maxx'; did you mean 'noise-max'"),
        ("n_updates = 20", 'n_updates = "many"', "'n_updates' must be an integer, got 'many'"),
        ("hidden_size = 32", "hidden_size = 0", "hidden_size must be at least 1, got 0"),
        ('agent = "bc"', "", "[methods.'BC']: 'agent' is required"),
        ('agent = "bc"', 'agent = "bcc"', "unknown agent 'bcc'; did you mean 'bc'"),
        ('kind = "control"', 'kind = "baseline"', "'kind' must be one of 'method', 'control', got 'baseline'"),
        ("context_len = 5", "contextlen = 5", "unknown key 'contextlen'; did you mean 'context-len'"),
        ("context_len = 5", 'dataset = "zest/x-v0"', "'dataset' is not for a recipe to set"),
        ('goal = "scene"\ncontext', 'goal = "sceen"\ncontext', "unknown goal 'sceen'; did you mean 'scene'"),
        ("n_episodes = 2", "n_episodes = 0", "n_episodes must be at least 1, got 0"),
        ("n_episodes = 2", 'rtg = "offline"', "'rtg' must be one of 'online', 'constant', 'schedule', got 'offline'"),
    ],
)
def test_a_bad_recipe_is_refused_before_anything_runs(
    old: str,
    new: str,
    complaint: str,
    refusal: Callable[..., tuple[int, str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "cache"))
    assert RECIPE.count(old) == 1
    recipe = write(tmp_path, RECIPE.replace(old, new))
    code, message = refusal("reproduce", recipe, "--output", tmp_path / "out")
    assert code == 2
    assert complaint in message
    assert str(recipe) in message
    assert list(tmp_path.iterdir()) == [recipe]


@pytest.mark.slow
def test_a_reproduction_killed_in_training_goes_on_and_ends_with_the_same_bits(
    places: Path, tmp_path: Path, zest: Callable[..., dict[str, Any]]
) -> None:
    recipe = write(tmp_path, RECIPE.replace("n_updates = 20", "n_updates = 600\ncheckpoint_every = 100"))
    cut = tmp_path / "cut"
    code = (
        "import sys; from zest_rl import cli, collect\n"
        "if __name__ == '__main__':\n"
        "    collect.N_REFERENCE, collect.N_NOTHING = 2, 1\n"
        "    sys.exit(cli.main(sys.argv[1:]))\n"
    )
    script = tmp_path / "script.py"
    script.write_text(code)
    words = ["reproduce", str(recipe), "--output", str(cut), "--n-workers", "2"]
    with subprocess.Popen([sys.executable, str(script), *words], stderr=subprocess.DEVNULL) as process:
        while not list(cut.glob("cells/zest-dt-*/checkpoints/update-*")):
            assert process.poll() is None, "it ended before it could be killed"
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
    assert not (cell(cut, "zest-dt") / "meta.json").exists()
    resumed = zest("reproduce", recipe, "--output", cut, "--n-workers", "1")
    whole = zest("reproduce", recipe, "--output", tmp_path / "whole", "--n-workers", "1")
    assert resumed["rows"] == whole["rows"]
    for method in ("bc", "zest-dt"):
        one, other = (cell(tmp_path / name, method) for name in ("cut", "whole"))
        assert (one / "model.safetensors").read_bytes() == (other / "model.safetensors").read_bytes()
        traces = [comparison.latest_evaluation(folder).traces for folder in (one, other)]
        np.testing.assert_array_equal(traces[0]["qpos"], traces[1]["qpos"])
