"""The trainer: what a run leaves, that it can be killed, and what it refuses."""

from __future__ import annotations

import csv
import json
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator  # type: ignore[import-untyped]

from zest_rl.agents import AGENTS, Agent, load_policy
from zest_rl.agents.base import describe_data
from zest_rl.agents.bc import BCConfig
from zest_rl.agents.dt import DTConfig
from zest_rl.agents.rvs import RvSConfig
from zest_rl.agents.trex import TREXConfig
from zest_rl.errors import BadInput, ZestError
from zest_rl.training import loop
from zest_rl.training.checkpoints import TrainState, resume, save_checkpoint
from zest_rl.training.loop import TrainingConfig, fit
from zest_rl.training.request import snapshot_folder
from zest_rl.types import Episode

CONFIGS: dict[str, Any] = {
    "bc": BCConfig(hidden_size=16, n_layers=2, batch_size=16, warmup_updates=5, learning_rate=1e-3),
    "dt": DTConfig(context_len=4, hidden_size=16, n_layers=1, batch_size=8, warmup_updates=5, learning_rate=1e-3),
    "rvs": RvSConfig(hidden_size=16, n_layers=2, batch_size=16, warmup_updates=5, dropout=0.1, n_networks=2),
    "trex": TREXConfig(
        hidden_size=16, n_layers=1, batch_size=8, warmup_updates=5, learning_rate=1e-3, dropout=0.1, n_networks=2
    ),
}


def make_episodes(n: int = 4, obs_dim: int = 3) -> list[Episode]:
    """Episodes of unequal lengths whose action follows the observation."""
    rng = np.random.default_rng(0)
    episodes = []
    for i in range(n):
        obs = rng.uniform(-1, 1, (3 + 2 * i, obs_dim)).astype(np.float32)
        episodes.append(
            Episode(obs, obs[:-1, :2] * np.float32(0.5), rng.random(len(obs) - 1, dtype=np.float32), terminated=False)
        )
    return episodes


def start(run_dir: Path, agent: str = "dt", **changes: Any) -> Path:
    arguments: dict[str, Any] = {"meta": {"dataset": {"id": "toy-v0"}}}
    arguments |= {name: changes.pop(name) for name in ("meta", "files", "on_progress") if name in changes}
    config = TrainingConfig(n_updates=30, seed=3, device="cpu", threads=1, checkpoint_every=7, log_every=5)
    return fit(agent, CONFIGS[agent], make_episodes(), run_dir, replace(config, **changes), **arguments)


