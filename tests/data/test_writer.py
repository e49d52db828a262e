from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import minari
import numpy as np
import pytest
from read_dataset import read

from zest_rl.data import reader
from zest_rl.data.reader import Dataset
from zest_rl.data.writer import DatasetCopy, Recording, write_dataset, write_scored
from zest_rl.errors import BadInput, ZestError
from zest_rl.kitchen.env import env_spec
from zest_rl.runtime import artifacts

if TYPE_CHECKING:
    from conftest import Disk

NEW = "zest/kitchen-micro-new-v0"
WRITE_FAILED = r"could not be written: the (disk is full|writing process died).*; nothing was left behind"
N_OBS, N_QPOS, N_QVEL, N_ACTIONS = 59, 30, 29, 9
ENV_SPEC = env_spec("micro").to_json()


def random_recordings(n_episodes: int, seed: int = 0, n_steps: int = 100) -> list[Recording]:
    """Episodes in the shapes of the kitchen with random numbers: only the way to disk matters here."""
    rng = np.random.default_rng(seed)
    return [
        Recording(
            seed=i,
            obs=rng.normal(size=(n_steps + 1, N_OBS)).astype(np.float32),
            actions=rng.uniform(-1, 1, (n_steps, N_ACTIONS)).astype(np.float32),
            terminated=bool(i % 2),
            qpos=rng.normal(size=(n_steps + 1, N_QPOS)),
            qvel=rng.normal(size=(n_steps + 1, N_QVEL)),
            gt_reward=rng.uniform(size=n_steps + 1).astype(np.float32),
            gt_success=rng.uniform(size=n_steps + 1) > 0.5,
        )
        for i in range(n_episodes)
    ]


def write(recordings: list[Recording], dataset_id: str = NEW, **changes: Any) -> Path:
    fields: dict[str, Any] = {
        "env_spec": ENV_SPEC,
        "ref_min_score": 0.5,
        "ref_max_score": 70.0,
        "algorithm_name": "random numbers",
        "description": "for tests",
        "zest": {"collect": {"asked": {"n": len(recordings)}}},
    }
    return write_dataset(dataset_id, recordings, **{**fields, **changes})


def relabel(source: str, dataset_id: str = NEW, extra: Any = lambda staging: None) -> Path:
    rewards, scores = new_rewards(source)
    return write_scored(
        copy_of(source), dataset_id, rewards, scores, description="And more.", zest={"stage": {"a": 1}}, extra=extra
    )


def copy_of(dataset_id: str) -> DatasetCopy:
    with reader.open_dataset(dataset_id) as ds:
        return DatasetCopy.of(ds)


def new_rewards(source: str) -> tuple[list[np.ndarray], list[np.ndarray]]:
    rng = np.random.default_rng(0)
    scores = [rng.normal(size=len(episode) + 1).astype(np.float32) for episode in read(source, Dataset.episodes)]
    return [score[1:] for score in scores], scores


def arrays_of(dataset_id: str) -> dict[str, tuple[str, tuple[int, ...], bytes]]:
    """Dtype, shape and bytes of everything in a dataset's HDF5 file."""
    found = {}

    def visit(name: str, node: Any) -> None:
        for key, value in node.attrs.items():
            found[f"{name}@{key}"] = ("", (), str(value).encode())
        if isinstance(node, h5py.Dataset):
            found[name] = (node.dtype.str, node.shape, node[()].tobytes())

    with h5py.File(reader.dataset_path(dataset_id) / reader.DATA_FILE) as file:
        file.visititems(visit)
    return found


def left_behind(root: Path) -> set[str]:
    """What is in a folder beside the tests' ballast."""
    return {p.relative_to(root).as_posix() for p in root.rglob("*") if p.is_file() and p.name != "ballast"}


def listed() -> set[str]:
    assert set(reader.list_datasets()) == set(minari.list_local_datasets())
    return set(reader.list_datasets())


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari"


# --- new datasets -----------------------------------------------------------------------------------------------------


