"""`zest reproduce`, which joins all verbs."""

from __future__ import annotations

import json
import runpy
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
import torch
from PIL import Image
from read_dataset import read
from tiny_comparison import RECIPE, write

from zest_rl import cli
from zest_rl.cli import reproduce
from zest_rl.cli.reproduce import code
from zest_rl.cli.reproduce.cells import TaskDatasets, make_cells
from zest_rl.cli.reproduce.comparison import read_comparison
from zest_rl.data import reader
from zest_rl.errors import BadInput
from zest_rl.kitchen import calibration
from zest_rl.report import methods
from zest_rl.runtime import artifacts

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Reproduced:
    recipe: Path
    output: Path
    result: dict[str, Any]


@pytest.fixture(scope="module")
def places(short_videos: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """An empty Minari root and an empty cache; the expert is measured on few episodes."""
    folder = tmp_path_factory.mktemp("reproduce")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
        patch.setenv("ZEST_CACHE", str(folder / "cache"))
        patch.setattr(calibration, "N_REFERENCE", 2)
        patch.setattr(calibration, "N_NOTHING", 1)
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


def cell(output: Path, agent: str) -> Path:
    (folder,) = (output / "cells").glob(f"micro-{agent}-scene-seed0-*")
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
    assert reader.exists("zest/kitchen-micro-whole-v0")
    assert any("-zest-" in name for name in reader.list_datasets())
    evaluated = artifacts.read_json(next(cell(whole.output, "dt").glob("evaluations/*/result.json")))
    value = evaluated["summary"]["normalized_return"]["value"]
    assert whole.result["rows"]["ZeST+DT"]["normalized_return"] == value
    written = artifacts.read_json(whole.output / "result.json")
    assert written == json.loads(json.dumps({key: whole.result[key] for key in written}))
    assert [name.rpartition("-")[0] for name in written["seconds_by_cell"]] == [
        cell(whole.output, agent).name for agent in ("bc", "dt")
    ]
    kinds = {"train_seconds", "evaluate_seconds"}
    assert all(
        seconds.keys() == kinds and min(seconds.values()) >= 0 for seconds in written["seconds_by_cell"].values()
    )
    assert written["tasks"]["micro"]["rows"] == written["rows"]
    table = (whole.output / "table.md").read_text().splitlines()
    assert table[0] == "| | % of the expert | 95 % interval | success | paper |"
    assert table[4].startswith(f"| ZeST+DT | {value:.2f} | ")
    html = (whole.output / "report.html").read_text()
    assert all(part in html for part in ("A tiny comparison", "ZeST+DT", "Tiny.", "same-scene"))
    assert artifacts.read_json(cell(whole.output, "dt") / "meta.json")["config"]["context_len"] == 5
    assert len(list(cell(whole.output, "dt").glob("snapshots/update-000000010/evaluations/*/result.json"))) == 1
    assert "normalized return, %" in html, "the learning curve"


def test_the_table_as_text_shows_every_row_and_goal(whole: Reproduced) -> None:
    lines = reproduce.summary(whole.result).splitlines()
    assert [line.split()[0] for line in lines[1:4]] == ["Demo", "BC", "ZeST+DT"]
    assert "80.67" in lines[2]
    assert lines[4].startswith("micro, goal scene: Spearman ρ of ZeST and true returns ")
    of_task = {**whole.result["tasks"]["micro"], "spearman_of_zest_and_true_returns": {"scene": None}}
    undefined = reproduce.summary({**whole.result, "tasks": {"micro": of_task}})
    assert "true returns undefined" in undefined


def test_the_moving_picture_shows_every_step_of_the_episode_that_scored_highest(
    whole: Reproduced, tmp_path: Path
) -> None:
    hero = runpy.run_path(str(ROOT / "docs" / "hero.py"))
    evaluation, index = hero["scored_highest"](whole.output)
    hero["main"](whole.output, tmp_path / "hero.webp")
    with Image.open(tmp_path / "hero.webp") as picture:
        assert (picture.n_frames, picture.size) == (len(evaluation.traces["qpos"][index]), hero["SIZE"])
        first = np.asarray(picture.convert("RGB"), int)
        picture.seek(picture.n_frames - 1)
        assert (np.asarray(picture.convert("RGB"), int) != first).mean() > 0.01
    (tmp_path / "none").mkdir()
    with pytest.raises(BadInput, match="holds no evaluation of a policy that is asked for returns"):
        hero["main"](tmp_path / "none", tmp_path / "hero.webp")


def test_a_second_run_finds_everything_done_and_says_so(
    whole: Reproduced, again: Callable[[], dict[str, Any]], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    result = again()
    assert result["n_cells_run"] == 0
    assert result["rows"] == whole.result["rows"]
    assert result["seconds_by_stage"] == whole.result["seconds_by_stage"], "of the commands that had work to do"
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
    gone = cell(tmp_path / "copy", "dt")
    weights = (gone / "model.safetensors").read_bytes()
    shutil.rmtree(gone)
    result = again()
    assert result["n_cells_run"] == 1
    assert result["rows"] == whole.result["rows"]
    assert (gone / "model.safetensors").read_bytes() == weights
    traces = [methods.latest_evaluation(folder).traces for folder in (gone, cell(whole.output, "dt"))]
    np.testing.assert_array_equal(traces[0]["qpos"], traces[1]["qpos"])
    assert kept.stat().st_mtime_ns == before
    first, sums = whole.result["seconds_by_stage"], result["seconds_by_stage"]
    assert list(first) == list(sums) == ["collect", "relabel", "train and evaluate", "report"]
    assert all(sums[stage] > first[stage] > 0 for stage in ("train and evaluate", "report"))


def test_a_deleted_evaluation_of_a_snapshot_is_run_again(again: Callable[[], dict[str, Any]], tmp_path: Path) -> None:
    (snapshot,) = cell(tmp_path / "copy", "dt").glob("snapshots/update-*")
    shutil.rmtree(snapshot / "evaluations")
    assert again()["n_cells_run"] == 1
    assert len(list(snapshot.glob("evaluations/*/result.json"))) == 1


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
    source = whole.result["tasks"]["micro"]["dataset"]["dataset"]
    goals = {"scene": next(name for name in reader.list_datasets() if "-zest-" in name)}

    def cells(old: str = "", new: str = "") -> dict[str, str]:
        comparison = read_comparison(write(tmp_path, RECIPE.replace(old, new)))
        made = make_cells(comparison, {"micro": TaskDatasets(source, goals)}, whole.output)
        return {each.method: each.run.name for each in made}

    first = cells()
    assert all((whole.output / "cells" / name).is_dir() for name in first.values())
    assert cells("A tiny", "Another") == first
    assert cells("n_episodes = 2", "n_episodes = 3") == first, "another evaluation is no other training"
    assert not set(cells("n_updates = 20", "n_updates = 21").values()) & set(first.values())
    longer = cells("context_len = 5", "context_len = 6")
    assert longer["BC"] == first["BC"]
    assert longer["ZeST+DT"] != first["ZeST+DT"]


def test_the_flags_of_a_method_win_over_those_of_its_agent_and_these_over_the_shared(
    whole: Reproduced, tmp_path: Path
) -> None:
    text = RECIPE.replace("seeds = [0]", "seeds = [3, 1]").replace("context_len = 5", "context_len = 5\nn_updates = 21")
    text += '\n[methods."short DT"]\nagent = "dt"\ngoal = "scene"\nn_updates = 22\n'
    source = whole.result["tasks"]["micro"]["dataset"]["dataset"]
    goals = {"scene": next(name for name in reader.list_datasets() if "-zest-" in name)}
    comparison = read_comparison(write(tmp_path, text))
    made = make_cells(comparison, {"micro": TaskDatasets(source, goals)}, whole.output)
    assert [(each.train["seed"], each.method, each.train["n_updates"]) for each in made] == [
        (3, "BC", 20), (3, "ZeST+DT", 21), (3, "short DT", 22), (1, "BC", 20), (1, "ZeST+DT", 21), (1, "short DT", 22),
    ], "all of the first seed come first"  # fmt: skip


def test_a_method_may_have_fewer_seeds_than_the_others(
    whole: Reproduced, tmp_path: Path, zest: Callable[..., dict[str, Any]]
) -> None:
    text = RECIPE.replace("seeds = [0]", "seeds = [0, 1]").replace('"bc"', '"bc"\nseeds = [0]')
    copy = shutil.copytree(whole.output, tmp_path / "copy")
    result = zest("reproduce", write(tmp_path, text), "--output", copy, "--n-workers", "1")
    assert result["n_cells_run"] == 1, "the other two are done"
    seeds_and_episodes = {name: (row["n_seeds"], row["n_episodes"]) for name, row in result["rows"].items()}
    assert seeds_and_episodes == {"Demo": (1, 4), "BC": (1, 2), "ZeST+DT": (2, 4)}
    assert result["rows"]["BC"] == whole.result["rows"]["BC"]
    header, _, demo, bc, dt = (copy / "table.md").read_text().splitlines()
    assert header == "| | % of the expert | 95 % interval | success | seeds | paper |"
    assert [line.split(" | ")[4] for line in (demo, bc, dt)] == ["–", "1", "2"]


OLD = {"agents/dt.py": "0" * 64, "agents/gone.py": "0" * 64}
"""Hashes of files at another time."""


def of_other_code(output: Path, agent: str) -> Path:
    """Make a finished cell one of different code, of another revision."""
    run = cell(output, agent)
    (evaluated,) = (output / "code").glob(f"{run.name}-*.json")
    for path in (output / "code" / f"{run.name}.json", evaluated):
        files = artifacts.read_json(path)[0]["files"]
        artifacts.write_json(path, [{"files": {**files, **OLD}, "git_revision": "abc"}])
    return run


def test_results_of_one_code_name_it(whole: Reproduced) -> None:
    made = artifacts.read_json(whole.output / "result.json")["code"]
    now = code.code_now()
    assert {"types.py", "agents/dt.py", "training/loop.py", "kitchen/env.py"} <= now.files.keys()
    assert not [path for path in now.files if path.startswith(("cli", "report", "analysis", "export"))]
    about_now = {"source_sha256": now.sha256, "git_revision": now.git_revision}
    revisions = [now.git_revision] if now.git_revision else []
    by_now = {"source_sha256": now.sha256, "git_revisions": revisions, "n_cells": 2, "changed_files": []}
    assert made == {**about_now, "made_by": [by_now], "outdated_cells": []}
    assert "made by different code" not in (whole.output / "report.html").read_text()


def test_cells_of_different_code_are_used_named_and_run_again_if_that_is_asked(
    whole: Reproduced,
    tmp_path: Path,
    zest: Callable[..., dict[str, Any]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    copy = shutil.copytree(whole.output, tmp_path / "copy")
    run = of_other_code(copy, "dt")
    words = ["reproduce", str(whole.recipe), "--output", str(copy), "--n-workers", "1"]
    result = zest(*words)
    assert (result["n_cells_run"], result["rows"]) == (0, whole.result["rows"])
    (outdated,) = result["code"]["outdated_cells"]
    assert outdated.startswith(run.name)
    first, other = result["code"]["made_by"]
    assert (first["n_cells"], other["n_cells"], other["git_revisions"]) == (1, 1, ["abc"])
    assert other["changed_files"] == ["agents/dt.py", "agents/gone.py"]
    told = (
        "Of 2 cells 1 were made by different code (changed since: agents/dt.py, agents/gone.py): "
        f"{outdated}. The same command with --rerun-outdated deletes them and runs them again."
    )
    assert told in (copy / "report.html").read_text()
    cli.main(words)
    assert told in capsys.readouterr().err.replace("\n", " ")
    policy, kept = (cell(copy, agent) / "meta.json" for agent in ("dt", "bc"))
    before = policy.stat().st_mtime_ns, kept.stat().st_mtime_ns
    again = zest(*words, "--rerun-outdated")
    assert (again["n_cells_run"], again["rows"], again["code"]) == (1, whole.result["rows"], whole.result["code"])
    assert policy.stat().st_mtime_ns > before[0]
    assert kept.stat().st_mtime_ns == before[1]
    assert zest(*words, "--rerun-outdated")["n_cells_run"] == 0


@pytest.mark.parametrize("name", ["multistep", "figures", "goal_count"])
def test_what_has_no_cells_cannot_rerun_outdated_ones(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["reproduce", name, "--rerun-outdated"]) == 2
    assert "--rerun-outdated is for recipes that compare methods, got" in capsys.readouterr().err


def test_a_training_that_other_code_began_counts_for_both(
    whole: Reproduced, again: Callable[[], dict[str, Any]], tmp_path: Path
) -> None:
    run = of_other_code(tmp_path / "copy", "dt")
    (run / "meta.json").unlink()
    result = again()
    assert result["n_cells_run"] == 1
    assert [made["n_cells"] for made in result["code"]["made_by"]] == [2, 1]
    assert [name.rpartition("-")[0] for name in result["code"]["outdated_cells"]] == [run.name]


def test_cells_of_versions_that_recorded_no_code_are_told_with_the_revision_of_their_policies(
    whole: Reproduced, again: Callable[[], dict[str, Any]], tmp_path: Path
) -> None:
    shutil.rmtree(tmp_path / "copy" / "code")
    made = again()["code"]
    revision = artifacts.read_json(cell(whole.output, "dt") / "meta.json")["made_by"]["git_revision"]
    revisions = [revision] if revision else []
    assert made["made_by"] == [{"source_sha256": None, "git_revisions": revisions, "n_cells": 2, "changed_files": None}]
    assert len(made["outdated_cells"]) == 2
    assert "a version that did not record it" in (tmp_path / "copy" / "report.html").read_text()


def test_a_policy_that_was_trained_elsewhere_is_a_method_like_the_others(
    whole: Reproduced,
    refusal: Callable[..., tuple[int, str]],
    tmp_path: Path,
) -> None:
    policy = tmp_path / "{task}-{seed}.pt"
    text = f'\n[methods.Theirs]\npolicy = "torchscript:{policy}"\ngoal = "scene"\nkind = "control"\n'
    recipe = write(tmp_path, RECIPE + text)
    output = shutil.copytree(whole.output, tmp_path / "other")
    code, message = refusal("reproduce", recipe, "--output", output, "--n-workers", "1")
    assert code == 2
    goal = next(name for name in reader.list_datasets() if "-zest-" in name)
    assert "policies from elsewhere are missing; train them, then go on:\n" in message
    assert f"'Theirs', trained on {goal} with seed 0: there is no file {tmp_path / 'micro-0.pt'}" in message
    torch.jit.trace(torch.nn.Linear(59, 9), torch.zeros(1, 59)).save(str(tmp_path / "micro-0.pt"))
    first = reproduce.reproduce(recipe, output, n_workers=1)
    assert first["n_cells_run"] == 1
    assert {name: row for name, row in first["rows"].items() if name != "Theirs"} == whole.result["rows"]
    row = first["rows"]["Theirs"]
    (run,) = (output / "cells").glob("micro-foreign-scene-seed0-*")
    assert artifacts.read_json(run / "meta.json")["name"] == "Theirs"
    assert (row["kind"], row["n_seeds"], row["n_episodes"]) == ("control", 1, 2)
    assert reproduce.reproduce(recipe, output, n_workers=1)["n_cells_run"] == 0
    torch.jit.trace(torch.nn.Linear(59, 9), torch.zeros(1, 59)).save(str(tmp_path / "micro-0.pt"))
    assert reproduce.reproduce(recipe, output, n_workers=1)["n_cells_run"] == 1, "another file is another policy"
    assert len(list((output / "cells").glob("micro-foreign-scene-seed0-*"))) == 2


def test_several_tasks_make_a_page_each_and_one_over_all_and_share_what_is_equal(
    whole: Reproduced, tmp_path: Path, zest: Callable[..., dict[str, Any]]
) -> None:
    text = RECIPE.replace('task = "micro"\n', "").replace("micro-whole", "{task}-whole")
    text = text.replace("[relabel]", "[tasks.micro]\n[tasks.sdoor]\nnoise_max = 1.5\n[relabel]")
    text += """
[methods."constant RTG"]
agent = "dt"
goal = "scene"
context_len = 5
kind = "control"
evaluate = {rtg = "constant"}
"""
    copy = shutil.copytree(whole.output, tmp_path / "copy")
    result = zest("reproduce", write(tmp_path, text), "--output", copy, "--n-workers", "1")
    assert result["n_cells_run"] == 4, "two on micro are done"
    assert len(list((copy / "cells").glob("[!.]*"))) == 4, "two methods share a policy"
    assert result["tasks"]["micro"]["rows"]["ZeST+DT"] == whole.result["rows"]["ZeST+DT"]
    assert result["tasks"]["sdoor"]["dataset"]["noise_max"] == 1.5
    for name, row in result["rows"].items():
        of_tasks = [result["tasks"][task]["rows"][name] for task in ("micro", "sdoor")]
        assert row["normalized_return"] == pytest.approx(np.mean([of["normalized_return"] for of in of_tasks]))
        assert row["n_episodes"] == sum(of["n_episodes"] for of in of_tasks)
    assert (
        (copy / "table.md")
        .read_text()
        .startswith("| | % of the expert | 95 % interval | success | micro | sdoor | paper |")
    )
    overview = (copy / "report.html").read_text()
    assert all(
        part in overview for part in ('href="micro.html"', 'href="sdoor.html"', "sdoor: scene", "over 2 datasets")
    )
    assert "data:video/mp4" in (copy / "sdoor.html").read_text()
    lines = reproduce.summary(result).splitlines()
    assert sum(line.startswith("sdoor: Demo ") for line in lines) == 1


def test_a_recipe_without_methods_ends_with_what_its_rewards_are_worth(
    whole: Reproduced, tmp_path: Path, zest: Callable[..., dict[str, Any]], refusal: Callable[..., tuple[int, str]]
) -> None:
    without_methods = RECIPE[: RECIPE.index("[train]")]
    result = zest("reproduce", write(tmp_path, without_methods), "--output", tmp_path / "out", "--n-workers", "1")
    (dataset,) = result["datasets"]
    assert read(dataset, lambda ds: ds.metadata)["zest"]["relabel"]["source"] == "zest/kitchen-micro-whole-v0"
    assert "spearman" in next(iter(result["datasets"].values()))["figures"]
    assert json.loads((tmp_path / "out" / "result.json").read_text())["datasets"] == result["datasets"]
    assert "Views" in (tmp_path / "out" / "report.html").read_text()
    assert "Rank correlation with the true returns" in reproduce.summary(result)
    nothing = without_methods[: without_methods.index("[goals.scene]")]
    code, message = refusal("reproduce", write(tmp_path, nothing))
    assert (code, "at least 1 method, or 1 goal to inspect" in message) == (2, True)


@pytest.mark.slow
def test_a_reproduction_killed_in_training_goes_on_and_ends_with_the_same_bits(
    places: Path, tmp_path: Path, zest: Callable[..., dict[str, Any]]
) -> None:
    recipe = write(tmp_path, RECIPE.replace("n_updates = 20", "n_updates = 600\ncheckpoint_every = 100"))
    cut = tmp_path / "cut"
    code = (
        "import sys; from zest_rl import cli; from zest_rl.kitchen import calibration\n"
        "if __name__ == '__main__':\n"
        "    calibration.N_REFERENCE, calibration.N_NOTHING = 2, 1\n"
        "    sys.exit(cli.main(sys.argv[1:]))\n"
    )
    script = tmp_path / "script.py"
    script.write_text(code)
    words = ["reproduce", str(recipe), "--output", str(cut), "--n-workers", "2"]
    with subprocess.Popen([sys.executable, str(script), *words], stderr=subprocess.DEVNULL) as process:
        while not list(cut.glob("cells/micro-dt-*/checkpoints/update-*")):
            assert process.poll() is None, "it ended before it could be killed"
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
    assert not (cell(cut, "dt") / "meta.json").exists()
    resumed = zest("reproduce", recipe, "--output", cut, "--n-workers", "1")
    whole = zest("reproduce", recipe, "--output", tmp_path / "whole", "--n-workers", "1")
    assert resumed["rows"] == whole["rows"]
    for method in ("bc", "dt"):
        one, other = (cell(tmp_path / name, method) for name in ("cut", "whole"))
        assert (one / "model.safetensors").read_bytes() == (other / "model.safetensors").read_bytes()
        traces = [methods.latest_evaluation(folder).traces for folder in (one, other)]
        np.testing.assert_array_equal(traces[0]["qpos"], traces[1]["qpos"])