def start_and_die(run_dir: Path, agent: str, n_done: int) -> None:
    """Train in another process, which kills itself with SIGKILL after `n_done` updates have been logged."""
    code = (
        "import os, signal, sys; sys.path.insert(0, sys.argv[1]); from pathlib import Path; import test_loop as t\n"
        "done = 0\n"
        "def die(n, **row):\n"
        "    global done\n"
        "    done += n\n"
        f"    if done == {n_done}: os.kill(os.getpid(), signal.SIGKILL)\n"
        "t.start(Path(sys.argv[2]), sys.argv[3], on_progress=die)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(Path(__file__).parent), str(run_dir), agent], check=False)
    assert done.returncode == -signal.SIGKILL


def rows(run_dir: Path) -> list[dict[str, str]]:
    with (run_dir / "metrics.csv").open() as file:
        return [{k: v for k, v in row.items() if k != "updates_per_s"} for row in csv.DictReader(file)]


@pytest.fixture(scope="module", params=sorted(name for name, agent in AGENTS.items() if isinstance(agent, Agent)))
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of each agent that nothing interrupted."""
    return start(tmp_path_factory.mktemp("whole") / request.param, request.param)


@pytest.fixture(scope="module")
def cut(whole: Path) -> Path:
    """The same run, killed after 25 updates."""
    run = whole.with_name("cut")
    start_and_die(run, whole.name, 25)
    return run


def test_a_run_killed_before_its_first_checkpoint_ends_with_the_same_bits(whole: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    start_and_die(run, whole.name, 5)
    assert len(rows(run)) == 1
    start(run, whole.name)
    assert (run / "model.safetensors").read_bytes() == (whole / "model.safetensors").read_bytes()
    assert rows(run) == rows(whole)


def test_a_run_killed_between_checkpoints_goes_on_from_the_last_and_ends_with_the_same_bits(
    whole: Path, cut: Path, tmp_path: Path
) -> None:
    run = shutil.copytree(cut, tmp_path / "run")
    assert [folder.name for folder in sorted((run / "checkpoints").iterdir())] == [
        "update-000000014",
        "update-000000021",
    ]
    assert int(rows(run)[-1]["update"]) == 25
    reported: list[int] = []
    start(run, whole.name, on_progress=lambda n, **row: reported.append(n))
    assert reported == [25, 5], "what was done before the cut counts, too"
    assert (run / "model.safetensors").read_bytes() == (whole / "model.safetensors").read_bytes()
    assert rows(run) == rows(whole)
    assert not (run / "checkpoints").exists()


def test_the_same_seed_gives_the_same_weights_and_another_seed_others(whole: Path, tmp_path: Path) -> None:
    weights = (whole / "model.safetensors").read_bytes()
    torch.rand(7)  # torch's own generator plays no part
    assert (start(tmp_path / "same", whole.name) / "model.safetensors").read_bytes() == weights
    assert (start(tmp_path / "other", whole.name, seed=4) / "model.safetensors").read_bytes() != weights


def test_the_policy_acts_with_the_moving_average_of_the_weights(tmp_path: Path) -> None:
    """Snapshots without averaging are the trained weights after each update; their average is done by hand."""
    config, n = CONFIGS["bc"], 12
    plain = tmp_path / "plain"
    length = TrainingConfig(n_updates=n, seed=3)
    fit("bc", replace(config, ema_decay=0.0), make_episodes(), plain, replace(length, snapshot_every=1))
    averaged = tmp_path / "averaged"
    fit("bc", replace(config, ema_decay=0.5), make_episodes(), averaged, length)
    weights = [load_file(folder / "model.safetensors") for folder in (*sorted((plain / "snapshots").iterdir()), plain)]
    assert len(weights) == n
    torch.manual_seed(3)
    expected = dict(AGENTS["bc"].build(config, describe_data(make_episodes())).named_parameters())
    for update, new in enumerate(weights, 1):
        decay = min(0.5, (1 + update) / (10 + update))
        expected = {name: decay * mean + (1 - decay) * new[name] for name, mean in expected.items()}
    for name, mean in load_file(averaged / "model.safetensors").items():
        torch.testing.assert_close(mean, expected[name].detach(), rtol=1e-5, atol=1e-6)


def test_snapshots_are_the_policies_of_shorter_trainings(whole: Path, tmp_path: Path) -> None:
    run = start(tmp_path / "run", whole.name, snapshot_every=12)
    assert (run / "model.safetensors").read_bytes() == (whole / "model.safetensors").read_bytes()
    assert [folder.name for folder in sorted((run / "snapshots").iterdir())] == ["update-000000012", "update-000000024"]
    snapshot, shorter = run / "snapshots" / "update-000000024", start(tmp_path / "shorter", whole.name, n_updates=24)
    assert (snapshot / "model.safetensors").read_bytes() == (shorter / "model.safetensors").read_bytes()
    assert json.loads((snapshot / "meta.json").read_text())["n_updates"] == 24
    if whole.name != "trex":  # a reward
        load_policy(snapshot)


def test_a_run_and_its_snapshots_carry_the_files_that_they_are_given(tmp_path: Path) -> None:
    run = start(tmp_path / "run", snapshot_every=12, n_updates=20, files={"scorer": b"goal"})
    assert [path.relative_to(run).parts[:2] for path in sorted(run.rglob("scorer"))] == [
        ("scorer",),
        ("snapshots", "update-000000012"),
    ]
    assert (run / "scorer").read_bytes() == b"goal"


def test_a_snapshot_that_a_cut_prevented_is_kept_by_the_resumed_run(whole: Path, tmp_path: Path) -> None:
    """At an update with both, the checkpoint is written last: what goes on from it finds the snapshot there."""
    seen: list[tuple[bool, bool]] = []

    def look(run: Path, state: TrainState) -> None:
        folder = snapshot_folder(run, state.update)
        seen.append((folder.exists(), (run / "checkpoints" / folder.name).exists()))
        save_checkpoint(run, state)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "save_checkpoint", look)
        start(tmp_path / "run", whole.name, snapshot_every=7, n_updates=20)
    assert seen == [(True, False), (True, False)]


def test_training_leaves_torchs_generator_and_threads_alone(tmp_path: Path) -> None:
    before, threads = torch.get_rng_state(), torch.get_num_threads()
    start(tmp_path / "run", threads=threads + 1, n_updates=1)
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.get_num_threads() == threads


def test_the_loss_falls_and_is_logged_with_the_same_values_to_csv_and_tensorboard(whole: Path) -> None:
    table = rows(whole)
    assert [int(row["update"]) for row in table] == [5, 10, 15, 20, 25, 30]
    assert float(table[-1]["loss"]) < float(table[0]["loss"])
    assert float(table[0]["learning_rate"]) == pytest.approx(1e-3)  # warm-up is over at update 5
    board = EventAccumulator(str(whole / "tb"))
    board.Reload()
    for name in ("loss", "grad_norm", "learning_rate", "updates_per_s"):
        assert [event.step for event in board.Scalars(name)] == [5, 10, 15, 20, 25, 30]
    logged = [event.value for event in board.Scalars("loss")]
    np.testing.assert_allclose(logged, [float(row["loss"]) for row in table], rtol=1e-6)


def test_meta_tells_everything_that_is_needed_to_load_and_to_trace_the_weights(whole: Path) -> None:
    meta = json.loads((whole / "meta.json").read_text())
    assert meta["agent"] == whole.name
    assert type(CONFIGS[whole.name])(**meta["config"]) == CONFIGS[whole.name]
    assert (meta["obs_dim"], meta["act_dim"], meta["max_steps"], meta["n_episodes"]) == (3, 2, 8, 4)
    assert (meta["n_updates"], meta["seed"], meta["threads"], meta["device"]) == (30, 3, 1, "cpu")
    assert meta["dataset"] == {"id": "toy-v0"}
    returns = sorted(float(e.rewards.sum()) for e in make_episodes())
    assert len(meta["return_quantiles"]) == 101
    assert (meta["return_quantiles"][0], meta["return_quantiles"][-1]) == pytest.approx((returns[0], returns[-1]))
    assert meta["return_scale"] == pytest.approx(returns[-1])
    assert (meta["rtg_schedule"][0], meta["rtg_schedule"][-1]) == pytest.approx((returns[-1], 0))
    obs = np.concatenate([e.obs[:-1] for e in make_episodes()])
    np.testing.assert_allclose(meta["obs_mean"], obs.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(meta["obs_std"], obs.std(axis=0), rtol=1e-5)
    assert meta["n_params"] > 0
    assert meta["train_seconds"] >= 0, "in milliseconds"
    assert "torch" in meta["made_by"]["versions"]
    assert meta["precision"] in ("bf16", "fp32")


def test_a_finished_run_is_not_trained_again(whole: Path) -> None:
    before = (whole / "meta.json").stat().st_mtime_ns
    start(whole, whole.name, on_progress=lambda n, **row: pytest.fail("it trains"))
    assert (whole / "meta.json").stat().st_mtime_ns == before


def test_a_folder_with_another_run_is_refused_and_the_differences_named(whole: Path) -> None:
    with pytest.raises(BadInput) as error:
        start(whole, whole.name, seed=9, n_updates=31, meta={"dataset": {"id": "other-v0"}})
    for difference in ("seed (was 3, is 9)", "n_updates (was 30, is 31)", "dataset.id (was 'toy-v0', is 'other-v0')"):
        assert difference in str(error.value)


def test_a_folder_with_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(BadInput, match="not empty and holds no run"):
        start(tmp_path)


def test_nothing_in_a_run_is_pickled(cut: Path) -> None:
    files = {path.suffix for path in cut.rglob("*") if path.is_file() and path.parent.name != "tb"}
    assert files == {".json", ".csv", ".safetensors"}


def test_a_damaged_checkpoint_is_named_and_the_one_before_it_serves_once_it_is_deleted(
    whole: Path, cut: Path, tmp_path: Path
) -> None:
    run = shutil.copytree(cut, tmp_path / "run")
    newest = sorted((run / "checkpoints").glob("update-*"))[-1]
    data = bytearray((newest / "optimizer.safetensors").read_bytes())
    data[-1] ^= 1
    (newest / "optimizer.safetensors").write_bytes(data)
    with pytest.raises(ZestError, match=r"optimizer.safetensors is not what was written; delete this folder"):
        start(run, whole.name)
    shutil.rmtree(newest)
    start(run, whole.name)
    assert (run / "model.safetensors").read_bytes() == (whole / "model.safetensors").read_bytes()


def test_wrong_arguments_are_named_before_anything_is_written(tmp_path: Path) -> None:
    run = tmp_path / "run"
    with pytest.raises(BadInput, match="did you mean 'dt'"):
        fit("td", CONFIGS["dt"], make_episodes(), run, TrainingConfig())
    with pytest.raises(BadInput, match="agent 'dt' takes a DTConfig, got a BCConfig"):
        fit("dt", CONFIGS["bc"], make_episodes(), run, TrainingConfig())
    with pytest.raises(BadInput, match=r"seed must be 0 or positive, got -1; n_updates must be at least 1, got 0"):
        start(run, n_updates=0, seed=-1)
    with pytest.raises(BadInput, match="device must be"):
        start(run, device="tpu")
    with pytest.raises(BadInput, match="meta must not use the keys obs_dim, seed"):
        start(run, meta={"seed": 1, "obs_dim": 2})
    assert not run.exists()


def test_data_that_do_not_suit_are_refused(tmp_path: Path) -> None:
    def attempt(episodes: list[Episode]) -> None:
        fit("bc", CONFIGS["bc"], episodes, tmp_path / "run", TrainingConfig(n_updates=1))

    with pytest.raises(BadInput, match="at least 1 episode, got 0"):
        attempt([])
    with pytest.raises(BadInput, match=r"episode 0 has \(3, 2\), episode 4 has \(5, 2\)"):
        attempt([*make_episodes(), *make_episodes(obs_dim=5)])
    wild = make_episodes(1)[0]
    with pytest.raises(BadInput, match=r"actions must lie in \[-1, 1\]"):
        attempt([Episode(wild.obs, wild.actions * 9, wild.rewards, terminated=False)])


def test_a_joint_that_never_moved_in_the_data_does_not_blow_up_when_it_does() -> None:
    obs = np.zeros((5, 2), np.float32)
    obs[:, 0] = np.arange(5)
    facts = describe_data([Episode(obs, np.zeros((4, 1), np.float32), np.ones(4, np.float32), terminated=False)])
    normalized = facts.normalize(np.array([[1.5, 3.0]], np.float32))
    np.testing.assert_allclose(normalized, [[0.0, 10.0]], atol=1e-6)


def test_a_loss_that_is_not_finite_stops_the_run(tmp_path: Path) -> None:
    config = BCConfig(hidden_size=4, n_layers=1, batch_size=4, learning_rate=1e38, warmup_updates=0, amp="fp32")
    with pytest.raises(ZestError, match="must be finite"):
        fit("bc", config, make_episodes(), tmp_path / "run", TrainingConfig(n_updates=50, threads=1))


@pytest.mark.parametrize("file", ["model.safetensors", "state.json", "manifest.json"])
def test_a_checkpoint_of_devices_in_place_of_files_is_refused(file: str, tmp_path: Path) -> None:
    state = TrainState.start(torch.nn.Linear(3, 2), 0.0, 0)
    save_checkpoint(tmp_path, state)
    (folder,) = (tmp_path / "checkpoints").iterdir()
    (folder / file).unlink()
    (folder / file).symlink_to("/dev/zero")
    with pytest.raises(ZestError, match=f"damaged: {file} is not what was written"):
        resume(tmp_path, state)


@pytest.mark.parametrize("manifest", [{}, [], None, {"/dev/zero": "0"}, {"a\0": "0"}, {"state.json": []}])
def test_a_manifest_of_other_files_than_those_of_a_checkpoint_is_refused(manifest: Any, tmp_path: Path) -> None:
    state = TrainState.start(torch.nn.Linear(3, 2), 0.0, 0)
    save_checkpoint(tmp_path, state)
    (folder,) = (tmp_path / "checkpoints").iterdir()
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(ZestError, match=r"damaged: manifest\.json is not what was written"):
        resume(tmp_path, state)


def test_a_run_from_before_an_option_existed_goes_on_and_a_finished_one_is_found_finished(tmp_path: Path) -> None:
    run = start(tmp_path / "run", "bc")
    request = json.loads((run / "run.json").read_text())
    del request["config"]["n_networks"]
    (run / "run.json").write_text(json.dumps(request))
    before = (run / "model.safetensors").read_bytes()
    assert start(run, "bc") == run
    assert (run / "model.safetensors").read_bytes() == before