def test_minari_and_this_package_read_back_what_was_written(root: Path) -> None:
    recordings = random_recordings(3)
    assert write(recordings) == root / NEW
    dataset = minari.load_dataset(NEW)
    assert (dataset.total_episodes, dataset.total_steps) == (3, 300)
    ours = zip(read(NEW, Dataset.episodes), read(NEW, Dataset.states), read(NEW, Dataset.truth), strict=True)
    for recording, theirs, (episode, qpos, truth) in zip(recordings, dataset.iterate_episodes(), ours, strict=True):
        np.testing.assert_array_equal(theirs.observations, recording.obs)
        np.testing.assert_array_equal(theirs.actions, recording.actions)
        np.testing.assert_array_equal(theirs.rewards, recording.gt_reward[1:])
        np.testing.assert_array_equal(theirs.terminations, np.arange(100) == (99 if recording.terminated else -1))
        np.testing.assert_array_equal(theirs.truncations, np.arange(100) == (-1 if recording.terminated else 99))
        np.testing.assert_array_equal(theirs.infos["state"]["qpos"], recording.qpos)
        np.testing.assert_array_equal(theirs.infos["state"]["qvel"], recording.qvel)
        np.testing.assert_array_equal(theirs.infos["gt"]["reward"], recording.gt_reward)
        np.testing.assert_array_equal(theirs.infos["gt"]["success"], recording.gt_success)
        np.testing.assert_array_equal(episode.obs, recording.obs)
        np.testing.assert_array_equal(episode.actions, recording.actions)
        np.testing.assert_array_equal(qpos, recording.qpos)
        np.testing.assert_array_equal(truth.rewards, recording.gt_reward[1:])
        assert episode.terminated == recording.terminated
        assert truth.success
    metadata = read(NEW, lambda ds: ds.metadata)
    assert metadata["zest"] == {"collect": {"asked": {"n": 3}}}
    assert (metadata["ref_min_score"], metadata["ref_max_score"]) == (0.5, 70.0)
    assert listed() == {NEW}
    assert left_behind(root) == {
        f"{NEW}/{name}" for name in (reader.DATA_FILE, reader.METADATA_FILE, reader.MANIFEST_FILE)
    }


def test_minari_rebuilds_the_environment_and_replays_an_episode(collected: str) -> None:
    dataset = minari.load_dataset(collected)
    episode = dataset[0]
    for env in (dataset.recover_environment(), dataset.recover_environment(eval_env=True)):
        obs, _ = env.reset(seed=int(next(iter(dataset.storage.get_episode_metadata([0])))["seed"]))
        np.testing.assert_array_equal(obs, episode.observations[0])
        for t in range(100):
            obs, reward, terminated, truncated, _ = env.step(episode.actions[t])
            np.testing.assert_array_equal(obs, episode.observations[t + 1])
            assert reward == episode.rewards[t]
        assert truncated
        assert not terminated
        env.close()
    assert minari.get_normalized_score(dataset, np.array([0.0, 70.0])).tolist() == [0.0, 1.0]


def test_an_id_that_exists_is_refused_and_the_dataset_stays(collected: str) -> None:
    before = arrays_of(collected)
    for make in (lambda: write(random_recordings(1), collected), lambda: relabel(collected, collected)):
        with pytest.raises(BadInput, match=f"dataset {collected} exists already; choose another name or delete"):
            make()
    assert arrays_of(collected) == before


@pytest.mark.parametrize("dataset_id", ["../x-v0", "", "zest/x"])
def test_a_malformed_id_is_refused_before_anything_is_made(dataset_id: str, root: Path) -> None:
    with pytest.raises(BadInput, match="a dataset id must look like"):
        write(random_recordings(1), dataset_id)
    assert not root.exists()


@pytest.mark.parametrize(
    ("name", "change", "rule"),
    [
        ("obs", lambda a: a[:-1], r"obs must have shape \(101, \?\)"),
        ("obs", lambda a: a * np.nan, "obs must be finite"),
        ("actions", lambda a: a.astype(np.float64), "actions must have .* dtype float32"),
        ("actions", lambda a: a[:0], "at least 1 step, got 0"),
        ("gt_reward", lambda a: a[1:], r"rewards must have shape \(100\)"),
        ("qpos", lambda a: a[1:], r"qpos must have T \+ 1 = 101 rows"),
        ("qvel", lambda a: a[1:], r"qvel must have T \+ 1 = 101 rows"),
        ("gt_success", lambda a: a[1:], r"gt_success must have T \+ 1 = 101 rows"),
    ],
)
def test_a_recording_whose_parts_do_not_fit_is_refused(name: str, change: Any, rule: str) -> None:
    (recording,) = random_recordings(1)
    with pytest.raises(BadInput, match=rule):
        replace(recording, **{name: change(getattr(recording, name))})


def test_a_dataset_without_episodes_is_refused(root: Path) -> None:
    with pytest.raises(BadInput, match="at least 1 episode, got 0"):
        write([])
    assert not root.exists()


def test_what_minari_refuses_is_told_and_leaves_nothing(root: Path) -> None:
    with pytest.raises(ZestError, match=r"could not be written: JSONDecodeError: .*; nothing was left behind"):
        write(random_recordings(1), env_spec="{")
    assert left_behind(root) == set()
    assert listed() == set()


# --- relabeled datasets -----------------------------------------------------------------------------------------------


