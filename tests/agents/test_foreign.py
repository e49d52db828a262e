"""Policies that other programs trained: they act as they were trained to, are told apart, and fail with a word."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import safetensors.torch
import torch
from tiny_dataset import COLLECTED, SHORT_HORIZON
from torch import Tensor, nn

from zest_rl.agents import get_agent, load_policy
from zest_rl.agents.base import DataFacts, autocast
from zest_rl.agents.foreign import identify
from zest_rl.cli import evaluate as evaluate_verb
from zest_rl.cli.ui import SilentUi
from zest_rl.errors import BadInput, ZestError
from zest_rl.evaluation.evaluate import EPISODES_PER_JOB, Evaluation, EvaluationConfig, evaluate
from zest_rl.runtime import artifacts
from zest_rl.simulation import videos

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit:FutureWarning")  # d3rlpy writes TorchScript
DOCS = Path(__file__).resolve().parents[2] / "docs"
TWO = EvaluationConfig(n_episodes=2, seed=11)
Verb = Callable[..., dict[str, Any]]


class Whole(nn.Module):
    """The policy of a BC run from raw observations to actions, as another program would save it."""

    def __init__(self, run: Path) -> None:
        super().__init__()
        meta = artifacts.read_json(run / "meta.json")
        agent, facts = get_agent("bc"), DataFacts(**{field.name: meta[field.name] for field in fields(DataFacts)})
        self.net = agent.build(agent.config(**meta["config"]), facts).eval()
        self.net.load_state_dict(safetensors.torch.load_file(run / "model.safetensors"))
        self.mean, self.std = torch.tensor(facts.obs_mean), torch.tensor(facts.obs_std)
        self.precision = meta["precision"]

    def forward(self, obs: Tensor) -> Tensor:
        with autocast(self.precision, torch.device("cpu")):
            actions: Tensor = self.net(((obs - self.mean) / self.std).clip(-10, 10))
        return actions.float()


class TowardsZero(nn.Module):
    """What the server in docs/foreign_policies.md does."""

    def forward(self, obs: Tensor) -> Tensor:
        return -2 * obs[:, :9]


class Constant(nn.Module):
    def __init__(self, value: float) -> None:
        super().__init__()
        self.value = value

    def forward(self, obs: Tensor) -> Tensor:
        return torch.full_like(obs[:, :9], self.value)


def save(module: nn.Module, path: Path) -> str:
    """Trace a module on one observation, as d3rlpy does; return its spec."""
    with torch.no_grad():
        torch.jit.trace(module.eval(), torch.zeros(1, 59)).save(str(path))
    return f"torchscript:{path}"


def documented(language: str, holding: str) -> str:
    blocks = re.findall(rf"```{language}\n(.*?)```", (DOCS / "foreign_policies.md").read_text(), re.DOTALL)
    (block,) = (block for block in blocks if holding in block)
    return str(block)


def assert_same_episodes(one: Evaluation, other: Evaluation) -> None:
    np.testing.assert_array_equal(one.traces["qpos"], other.traces["qpos"])
    assert one.episodes == other.episodes


# --- they act as they were trained to -----------------------------------------------------------------------------


def test_a_traced_copy_of_a_policy_has_the_very_evaluation_of_the_policy(
    trained: Path, adopt: Callable[..., Path], tmp_path: Path
) -> None:
    config = EvaluationConfig(n_episodes=EPISODES_PER_JOB + 1, seed=5)
    run = adopt(save(Whole(trained / "bc-0"), tmp_path / "bc.pt"))
    mine = evaluate(trained / "bc-0", config, n_workers=1)
    theirs = evaluate(run, config, n_workers=2)
    assert_same_episodes(mine, theirs)
    assert theirs.summary() == mine.summary() | {"clipped_actions": 0.0}
    other = evaluate(trained / "bc-1", config, n_workers=1)
    assert not np.array_equal(other.traces["qpos"], mine.traces["qpos"]), (
        "any policy would do: this test could not fail"
    )


def test_the_documented_server_acts_as_the_same_policy_in_torchscript_to_the_bit(
    adopt: Callable[..., Path], server: Callable[[str], str], tmp_path: Path
) -> None:
    code = documented("python", "answers")
    assert len([line for line in code.splitlines() if line.strip()]) <= 10
    assert "zest" not in code
    config = EvaluationConfig(n_episodes=EPISODES_PER_JOB + 1, seed=5)
    served = evaluate(adopt(server(code)), config, n_workers=2)
    traced = evaluate(adopt(save(TowardsZero(), tmp_path / "zero.pt")), config, n_workers=1)
    assert_same_episodes(served, traced)
    np.testing.assert_array_equal(served.traces["clipped"], traced.traces["clipped"])


def test_actions_beyond_the_bounds_are_clipped_and_counted(
    adopt: Callable[..., Path], zest: Verb, tmp_path: Path
) -> None:
    far, edge = (adopt(save(Constant(value), tmp_path / f"{value}.pt")) for value in (7.0, 1.0))
    results = [evaluate(run, TWO, n_workers=1) for run in (far, edge)]
    assert_same_episodes(*results)
    assert [list(result.traces["clipped"]) for result in results] == [[SHORT_HORIZON] * 2, [0, 0]]
    words = ("--n-episodes", 2, "--seed", 11, "--n-workers", 1, "--no-videos")
    assert [zest("evaluate", run, *words)["clipped_actions"] for run in (far, edge)] == [1.0, 0.0]


def test_what_was_clipped_is_told_and_timed_before_videos_are_written(
    adopt: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []

    class Listener(SilentUi):
        def warn(self, text: str) -> None:
            told.append(text)

    def slow_videos(videos_to_write: Iterable[videos.Video], n_workers: int | None) -> None:
        told.append(f"{len(list(videos_to_write))} videos")
        time.sleep(1)

    monkeypatch.setattr(videos, "ensure_videos", slow_videos)
    run = adopt(save(Constant(7.0), tmp_path / "far.pt"))
    evaluate(run, TWO, n_workers=1)
    started = time.monotonic()
    result = evaluate_verb.run(evaluate_verb.Config(run, n_episodes=2, seed=11, n_workers=1), Listener())
    assert result["seconds"] <= time.monotonic() - started - 1 + 0.01, "rounded"
    assert told == ["100.0% of the actions left [-1, 1] and were clipped, as the environment does", "3 videos"]


def test_a_torchscript_module_with_a_memory_is_told_that_episodes_begin(
    adopt: Callable[..., Path], tmp_path: Path
) -> None:
    class Counter(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.steps = torch.full((1, 1), 1e6)

        def forward(self, obs: Tensor) -> Tensor:
            self.steps = self.steps + 1
            return self.steps.expand(-1, 9) / 100

        @torch.jit.export
        def begin(self, n_episodes: int) -> None:
            self.steps = torch.zeros(n_episodes, 1)

    torch.jit.script(Counter()).save(str(tmp_path / "counter.pt"))
    policy = load_policy(adopt(f"torchscript:{tmp_path / 'counter.pt'}"))
    obs = np.zeros((3, 59), np.float32)
    for _ in range(2):
        policy.begin(3)
        assert [float(policy.act(obs)[2, 0]) for _ in range(2)] == pytest.approx([0.01, 0.02])
        policy.end()


@pytest.mark.parametrize("batch", ["N", 1], ids=["any-batch", "one-at-a-time"])
def test_an_onnx_graph_acts_as_its_weights_say(batch: str | int, adopt: Callable[..., Path], tmp_path: Path) -> None:
    weight = np.random.default_rng(0).normal(0, 0.1, (59, 9)).astype(np.float32)
    tensor = onnx.helper.make_tensor_value_info
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node("MatMul", ["obs", "weight"], ["sum"]), onnx.helper.make_node("Tanh", ["sum"], ["act"])],
        "policy",
        [tensor("obs", onnx.TensorProto.FLOAT, [batch, 59])],
        [tensor("act", onnx.TensorProto.FLOAT, [batch, 9])],
        [onnx.numpy_helper.from_array(weight, "weight")],
    )
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, tmp_path / "p.onnx", save_as_external_data=True, location="p.onnx.data", size_threshold=0)
    run = adopt(f"onnx:{tmp_path / 'p.onnx'}")
    assert artifacts.read_json(run / "meta.json")["policy"]["files"].keys() == {"policy/p.onnx", "policy/p.onnx.data"}
    policy = load_policy(run)
    obs = np.random.default_rng(1).normal(size=(4, 59)).astype(np.float32)
    policy.begin(4)
    np.testing.assert_allclose(policy.act(obs), np.tanh(obs @ weight), atol=1e-6)


def test_d3rlpy_gives_the_same_episodes_from_its_own_python_and_as_torchscript(
    adopt: Callable[..., Path], zest: Verb, tmp_path: Path
) -> None:
    python = os.environ.get("ZEST_D3RLPY_PYTHON")
    if not python:
        pytest.skip("set ZEST_D3RLPY_PYTHON to a Python that has d3rlpy")
    zest("export", COLLECTED, "--output", tmp_path / "d.npz")
    train = [
        python,
        str(DOCS / "train_d3rlpy.py"),
        str(tmp_path / "d.npz"),
        "--n-steps",
        "3",
        "--output",
        str(tmp_path),
    ]
    subprocess.run(train, check=True)
    own = adopt(f"d3rlpy:{tmp_path / 'iql-seed0.d3'}", "--python", python)
    traced = adopt(f"torchscript:{tmp_path / 'iql-seed0.pt'}")
    results = [evaluate(run, TWO, n_workers=1) for run in (own, traced)]
    np.testing.assert_allclose(results[0].traces["qpos"], results[1].traces["qpos"], atol=1e-6)


# --- beside our own -----------------------------------------------------------------------------------------------


PLUGIN = """
import numpy as np

