"""Runs and datasets of somebody else name programs, networks and files; nothing of it is used without a word."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from zest_rl import cli
from zest_rl.agents import load_policy
from zest_rl.agents.foreign import identify
from zest_rl.data.reader import dataset_path, open_dataset
from zest_rl.errors import BadInput
from zest_rl.evaluation.evaluate import EvaluationConfig, evaluate
from zest_rl.report.comparison_page import compare_runs
from zest_rl.report.sections import GOALS
from zest_rl.rewards.scorer import SCORER_FILE, Scorer
from zest_rl.runtime import artifacts

DOWNLOADED = EvaluationConfig(n_episodes=1, seed=3)
TRAIN = ("--hidden-size", "16", "--n-layers", "1", "--threads", "1", "--device", "cpu")
ZEROS = "import sys, json\nfor line in sys.stdin:\n    n = len(json.loads(line).get('obs', []))\n    "
ZEROS += "print(json.dumps({'ready': 1, 'actions': [[0] * 9] * n}), flush=True)\n"


def forget() -> None:
    """Be another machine."""
    shutil.rmtree(artifacts.cache_dir() / "trusted", ignore_errors=True)


def rename_embedder(path: Path, uri: str) -> None:
    """Let a scorer's file name another embedder."""
    from safetensors import safe_open

    with safe_open(path, "numpy") as file:
        described = json.loads(file.metadata()["scorer"])
    described["config"]["embedder"] = uri
    save_file(load_file(path), path, metadata={"scorer": json.dumps(described)})


@pytest.mark.parametrize("kind", ["command", "torchscript", "onnx", "d3rlpy", "package"])
def test_a_policy_of_somebody_else_runs_only_by_a_flag(kind: str, trained: Path, tmp_path: Path) -> None:
    run, ran = tmp_path / "downloaded", tmp_path / "ran"
    (run / "policy").mkdir(parents=True)
    (run / "policy" / "p").write_text("x")
    words = {"command": ["sh", "-c", f"touch {ran}\x1b[2K"], "package": ["rest"], "d3rlpy": ["sh", "policy/p"]}
    policy = {
        "family": "slow" if kind == "package" else kind,
        "words": words.get(kind, ["policy/p"]),
        "files": {"policy/p": artifacts.hash_file(run / "policy" / "p")},
        "code": "slow:Slower 1.0" if kind == "package" else "",
    }
    meta = artifacts.read_json(trained / "bc-0" / "meta.json") | {"agent": "foreign", "name": "p", "policy": policy}
    artifacts.write_json(run / "meta.json", meta)
    with pytest.raises(BadInput, match="add --trust") as refused:
        evaluate(run, DOWNLOADED, n_workers=1)
    shown = {"command": f"touch {ran}\\x1b[2K", "package": "slow:Slower 1.0 with 'rest'", "d3rlpy": "sh policy/p"}
    assert shown.get(kind, f"policy/p ({kind})") in str(refused.value)
    assert not ran.exists()


def test_an_adopted_policy_runs_and_the_same_one_needs_a_word_on_another_machine(
    adopt: Callable[..., Path], server: Callable[[str], str], capsys: pytest.CaptureFixture[str]
) -> None:
    run = adopt(server(ZEROS))
    words = ["evaluate", str(run), "--n-episodes", "1", "--no-videos", "--n-workers", "1"]
    assert cli.main(words) == 0
    forget()
    assert cli.main([*words, "--seed", "5"]) == 2
    said = capsys.readouterr().err
    assert "runs the program" in said
    assert "server.py" in said
    assert cli.main([*words, "--seed", "5", "--trust"]) == 0
    assert cli.main([*words, "--seed", "6"]) == 0, "the word is remembered"
    assert load_policy(run).agent == "foreign"


def test_adopting_the_same_policy_again_is_a_word_too(adopt: Callable[..., Path], server: Callable[[str], str]) -> None:
    spec = server(ZEROS)
    run = adopt(spec, "--name", "zeros")
    forget()
    with pytest.raises(BadInput, match="add --trust"):
        load_policy(run)
    shutil.rmtree(run)
    load_policy(adopt(spec, "--name", "zeros"))