def test_relabeling_changes_rewards_adds_scores_and_keeps_everything_else_bit_for_bit(collected: str) -> None:
    path = relabel(collected, extra=lambda staging: artifacts.write_json(staging / "scores.json", [1]))
    rewards, scores = new_rewards(collected)
    before, after = arrays_of(collected), arrays_of(NEW)
    for i in range(4):
        assert after.pop(f"episode_{i}/rewards") == ("<f4", (100,), rewards[i].tobytes())
        assert after.pop(f"episode_{i}/infos/zest/score") == ("<f4", (101,), scores[i].tobytes())
        del before[f"episode_{i}/rewards"]
    assert after == before
    assert artifacts.read_json(path / "scores.json") == [1]
    old, new = read(collected, lambda ds: ds.metadata), read(NEW, lambda ds: ds.metadata)
    assert new.pop("dataset_id") == NEW
    assert new.pop("description") == "a few episodes for tests And more."
    assert new.pop("zest") == {**old.pop("zest"), "stage": {"a": 1}}
    assert new == {key: value for key, value in old.items() if key in new}
    assert old.keys() - new.keys() == {"dataset_id", "description"}
    assert read(NEW, Dataset.fingerprint) == read(collected, Dataset.fingerprint)


def test_minari_and_this_package_read_the_relabeled_rewards(collected: str) -> None:
    relabel(collected)
    rewards, scores = new_rewards(collected)
    dataset = minari.load_dataset(NEW)
    assert dataset.total_steps == 400
    for i, episode in enumerate(dataset.iterate_episodes()):
        np.testing.assert_array_equal(episode.rewards, rewards[i])
        np.testing.assert_array_equal(episode.infos["zest"]["score"], scores[i])
        np.testing.assert_array_equal(read(NEW, Dataset.scores)[i], scores[i])
        np.testing.assert_array_equal(read(NEW, Dataset.episodes)[i].rewards, rewards[i])
    assert listed() == {collected, NEW}


def test_relabeling_a_relabeled_dataset_replaces_its_scores(collected: str) -> None:
    relabel(collected)
    zeros = [np.zeros(101, np.float32)] * 4
    write_scored(
        copy_of(NEW),
        "zest/again-v0",
        [z[1:] for z in zeros],
        zeros,
        description="",
        zest={"stage": {"a": 2}},
        extra=lambda staging: None,
    )
    np.testing.assert_array_equal(read("zest/again-v0", Dataset.scores), zeros)
    assert read("zest/again-v0", lambda ds: ds.metadata)["zest"]["stage"] == {"a": 2}


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        (lambda rewards, scores: (rewards[:-1], scores), "rewards must have length T and scores length T"),
        (lambda rewards, scores: (scores, scores), "rewards must have length T and scores length T"),
        (lambda rewards, scores: (rewards, rewards), "rewards must have length T and scores length T"),
        (lambda rewards, scores: ([r * np.nan for r in rewards], scores), "must be finite"),
        (lambda rewards, scores: (rewards, [s * np.inf for s in scores]), "must be finite"),
    ],
)
def test_rewards_that_do_not_fit_are_refused_before_anything_is_made(collected: str, change: Any, rule: str) -> None:
    rewards, scores = change(*new_rewards(collected))
    with pytest.raises(BadInput, match=rule):
        write_scored(copy_of(collected), NEW, rewards, scores, description="", zest={}, extra=lambda staging: None)
    assert listed() == {collected}


def test_arrays_that_did_not_reach_the_disk_are_noticed(collected: str) -> None:
    def lose(staging: Path) -> None:
        with h5py.File(staging / reader.DATA_FILE, "r+") as file:
            file["episode_3/infos/zest/score"][90:] = 0

    with pytest.raises(ZestError, match=f"infos/zest/score of episode 3 of {NEW} was not written whole"):
        relabel(collected, extra=lose)
    assert listed() == {collected}


def test_a_failure_after_the_arrays_leaves_nothing(collected: str) -> None:
    def fail(staging: Path) -> None:
        (staging / "half").write_text("half")
        raise RuntimeError("cut")

    before = left_behind(reader.datasets_root())
    with pytest.raises(RuntimeError, match="cut"):
        relabel(collected, extra=fail)
    assert left_behind(reader.datasets_root()) == before


# --- disks ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def small_root(disk: Disk, monkeypatch: pytest.MonkeyPatch) -> Disk:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(disk.path))
    return disk


def test_a_disk_with_too_little_room_is_refused_beforehand(small_root: Disk) -> None:
    with pytest.raises(ZestError, match=r"not enough disk space at .*: 65 MB needed, 8 MB free"):
        write(random_recordings(4))
    assert left_behind(small_root.path) == set()