class Slower:
    def __init__(self, rest):
        self.speed = float(rest)
        self.left = None

    def begin(self, n_episodes):
        self.left = np.full((n_episodes, 1), self.speed)

    def __call__(self, obs):
        self.left = self.left * 0.9
        return -self.left * obs[:, :9]

def number(rest):
    return 1
"""


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A package beside this one that registers the policy ``slower:``; also for processes that are started."""
    site = tmp_path / "site"
    (site / "slow-1.5.dist-info").mkdir(parents=True)
    (site / "slow.py").write_text(PLUGIN)
    (site / "slow-1.5.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: slow\nVersion: 1.5\n")
    entry = "[zest_rl.policies]\nslower = slow:Slower\nnumber = slow:number\n"
    (site / "slow-1.5.dist-info" / "entry_points.txt").write_text(entry)
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.setenv("PYTHONPATH", str(site))


@pytest.mark.slow
@pytest.mark.usefixtures("plugin", "short_videos")
def test_a_registered_policy_works_in_every_verb_beside_ours(
    trained: Path, adopt: Callable[..., Path], zest: Verb, tmp_path: Path
) -> None:
    runs = [
        adopt("slower:1.5", "--name", "Slower, seeded", "--seed", str(seed), "--run-dir", tmp_path / f"slower-{seed}")
        for seed in (0, 1)
    ]
    assert artifacts.read_json(runs[0] / "meta.json")["policy"]["code"] == "slow:Slower 1.5"
    for run in (*runs, trained / "bc-0", trained / "dt-0"):
        evaluated = zest("evaluate", run, "--n-episodes", 6, "--rtg", "constant", "--n-workers", 2, "--no-videos")
    report = zest("report", *runs, trained / "bc-0", trained / "dt-0", "--output", tmp_path / "report.html")
    assert list(report["rows"]) == ["Demo", "Slower, seeded", "BC", "DT on same-scene"]
    assert report["rows"]["DT on same-scene"] == round(evaluated["normalized_return"]["value"], 2)
    starts = [artifacts.read_json(next(run.glob("evaluations/*/result.json"))) for run in (runs[0], trained / "bc-0")]
    assert len({tuple(episode["seed"] for episode in each["episodes"]) for each in starts}) == 1


