"""Damaged datasets: whatever the damage, every reader reads or refuses, and with a manifest it reads the truth."""

from __future__ import annotations

import ast
import hashlib
import json
import random
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from fuzzing import damaged_bytes, damaged_json, faults, outcomes
from gymnasium import spaces
from minari_files import Recorded, write_minari

from zest_rl.data import reader
from zest_rl.data.folders import DATA_FILE, MANIFEST_FILE, METADATA_FILE
from zest_rl.data.reader import Dataset, open_dataset
from zest_rl.data.writer import DatasetCopy, Recording, write_dataset, write_scored
from zest_rl.errors import ZestError
from zest_rl.kitchen.env import env_spec
from zest_rl.sources import open_source

KITCHEN, PICTURED = "zest/kitchen-micro-scored-v0", "room/pictured-v0"
LENGTHS = (3, 2)
RELABEL = {
    "source": "zest/kitchen-micro-new-v0", "source_sha256": "4" * 64, "reward": "level", "shuffle": None,
    "kept_goals": [0], "n_still_frames": 0,
    "scorer": {
        "config": {
            "views": {"task": "micro", "n_views": 2, "size": 64, "robot": False, "tolerance": 0.001},
            "goal": "same-scene", "embedder": "efficientnet-lite0", "features": "delta", "similarity": "cos",
        },
        "goal_sha256": "1" * 64, "embedder_sha256": "2" * 64, "views_sha256": "3" * 64,
    },
}  # fmt: skip
N_INPUTS = [pytest.param(100, id="some"), pytest.param(2000, id="many", marks=pytest.mark.slow)]


def write_kitchen() -> None:
    """A relabeled dataset of the kitchen's shapes with random numbers."""
    rng = np.random.default_rng(0)
    recordings = [
        Recording(
            seed=i, obs=rng.normal(size=(n + 1, 59)).astype(np.float32),
            actions=rng.uniform(-1, 1, (n, 9)).astype(np.float32), terminated=bool(i),
            qpos=rng.normal(size=(n + 1, 30)), qvel=rng.normal(size=(n + 1, 29)),
            gt_reward=rng.uniform(size=n + 1).astype(np.float32), gt_success=rng.uniform(size=n + 1) > 0.5,
        )
        for i, n in enumerate(LENGTHS)
    ]  # fmt: skip
    write_dataset(
        RELABEL["source"], recordings, env_spec=env_spec("micro").to_json(), ref_min_score=0.0, ref_max_score=70.0,
        algorithm_name="random numbers", description="for tests", zest={"collect": {"asked": {"task": "micro"}}},
    )  # fmt: skip
    scores = [rng.normal(size=n + 1).astype(np.float32) for n in LENGTHS]
    with open_dataset(RELABEL["source"]) as ds:
        copy = DatasetCopy.of(ds)
    write_scored(
        copy, KITCHEN, [score[1:] for score in scores], scores, description="", zest={"relabel": RELABEL},
        extra=lambda folder: None,
    )  # fmt: skip


def write_pictured() -> None:
    """A dataset as Minari writes it: JPEG pictures, numbers of two kinds, success; no manifest."""
    rng = np.random.default_rng(0)
    episodes = [
        Recorded(
            {
                "camera": rng.integers(0, 256, (n + 1, 8, 8, 3), dtype=np.uint8),
                "arm": {"position": rng.normal(size=(n + 1, 3)), "gripper": rng.integers(0, 2, n + 1)},
            },
            rng.uniform(-1, 1, (n, 2)).astype(np.float32), rng.normal(size=n), {"success": np.arange(n + 1) == n},
        )
        for n in LENGTHS
    ]  # fmt: skip
    arm = spaces.Dict({"position": spaces.Box(-9, 9, (3,)), "gripper": spaces.Discrete(2)})
    space = spaces.Dict({"camera": spaces.Box(0, 255, (8, 8, 3), np.uint8), "arm": arm})
    write_minari(PICTURED, episodes, space, spaces.Box(-1, 1, (2,)))


def write_robomimic(path: Path) -> None:
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        for i, n in enumerate(LENGTHS):
            demo = file.create_group(f"data/demo_{i}")
            demo.attrs["num_samples"] = n
            for part in ("obs", "next_obs"):
                pictures = rng.integers(0, 256, (n, 8, 8, 3), dtype=np.uint8)
                demo.create_dataset(f"{part}/agentview_image", data=pictures, compression="gzip")
                demo[f"{part}/robot0_eef_pos"] = rng.normal(size=(n, 3))
            demo["actions"], demo["rewards"], demo["dones"] = rng.uniform(-1, 1, (n, 7)), np.zeros(n), np.arange(n)
        file["data"].attrs["env_args"] = "{}"


def digest(value: Any) -> str:
    """A short name for everything in arrays, records and lists of them."""
    found = hashlib.sha256()

    def add(part: Any) -> None:
        if isinstance(part, np.ndarray):
            found.update(f"{part.dtype}{part.shape}".encode() + part.tobytes())
        elif isinstance(part, Sequence) and not isinstance(part, str):
            found.update(b"[")
            for item in part:
                add(item)
        else:
            found.update(repr(part).encode())

    add(value)
    return found.hexdigest()[:8]