@pytest.mark.parametrize("free", [100_000, 1_000_000])
def test_a_disk_that_fills_up_while_writing_is_an_error_of_this_process_and_leaves_nothing(
    free: int, small_root: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(artifacts, "check_free_space", lambda folder, n_bytes: None)
    small_root.fill(free)
    with pytest.raises(ZestError, match=WRITE_FAILED):
        write(random_recordings(10))
    assert left_behind(small_root.path) == set()
    assert listed() == set()


@pytest.mark.parametrize(
    "n_pages_short",
    [20, 0],
    ids=["copying", "rewriting"],
)
def test_a_disk_that_fills_up_while_relabeling_leaves_the_source_alone(
    n_pages_short: int, collected: str, small_root: Disk, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    shutil.copytree(tmp_path / "minari", small_root.path, dirs_exist_ok=True)
    monkeypatch.setattr(artifacts, "check_free_space", lambda folder, n_bytes: None)
    before = arrays_of(collected), left_behind(small_root.path)
    copied = [reader.dataset_path(collected) / name for name in (reader.DATA_FILE, reader.METADATA_FILE)]
    small_root.fill(4096 * (sum(-(-path.stat().st_size // 4096) for path in copied) - n_pages_short))
    with pytest.raises(ZestError, match=WRITE_FAILED):
        relabel(collected)
    assert (arrays_of(collected), left_behind(small_root.path)) == before
    assert listed() == {collected}


def test_a_read_only_root_is_refused(small_root: Disk) -> None:
    small_root.make_read_only()
    with pytest.raises(ZestError, match=r"cannot write .*Read-only file system; set MINARI_DATASETS_PATH to a"):
        write(random_recordings(1))


# --- cuts and competitors ---------------------------------------------------------------------------------------------

PYTHONPATH = os.pathsep.join(map(str, list(Path(__file__).parents)[:3]))
"""Where a script finds this module, what tests share, and the package."""
WRITE = f"""
import sys
from test_writer import random_recordings, write
try:
    write(random_recordings(int(sys.argv[1]), seed=int(sys.argv[2])), description=sys.argv[2])
except Exception as error:
    sys.exit(f"{{type(error).__name__}}: {{error}}")
print("written {NEW}")
"""


def start_writing(n_episodes: int, seed: int) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", WRITE, str(n_episodes), str(seed)],
        env={**os.environ, "PYTHONPATH": PYTHONPATH},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def command_line(pid: int) -> str:
    """Of a process; empty when it has ended, also when nobody has taken note of that."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_text(encoding="utf-8")
    except (FileNotFoundError, ProcessLookupError):
        return ""


def children(pid: int) -> list[int]:
    return [int(child) for path in Path(f"/proc/{pid}/task").glob("*/children") for child in path.read_text().split()]


def test_a_killed_writer_leaves_no_dataset_and_the_same_call_completes(root: Path) -> None:
    process = start_writing(400, seed=0)
    deadline = time.monotonic() + 60
    while not any(path.stat().st_size > 10**6 for path in root.rglob("main_data.hdf5")):
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.01)
    (child,) = (pid for pid in children(process.pid) if "spawn_main" in command_line(pid))
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert listed() == set()
    while command_line(child):  # else it would go on writing where the next call writes
        assert time.monotonic() < deadline
        time.sleep(0.01)
    recordings = random_recordings(2)
    write(recordings)
    assert listed() == {NEW}
    np.testing.assert_array_equal(read(NEW, Dataset.episodes)[1].obs, recordings[1].obs)
    assert left_behind(root) == {
        f"{NEW}/{name}" for name in (reader.DATA_FILE, reader.METADATA_FILE, reader.MANIFEST_FILE)
    }


def test_a_script_needs_no_main_guard(root: Path, tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text("from test_writer import random_recordings, write\nprint('begun')\nwrite(random_recordings(2))\n")
    command = [sys.executable, str(script)]
    assert (
        subprocess.run(
            command, env={**os.environ, "PYTHONPATH": PYTHONPATH}, timeout=60, capture_output=True, text=True
        ).stdout
        == "begun\n"
    )
    assert listed() == {NEW}


def test_of_two_writers_of_one_id_one_wins_whole_and_the_other_is_told(root: Path) -> None:
    writers = {seed: start_writing(3, seed) for seed in (1, 2)}
    output = {seed: process.communicate(timeout=120) for seed, process in writers.items()}
    winners = [seed for seed, process in writers.items() if process.returncode == 0]
    assert len(winners) == 1
    (winner,) = winners
    assert output[winner][0] == f"written {NEW}\n"
    assert f"BadInput: dataset {NEW} exists already; choose another name" in output[3 - winner][1]
    assert read(NEW, lambda ds: ds.metadata)["description"] == str(winner)
    np.testing.assert_array_equal(read(NEW, Dataset.episodes)[2].obs, random_recordings(3, seed=winner)[2].obs)
