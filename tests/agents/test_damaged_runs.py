"""Run folders of somebody else: read or refused, whatever their files hold."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from fuzzing import damaged_bytes, damaged_json, faults, outcome, outcomes

from zest_rl.agents import AGENTS, load_policy
from zest_rl.errors import BadInput
from zest_rl.evaluation.evaluate import EvaluationConfig, evaluate, read_evaluation
from zest_rl.report.comparison_page import learning_curve
from zest_rl.report.methods import methods_of_runs
from zest_rl.rewards.scorer import SCORER_FILE, check_scorer
from zest_rl.runtime import artifacts
from zest_rl.runtime.artifacts import hash_json
from zest_rl.training.checkpoints import TrainState, resume, save_checkpoint
from zest_rl.training.log import MetricsLog


def damages(whole: Any, n: int, rng: random.Random) -> list[Any]:
    return [damaged_json(whole, rng) for _ in range(n)]


COUNTS = [60, pytest.param(1500, marks=pytest.mark.slow)]


def check_reader(what: str, read: Callable[[int], Any], n_inputs: int) -> None:
    """Read the whole input, number 0, and the damaged ones after it, which are read or refused."""
    first, *others = outcomes(read, n_inputs)
    assert first.kind == "read", first.detail
    counts, bad = faults(others)
    print(what, len(others), dict(counts))
    assert not bad, bad[0].detail


@pytest.mark.parametrize("n", COUNTS)
@pytest.mark.parametrize("run", ["bc-0", "dt-0", "adopted"])
def test_a_damaged_description_of_a_run_is_read_or_refused(run: str, n: int, trained: Path) -> None:
    folder, rng = trained / run, random.Random(0)
    if run == "adopted":
        meta, file = artifacts.read_json(trained / "bc-0" / "meta.json"), folder / "policy" / "p"
        artifacts.write_bytes(file, b"x")
        files = {"policy/p": artifacts.hash_file(file)}
        policy = {"family": "command", "words": ["sh", "-c", "x"], "files": files, "code": ""}
        artifacts.write_json(folder / "meta.json", meta | {"agent": "foreign", "name": "p", "policy": policy})
    whole = artifacts.read_json(folder / "meta.json")
    damaged = [json.dumps(value).encode() for value in (whole, *(damaged_json(whole, rng) for _ in range(n)))]
    damaged += [damaged_bytes(json.dumps(whole).encode(), rng) for _ in range(n)]

    def read(i: int) -> str:
        (folder / "meta.json").write_bytes(damaged[i])
        methods_of_runs([folder])
        return load_policy(folder, trust=True).agent

    check_reader(f"{run} meta.json", read, len(damaged))


@pytest.mark.parametrize("n", COUNTS)
def test_damaged_weights_of_a_run_are_refused_even_under_their_own_hash(n: int, trained: Path) -> None:
    folder, rng = trained / "bc-0", random.Random(0)
    whole, meta = (folder / "model.safetensors").read_bytes(), artifacts.read_json(folder / "meta.json")
    damaged = [whole, *(damaged_bytes(whole[:4096], rng) + whole[4096:] for _ in range(n))]

    def read(i: int) -> str:
        (folder / "model.safetensors").write_bytes(damaged[i])
        artifacts.write_json(folder / "meta.json", meta | {"model_sha256": artifacts.hash_bytes(damaged[i])})
        return load_policy(folder).agent

    check_reader("model.safetensors", read, n + 1)


@pytest.mark.parametrize("n", COUNTS)
def test_a_damaged_scorer_is_read_or_refused(n: int, trained: Path) -> None:
    path, rng = trained / "dt-0" / SCORER_FILE, random.Random(0)
    from safetensors import safe_open
    from safetensors.numpy import load_file, save

    with safe_open(path, "numpy") as file:
        described = json.loads(file.metadata()["scorer"])
    whole, arrays = path.read_bytes(), load_file(path)
    damaged = [whole, *(damaged_bytes(whole[:2048], rng) + whole[2048:] for _ in range(n))]
    damaged += [save(arrays, {"scorer": json.dumps(damaged_json(described, rng))}) for _ in range(n)]

    def read(i: int) -> None:
        path.write_bytes(damaged[i])
        check_scorer(path)

    check_reader("scorer", read, len(damaged))


@pytest.mark.parametrize("n", COUNTS)
def test_a_damaged_environment_of_a_run_is_evaluated_or_refused(n: int, trained: Path) -> None:
    path, rng = trained / "bc-0" / "meta.json", random.Random(0)
    meta = artifacts.read_json(path)
    spec = json.loads(meta["dataset"]["env_spec"]) | {"max_episode_steps": 1}
    damaged = [meta["dataset"] | {"env_spec": json.dumps(value)} for value in (spec, *damages(spec, n, rng))]
    references = {"ref_min_score": 0.0, "ref_max_score": 70.0}
    values = filter(lambda value: isinstance(value, dict), damages(references, n // 4, rng))
    damaged += [meta["dataset"] | {"env_spec": json.dumps(spec)} | value for value in values]

    def read(i: int) -> str:
        path.write_text(json.dumps(meta | {"dataset": damaged[i]}))
        return hash_json(evaluate(path.parent, EvaluationConfig(n_episodes=1, seed=i), n_workers=1).summary())

    check_reader("environment", read, len(damaged))


@pytest.mark.parametrize("n", COUNTS)
def test_a_damaged_result_of_an_evaluation_is_read_or_refused(n: int, trained: Path) -> None:
    folder = evaluate(trained / "bc-0", EvaluationConfig(n_episodes=2, seed=3), n_workers=1).folder
    whole, rng = artifacts.read_json(folder / "result.json"), random.Random(0)
    damaged = [whole, *(damaged_json(whole, rng) for _ in range(n))]

    def read(i: int) -> str:
        (folder / "result.json").write_text(json.dumps(damaged[i]))
        return hash_json(read_evaluation(folder).summary())

    check_reader("result.json", read, n + 1)


@pytest.mark.parametrize("n", COUNTS)
def test_a_damaged_log_of_a_training_is_read_or_refused(n: int, trained: Path) -> None:
    path, rng = trained / "bc-0" / "metrics.csv", random.Random(0)
    (method,) = methods_of_runs([trained / "bc-0"])
    whole = path.read_bytes()
    damaged = [whole, b"update,loss\n\xff,1\n", *(damaged_bytes(whole, rng) for _ in range(n))]

    def read(i: int) -> None:
        path.write_bytes(damaged[i])
        learning_curve(method)
        with MetricsLog(path.parent, 20):
            pass

    check_reader("metrics.csv", read, len(damaged))


@pytest.mark.parametrize("n", COUNTS)
def test_a_damaged_checkpoint_of_a_training_is_read_or_refused_even_under_its_own_manifest(
    n: int, tmp_path: Path
) -> None:
    def state() -> TrainState:
        torch.manual_seed(0)
        return TrainState.start(torch.nn.Linear(3, 2), 0.0, 0)

    first = state()
    first.model(torch.ones(1, 3)).sum().backward()
    first.optimizer.step()
    save_checkpoint(tmp_path, first)
    (folder,) = (tmp_path / "checkpoints").iterdir()
    whole = {path.name: path.read_bytes() for path in folder.iterdir() if path.name != "manifest.json"}
    progress, rng = json.loads(whole["state.json"]), random.Random(0)
    manifest = {name: artifacts.hash_bytes(content) for name, content in whole.items()}
    damaged = [("state.json", whole["state.json"])]
    for _ in range(n):
        name = rng.choice(sorted(whole))
        damaged.append((name, damaged_bytes(whole[name], rng)))
        damaged.append(("state.json", json.dumps(damaged_json(progress, rng)).encode()))
        damaged.append(("manifest.json", json.dumps(damaged_json(manifest, rng)).encode()))

    def read(i: int) -> int:
        files = whole | dict([damaged[i]])
        hashes = {name: artifacts.hash_bytes(files[name]) for name in whole}
        for name, content in ({"manifest.json": json.dumps(hashes).encode()} | files).items():
            (folder / name).write_bytes(content)
        restored = state()
        resume(tmp_path, restored)
        return restored.update

    honest, *others = outcomes(read, len(damaged))
    counts, bad = faults(others)
    print("checkpoint", len(others), dict(counts))
    assert honest.kind == "read", honest.detail
    assert not bad, bad[0].detail


@pytest.mark.parametrize(
    ("run", "changes"),
    [
        ("bc-0", {"hidden_size": 10**9}),
        ("bc-0", {"n_layers": 10**9}),
        ("dt-0", {"context_len": 10**9}),
        ("dt-0", {"n_layers": 500, "hidden_size": 2**14}),
        ("bc-0", {"hidden_size": 16000}),
        ("bc-0", {"n_networks": 10**9}),
        ("bc-0", {"n_networks": 100, "hidden_size": 2**12}),
    ],
)
def test_a_run_that_asks_for_absurd_room_is_refused_before_it_is_made(
    run: str, changes: dict[str, int], trained: Path
) -> None:
    path = trained / run / "meta.json"
    meta = artifacts.read_json(path)
    artifacts.write_json(path, meta | {"config": meta["config"] | changes})
    end = outcome(lambda: load_policy(trained / run))
    assert end.kind == "refused", end.detail
    artifacts.write_json(path, meta | {"max_steps": 10**9})
    assert outcome(lambda: load_policy(trained / run)).kind == ("read" if run == "bc-0" else "refused")


@pytest.mark.parametrize(
    ("device", "message"),
    [("nonsense", "unknown device 'nonsense'"), ("cuda:77", "torch finds no device 'cuda:77'"), ("", "unknown device")],
)
def test_a_device_that_is_not_there_is_refused_before_the_run_is_read(device: str, message: str, trained: Path) -> None:
    with pytest.raises(BadInput, match=message):
        load_policy(trained / "bc-0", device)
    assert load_policy(trained / "bc-0", "auto").agent == "bc"


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("CUDA out of memory")])
def test_too_little_memory_is_no_damage_of_a_run(
    error: Exception, trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def build(*_: object) -> None:
        raise error

    monkeypatch.setitem(AGENTS, "bc", replace(AGENTS["bc"], build=build))
    with pytest.raises(type(error)):
        load_policy(trained / "bc-0")