READS: dict[str, Callable[[Dataset], Any]] = {
    "episodes": lambda ds: [vars(episode) | {"obs": 0} for episode in ds.episodes(discrete=True)],
    "obs": lambda ds: [episode.obs for episode in ds.episodes(discrete=True)],
    "n_steps": Dataset.n_steps,
    "rewards": Dataset.rewards,
    "states": Dataset.states,
    "truth": lambda ds: [[truth.rewards, truth.success] for truth in ds.truth()],
    "scores": Dataset.scores,
    "successes": Dataset.successes,
    "source_rewards": Dataset.source_rewards,
    "rewards_to_keep": Dataset.rewards_to_keep,
    "fingerprint": Dataset.fingerprint,
    "describe": Dataset.describe,
    "record": lambda ds: ds.record,
    "env": lambda ds: ds.record.env,
    "task": Dataset.kitchen_task,
}


def read_source(dataset: str) -> Iterator[tuple[str, Any]]:
    """Read what relabeling reads: numbers, and frames unless they are rendered."""
    source = open_source(dataset)
    yield "source", [source.trajectories.dataset_id, list(source.trajectories.n_steps), source.frames.views]
    yield "source's fingerprint", source.trajectories.fingerprint()
    yield "source's rewards", source.trajectories.rewards_to_keep()
    if source.frames.describe()["kind"] == "pictures":
        for i in range(len(source.trajectories.n_steps)):
            yield f"digest {i}", source.frames.digest(i)
            yield f"frames {i}", [frame for frames in source.frames.read(i) for frame in frames]


def read_everything(dataset: str) -> dict[str, str]:
    """Return a digest of each part that can be read; raises the first refusal if none can."""
    found: dict[str, str] = {}
    refusals: list[ZestError] = []

    @contextmanager
    def noted() -> Iterator[None]:
        try:
            yield
        except ZestError as error:
            refusals.append(error)

    if reader.DATASET_ID.fullmatch(dataset):
        with noted(), open_dataset(dataset) as ds:
            for name, read in READS.items():
                with noted():
                    found[name] = digest(read(ds))
    with noted():
        for name, value in read_source(dataset):
            found[name] = digest(value)
    if not found:
        raise refusals[0]
    return found


def damaged_document(data: bytes, rng: random.Random) -> bytes:
    """Return a JSON file with other values, in the documents that it holds as strings, too; or with damaged bytes."""
    document = json.loads(data)
    inner = [name for name, value in document.items() if isinstance(value, str) and value.startswith("{")]
    kind = rng.randrange(4)
    if kind == 0:
        return damaged_bytes(data, rng)
    if kind == 1 and inner:
        name = rng.choice(inner)
        document[name] = json.dumps(damaged_json(json.loads(document[name]), rng))
        return json.dumps(document).encode()
    return json.dumps(damaged_json(document, rng)).encode()


DAMAGES: dict[str, tuple[str, str, bool]] = {
    "manifest, arrays": (KITCHEN, DATA_FILE, True),
    "manifest, metadata": (KITCHEN, METADATA_FILE, True),
    "manifest itself": (KITCHEN, MANIFEST_FILE, True),
    "arrays": (KITCHEN, DATA_FILE, False),
    "arrays with pictures": (PICTURED, DATA_FILE, False),
    "metadata": (KITCHEN, METADATA_FILE, False),
    "metadata with spaces": (PICTURED, METADATA_FILE, False),
    "robomimic": ("robomimic.hdf5", "", False),
}


@pytest.fixture(scope="module")
def datasets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Minari root, which holds a robomimic file, too."""
    root = tmp_path_factory.mktemp("datasets")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        write_kitchen()
        write_pictured()
        write_robomimic(root / "robomimic.hdf5")
    return root


@pytest.mark.parametrize("n_inputs", N_INPUTS)
@pytest.mark.parametrize("name", DAMAGES)
def test_damage_is_refused_or_harmless_and_never_wrong_where_there_is_a_manifest(
    name: str, n_inputs: int, datasets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset, file, with_manifest = DAMAGES[name]
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    shutil.copytree(datasets, tmp_path / "minari")
    path = tmp_path / "minari" / dataset / file
    if not with_manifest:
        (tmp_path / "minari" / dataset / MANIFEST_FILE).unlink(missing_ok=True) if file else None
    dataset = dataset if file else str(path)
    clean, content = read_everything(dataset), path.read_bytes()
    assert len(clean) > 3
    damage = damaged_document if path.suffix == ".json" else damaged_bytes

    def read_damaged(seed: int) -> dict[str, str]:
        path.write_bytes(damage(content, random.Random(seed)))
        return read_everything(dataset)

    ends = outcomes(read_damaged, n_inputs)
    counts, wrong = faults(ends)
    assert not wrong, f"{counts}: {wrong[:3]}"
    read = [ast.literal_eval(one.detail) for one in ends if one.kind == "read"]
    others = [found for found in read if not found.items() <= clean.items()]
    print(f"{name}: {n_inputs} inputs, {dict(counts)}, {len(others)} with other data")
    if with_manifest:
        assert not others
