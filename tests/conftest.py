from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from tiny_dataset import COLLECTED, SHORT_HORIZON, collect_some

os.environ.setdefault("OMP_NUM_THREADS", "1")  # tests run in as many processes as there are cores
settings.register_profile("zest", deadline=None, derandomize=True)  # a busy machine is no failure
settings.load_profile("zest")
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background of a shell, and by all children


def pytest_configure() -> None:
    """Give each of several test processes a core of its own, so that commands there start no processes unasked."""
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    if worker is not None and hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[int(worker.removeprefix("gw")) % len(cores)]})


collect_ignore = ["interop"]
"""Tests against libraries that need environments of their own: `make test-interop`."""


@pytest.fixture(scope="session")
def visual_tasks() -> Path:
    """Folder of the Visual Tasks Dataset, which the project may not redistribute."""
    beside = Path(__file__).resolve().parent.parent.parent / "shared" / "visual_tasks_dataset"
    folder = Path(os.environ.get("ZEST_VISUAL_TASKS") or beside)
    if not folder.is_dir():
        pytest.skip("no Visual Tasks Dataset: set ZEST_VISUAL_TASKS to its folder")
    return folder


@pytest.fixture(scope="session")
def collected_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Minari root with `COLLECTED`: four noisy episodes of the expert, of which one fails. Read-only."""
    root = tmp_path_factory.mktemp("minari")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        collect_some(COLLECTED, "micro", 4)
    return root


@pytest.fixture
def collected(collected_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Id of the tiny dataset, in a Minari root and beside a cache of this test's own."""
    shutil.copytree(collected_root, tmp_path / "minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "cache"))
    return COLLECTED


@pytest.fixture(scope="session")
def trained_root(collected_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Minari root, a cache, and small policies trained on `COLLECTED` and a relabeled copy of it. Read-only.

    ``runs/``: bc-0 and bc-1 (two seeds) and dt-0 on the scores, gt-0 a Decision Transformer on the ground truth; all
    are evaluated for `SHORT_HORIZON` steps.
    """
    from zest_rl.agents import AGENTS
    from zest_rl.kitchen.views import Views
    from zest_rl.rewards.relabel import relabel_source
    from zest_rl.rewards.scorer import ScorerConfig
    from zest_rl.sources.kitchen import kitchen_source
    from zest_rl.training.loop import TrainingConfig
    from zest_rl.training.runs import train

    root = tmp_path_factory.mktemp("trained")
    shutil.copytree(collected_root, root / "minari")
    small = {"hidden_size": 32, "n_layers": 1, "warmup_updates": 0}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root / "minari"))
        patch.setenv("ZEST_CACHE", str(root / "cache"))
        views = Views("micro", n_views=1, size=96, tolerance=0.05)
        scored = relabel_source(kitchen_source(COLLECTED, views), ScorerConfig("same-scene"), n_workers=1).dataset_id
        for name, dataset in (("bc-0", scored), ("bc-1", scored), ("dt-0", scored), ("gt-0", COLLECTED)):
            agent, seed = "bc" if name.startswith("bc") else "dt", int(name[-1])
            config = TrainingConfig(n_updates=30, seed=seed, device="cpu", threads=1, log_every=10)
            train(agent, dataset, AGENTS[agent].config(**small), config, run_dir=root / "runs" / name)
    for path in root.glob("runs/*/meta.json"):
        meta = json.loads(path.read_text())
        spec = json.loads(meta["dataset"]["env_spec"]) | {"max_episode_steps": SHORT_HORIZON}
        meta["dataset"]["env_spec"] = json.dumps(spec)
        path.write_text(json.dumps(meta))
    return root


@pytest.fixture
def trained(trained_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder ``runs`` of `trained_root`, with the Minari root and the cache, for this test alone."""
    shutil.copytree(trained_root, tmp_path / "trained")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "trained" / "minari"))
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "trained" / "cache"))
    return tmp_path / "trained" / "runs"


@pytest.fixture(scope="module")
def short_videos() -> Iterator[None]:
    """Write the first 2 states of a video only."""
    from zest_rl.kitchen.videos import KitchenOverview
    from zest_rl.simulation import videos

    write_video = videos.write_video

    def short_video(video: videos.Video) -> Path:
        states = [{name: part[:2] for name, part in shown.items()} for shown in (video.states, video.beside) if shown]
        return write_video(videos.Video(states[0], video.path, KitchenOverview(64), *states[1:]))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(videos, "write_video", short_video)
        yield


@pytest.fixture
def zest(capsys: pytest.CaptureFixture[str]) -> Callable[..., dict[str, Any]]:
    """Run a verb that must succeed, and return its JSON document."""

    def run(*words: str | Path) -> dict[str, Any]:
        from zest_rl import cli

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
        from zest_rl import cli

        code = cli.main(list(map(str, words)))
        out, err = capsys.readouterr()
        assert out == ""
        assert "Traceback" not in err
        return code, err

    return run


@pytest.fixture
def adopt(trained: Path, zest: Callable[..., dict[str, Any]], tmp_path: Path) -> Callable[..., Path]:
    """Run `zest adopt` on the scored dataset with more flags, and give the run the short horizon."""
    from zest_rl.runtime import artifacts

    dataset = artifacts.read_json(trained / "bc-0" / "meta.json")["dataset"]

    def run(spec: str, *flags: str | Path) -> Path:
        if "--run-dir" not in flags:
            flags = (*flags, "--run-dir", tmp_path / f"run-{artifacts.hash_json(spec)[:6]}")
        made = Path(zest("adopt", spec, "--dataset", dataset["id"], *flags)["run"])
        meta = artifacts.read_json(made / "meta.json")
        meta["dataset"]["env_spec"] = dataset["env_spec"]
        artifacts.write_json(made / "meta.json", meta)
        return made

    return run


@pytest.fixture
def server(tmp_path: Path) -> Callable[[str], str]:
    """Write a program that leaves its process id in ``tmp_path / "pid"``, then runs `code`; return its policy spec."""

    def write(code: str) -> str:
        path = tmp_path / "server.py"
        path.write_text(
            f"import os, json, sys, time\nopen({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid()))\n{code}"
        )
        return f"command:{shlex.quote(sys.executable)} -I {shlex.quote(str(path))}"

    return write


@dataclass(frozen=True)
class Disk:
    """A file system of its own in memory."""

    path: Path

    def fill(self, free: int) -> None:
        """Leave `free` bytes."""
        size = shutil.disk_usage(self.path).free - free
        (self.path / "ballast").write_bytes(bytes(size))

    def make_read_only(self) -> None:
        subprocess.run(["mount", "-o", "remount,ro", str(self.path)], check=True)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Disk]:
    """An empty disk of 8 MB that a test may fill or make read-only."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("mounting a small disk needs root and a system that permits it")
    try:
        yield Disk(folder)
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)