@pytest.mark.usefixtures("plugin")
def test_a_registered_policy_that_fails_is_named(adopt: Callable[..., Path]) -> None:
    dataset = ("--dataset", COLLECTED)
    for spec, message in (
        ("slower:x", "slow:Slower, which is registered for slower:, failed on 'x' (ValueError: could not convert"),
        (
            "number:1",
            "slow:number, which is registered for number:, must return a callable from obs to actions, got int",
        ),
    ):
        with pytest.raises(AssertionError, match=re.escape(message)):
            adopt(spec, *dataset)


def test_the_online_score_of_a_foreign_policy_is_recorded_when_asked_for(
    adopt: Callable[..., Path], tmp_path: Path
) -> None:
    result = evaluate(adopt(save(TowardsZero(), tmp_path / "zero.pt")), TWO, score=True, n_workers=1)
    assert [episode.zest_return for episode in result.episodes] == pytest.approx(
        list(result.traces["score"].sum(axis=1))
    )


def test_policies_of_one_name_and_one_seed_are_refused_in_a_report(
    adopt: Callable[..., Path], refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    spec = save(TowardsZero(), tmp_path / "zero.pt")
    runs = [adopt(spec, "--run-dir", tmp_path / name) for name in "ab"]
    code, message = refusal("report", *runs)
    assert code == 2
    assert "give one of them, or tell them apart by --name or --seed of `zest adopt`" in message


# --- which policy it is -------------------------------------------------------------------------------------------


def test_a_changed_file_is_another_run_and_the_same_one_is_the_same(
    collected: str, zest: Verb, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    save(TowardsZero(), tmp_path / "zero.pt")
    words = ("adopt", "torchscript:zero.pt", "--dataset", collected, "--name", "My zero")
    first = zest(*words)
    assert re.fullmatch(r"runs/kitchen-micro-tiny-v0-My-zero-seed0-[0-9a-f]{8}", first["run"])
    assert first["files"] == {"policy/zero.pt": artifacts.hash_file(tmp_path / "zero.pt")}
    meta = artifacts.read_json(Path(first["run"]) / "meta.json")
    assert (meta["agent"], meta["name"], meta["policy"]["files"]) == ("foreign", "My zero", first["files"])
    assert str(tmp_path) not in json.dumps(meta)
    written = (Path(first["run"]) / "meta.json").stat().st_mtime_ns
    assert zest(*words) == first
    assert (Path(first["run"]) / "meta.json").stat().st_mtime_ns == written
    (tmp_path / "zero.pt").unlink()  # the run has its own
    load_policy(Path(first["run"]))
    save(nn.Sequential(nn.Linear(59, 9)), tmp_path / "zero.pt")
    assert zest(*words)["run"] != first["run"]


def test_a_run_whose_policy_was_changed_is_not_evaluated(
    adopt: Callable[..., Path], server: Callable[[str], str], tmp_path: Path
) -> None:
    run = adopt(save(TowardsZero(), tmp_path / "zero.pt"))
    with (run / "policy" / "zero.pt").open("ab") as file:
        file.write(b"\0")
    with pytest.raises(
        ZestError, match=r"zero.pt is missing or was changed since `zest adopt` saw it.*adopt the new one"
    ):
        evaluate(run, TWO)
    run = adopt(server(documented("python", "answers")))
    (tmp_path / "server.py").write_text("print('hello')")
    with pytest.raises(ZestError, match=r"server.py is missing or was changed"):
        evaluate(run, TWO)


def test_a_folder_that_holds_something_else_is_refused(
    trained: Path, adopt: Callable[..., Path], refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    spec = save(TowardsZero(), tmp_path / "zero.pt")
    run = adopt(spec)
    code, message = refusal("adopt", spec, "--dataset", COLLECTED, "--seed", "1", "--run-dir", run)
    assert code == 2
    assert f"{run} holds another run (data" in message
    assert "seed differ); give another --run-dir" in message
    code, message = refusal("adopt", spec, "--dataset", COLLECTED, "--run-dir", trained)
    assert code == 2
    assert f"{trained} is not empty and holds no policy" in message


@pytest.mark.parametrize(
    ("spec", "python", "message"),
    [
        ("torchscipt:x.pt", None, "unknown kind of policy 'torchscipt'; did you mean 'torchscript'?"),
        ("x.pt", None, "unknown kind of policy 'x.pt'; "),
        ("onnx:", None, "onnx: must be followed by a file, got nothing"),
        ("command: ", None, "command: must be followed by a command, got nothing"),
        ("torchscript:/no/x.pt", None, "there is no file /no/x.pt; give what the training program saved"),
        ("d3rlpy:x.d3", None, "a Python belongs to d3rlpy:FILE.d3 and to nothing else, got None with d3rlpy:; give"),
        ("torchscript:x.pt", "python3", "got 'python3' with torchscript:"),
        (f"d3rlpy:{__file__}", "/no/python", "there is no program '/no/python'; give --python /path/to/bin/python"),
        ("command:'", None, 'the command "\'" cannot be read as a shell would: No closing quotation'),
        (f"command:python3 serve.py --weights={Path(__file__).parent}", None, "is a folder; name the files"),
    ],
)
def test_a_spec_that_names_nothing_is_refused(spec: str, python: str | None, message: str) -> None:
    with pytest.raises(BadInput, match=re.escape(message)):
        identify(spec, python)


def test_files_that_a_command_names_are_hashed_wherever_they_stand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("serve.py", "w.pt"):
        (tmp_path / name).write_text(name)
    source = identify("command:python3 serve.py --weights=w.pt -c ~nobody/x " + 300 * "x")
    assert source.words[:3] == ("python3", str(tmp_path / "serve.py"), f"--weights={tmp_path / 'w.pt'}")
    assert source.files == {str(path): artifacts.hash_file(path) for path in (tmp_path / "serve.py", tmp_path / "w.pt")}


def test_what_cannot_be_read_is_refused_and_leaves_no_folder(
    collected: str, refusal: Callable[..., tuple[int, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "noise.pt").write_bytes(b"no policy")
    torch.save({"weight": torch.zeros(2)}, tmp_path / "weights.pt")
    (tmp_path / "noise.onnx").write_bytes(b"no policy")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)  # not installed
    for spec, code, complaint in (
        ("torchscript:noise.pt", 2, "error: noise.pt cannot be read as TorchScript; write it with torch.jit.save"),
        ("torchscript:weights.pt", 2, "error: weights.pt cannot be read as TorchScript"),
        (
            "onnx:noise.onnx",
            1,
            "ONNX policies need onnxruntime, which is not installed: pip install onnxruntime",
        ),
        ("command:no-such-program", 2, "there is no program 'no-such-program'"),
    ):
        spec = spec.replace(":noise", f":{tmp_path}/noise").replace(":weights", f":{tmp_path}/weights")
        got, message = refusal("adopt", spec, "--dataset", collected, "--run-dir", tmp_path / "runs" / "x")
        assert (got, complaint in message) == (code, True), message
    assert not [*(tmp_path / "runs").iterdir()]


class Several(nn.Module):
    """Actions and values, as stable-baselines3's policies give them."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.act, self.value = nn.Linear(59, 9), nn.Linear(59, 1)

    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        return self.act(obs).clip(-1, 1), self.value(obs)


@pytest.mark.parametrize("kind", ["torchscript", "onnx"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_first_of_several_outputs_are_the_actions_in_any_precision(
    kind: str, dtype: torch.dtype, adopt: Callable[..., Path], tmp_path: Path
) -> None:
    module, path = Several().eval().to(dtype), tmp_path / f"p.{kind}"
    if kind == "torchscript":
        torch.jit.trace(module, torch.zeros(1, 59, dtype=dtype)).save(str(path))
    else:
        names = {"input_names": ["observation"], "output_names": ["actions", "values"]}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            torch.onnx.export(module, (torch.zeros(1, 59, dtype=dtype),), str(path), dynamo=False, **names)
    policy = load_policy(adopt(f"{kind}:{path}"))
    obs = np.random.default_rng(0).normal(size=(3, 59)).astype(np.float32)
    policy.begin(3)
    with torch.no_grad():
        expected = module(torch.from_numpy(obs).to(dtype))[0].float().numpy()
    np.testing.assert_allclose(policy.act(obs), expected, atol=1e-5)


def test_a_torchscript_without_actions_is_told_what_it_must_return(
    collected: str, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    class Named(nn.Module):
        def forward(self, obs: Tensor) -> dict[str, Tensor]:
            return {"actions": obs[:, :9]}

    torch.jit.trace(Named(), torch.zeros(1, 59), strict=False).save(str(tmp_path / "p.pt"))
    code, message = refusal("adopt", f"torchscript:{tmp_path / 'p.pt'}", "--dataset", collected)
    assert (code, "its output must be a tensor of actions or begin with one, got dict" in message) == (1, True)


def test_a_graph_that_takes_other_observations_is_named_in_one_line(
    collected: str, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    torch.jit.trace(nn.Linear(30, 9), torch.zeros(1, 30)).save(str(tmp_path / "p.pt"))
    spec = f"torchscript:{tmp_path / 'p.pt'}"
    code, message = refusal("adopt", spec, "--dataset", collected, "--run-dir", tmp_path / "x")
    assert code == 1
    assert "policy 'p (torchscript)' (torchscript) failed on obs of shape (4, 59) (RuntimeError: " in message
    assert "shapes cannot be multiplied (4x59 and 30x9)" in message
    assert not (tmp_path / "x").exists()