@pytest.mark.parametrize(
    "uri", ["slow:rest", "timm:resnet18@/dev/zero", "open_clip:ViT-B-32/openai", "moco:/etc/passwd"]
)
def test_an_embedder_that_a_dataset_names_is_loaded_only_by_a_flag(
    uri: str, trained: Path, zest: Callable[..., dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset = artifacts.read_json(trained / "bc-0" / "meta.json")["dataset"]["id"]
    rename_embedder(dataset_path(dataset) / SCORER_FILE, uri)
    (dataset_path(dataset) / "zest_manifest.json").unlink()  # whoever changes a file can write another
    rename_embedder(trained / "dt-0" / SCORER_FILE, uri)
    assert cli.main(["inspect", dataset, "--output", str(tmp_path / "page.html"), "--n-workers", "1"]) == 0
    warned = capsys.readouterr().err
    assert f"would load the embedder {uri}. You did not name this embedder" in warned
    with pytest.raises(BadInput, match=r"would load the embedder .* add --trust"):
        evaluate(trained / "dt-0", DOWNLOADED, n_workers=1)
    with pytest.raises(BadInput, match=r"would load the embedder .* add --trust"):
        Scorer.load(trained / "dt-0" / SCORER_FILE)
    evaluate(trained / "bc-0", DOWNLOADED, n_workers=1)
    with pytest.raises(BadInput, match=r"would load the embedder .* add --trust"):
        compare_runs([trained / "bc-0"], title="t")


def test_a_dataset_that_was_relabeled_here_needs_no_flag_and_a_copy_of_it_elsewhere_does(
    trained: Path, collected_root: Path, zest: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    import timm
    import torch

    weights = tmp_path / "w.pth"
    torch.save(timm.create_model("resnet10t").state_dict(), weights)
    uri = f"timm:resnet10t@{weights}"
    source = artifacts.read_json(trained / "gt-0" / "meta.json")["dataset"]["id"]
    flags = ("--views", "1", "--tolerance", "0.5", "--n-workers", "1")
    dataset = zest("relabel", source, "--embedder", uri, *flags)["dataset"]
    path = dataset_path(dataset) / SCORER_FILE
    assert Scorer.load(path).config.embedder == uri
    with open_dataset(dataset) as ds:
        assert ds.metadata["description"].endswith("by timm:resnet10t@…/w.pth.")
    forget()
    with pytest.raises(BadInput, match="add --trust"):
        Scorer.load(path)
    zest("inspect", dataset, "--trust", "--output", tmp_path / "page.html", "--n-workers", "1")
    assert np.isfinite(Scorer.load(path).goals).all()
    run = zest("train", "dt", dataset, "--n-updates", "1", "--run-dir", tmp_path / "run", *TRAIN)["run"]
    asked = ("--n-episodes", "1", "--no-videos", "--n-workers", "1")
    forget()
    assert cli.main(["evaluate", run, *asked]) == 2
    zest("evaluate", run, *asked, "--trust")
    forget()
    assert cli.main(["report", run, "--output", str(tmp_path / "report.html")]) == 2
    zest("report", run, "--output", tmp_path / "report.html", "--trust")
    assert Scorer.load(path).config.embedder == uri, "the word is remembered"


def test_a_report_needs_no_scorer_but_the_one_that_it_loads(trained: Path) -> None:
    meta = artifacts.read_json(trained / "dt-0" / "meta.json")
    first = meta["dataset"]["id"]
    other = first.replace("-v0", "-v1")
    shutil.copytree(dataset_path(first), dataset_path(other))
    (dataset_path(other) / SCORER_FILE).unlink()
    (dataset_path(other) / "zest_manifest.json").unlink()
    artifacts.write_json(trained / "dt-0" / "meta.json", meta | {"dataset": meta["dataset"] | {"id": other}})
    for run in ("bc-0", "dt-0"):
        evaluate(trained / run, DOWNLOADED, n_workers=1)
    for trust in (False, True):
        assert len(compare_runs([trained / "bc-0", trained / "dt-0"], title="t", trust=trust).items(GOALS)) == 2


def test_passwords_and_folders_of_a_command_are_in_the_run_alone(
    adopt: Callable[..., Path], server: Callable[[str], str], trained: Path, tmp_path: Path
) -> None:
    from zest_rl.report.html import write_report

    spec = f"{server(ZEROS)} --password=hunter2 --token abcdef"
    run = adopt(spec)
    assert "hunter2" in (run / "meta.json").read_text(), "which must be able to run it"
    evaluate(run, DOWNLOADED, n_workers=1, videos=True)
    page = write_report(compare_runs([run], title="t"), tmp_path / "page.html").read_text()
    for secret in ("hunter2", "abcdef", str(tmp_path)):
        assert secret not in page
    assert "server.py" in page
    assert identify(spec).words[-1] == "abcdef"
