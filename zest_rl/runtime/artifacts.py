"""Artifacts on disk: atomic writes, content hashes, locks, provenance.

A file or folder under its final name is complete. Everything is built under a temporary name in the same folder and
renamed once, so an interruption at any point leaves either the old artifact or the new one.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zest_rl.errors import ZestError

PACKAGES = (
    "torch", "torchvision", "timm", "open_clip_torch", "transformers", "gymnasium", "gymnasium-robotics", "mujoco",
    "minari", "h5py", "numpy", "scipy", "pillow", "safetensors",
)  # fmt: skip


def cache_dir() -> Path:
    """Return the folder of recomputable files: ``$ZEST_CACHE``, else ``~/.cache/zest_rl``. Not created here."""
    return Path(os.environ.get("ZEST_CACHE") or Path.home() / ".cache" / "zest_rl")


def hash_bytes(data: bytes) -> str:
    """Return the sha256 of `data`, 64 hex digits."""
    return hashlib.sha256(data).hexdigest()


def hash_json(value: object) -> str:
    """Return the sha256 of `value` as canonical JSON (sorted keys), 64 hex digits."""
    return hash_bytes(json.dumps(value, sort_keys=True, separators=(",", ":")).encode())


def hash_arrays(*arrays: NDArray[Any]) -> str:
    """Return the sha256 over dtype, shape and bytes of all arrays, in order, 64 hex digits."""
    return hash_stream(arrays)


def hash_stream(arrays: Iterable[NDArray[Any]]) -> str:
    """Return the `hash_arrays` of arrays of which one at a time is in memory."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def hash_file(path: Path) -> str:
    """Return the sha256 of a file's bytes, 64 hex digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _fsync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it is flushed and renamed to `path`, on failure removed.

    Raises:
        ZestError: the folder cannot be written to (read-only, full).
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
        os.close(handle)
    except OSError as error:
        raise ZestError(f"cannot write {path}: {error.strerror}; choose a folder that can be written to") from error
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)
        _fsync(temporary)
        temporary.replace(path)
    except OSError as error:
        raise ZestError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file atomically, creating its folder."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_json(path: Path, value: object) -> None:
    """Write `value` as indented JSON, atomically."""
    write_bytes(path, (json.dumps(value, indent=2, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        ZestError: the file does not exist or is not JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ZestError(f"{path} does not exist; was the stage before this one run to its end?") from error
    except (OSError, ValueError) as error:
        raise ZestError(f"{path} cannot be read as JSON: {error}") from error


@contextmanager
def staged_folder(final: Path) -> Iterator[Path]:
    """Yield an empty staging folder beside `final`; on success it is renamed to `final`, on failure removed.

    Leftovers of a killed process are removed first; hold `lock` around this.

    Raises:
        ZestError: the folder cannot be written to (read-only, full), or `final` exists.
    """
    staging = final.parent / f".{final.name}.staging"
    try:
        shutil.rmtree(staging, ignore_errors=True)
        staging.mkdir(parents=True)
    except OSError as error:
        raise ZestError(f"cannot write {final}: {error.strerror}; choose a folder that can be written to") from error
    try:
        yield staging
        for path in [*staging.rglob("*"), staging]:
            _fsync(path)
        staging.rename(final)
        _fsync(final.parent)
    except OSError as error:
        raise ZestError(f"cannot write {final}: {error.strerror or error}; nothing was left behind") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)


@contextmanager
def lock(target: Path) -> Iterator[None]:
    """Hold the lock of an artifact; a second process waits (a killed process frees its lock). May be nested."""
    from filelock import FileLock

    path = target.parent / f".{target.name}.lock"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        held = FileLock(path, is_singleton=True)
        held.acquire()
    except OSError as error:
        raise ZestError(f"cannot write {target}: {error.strerror}; choose a folder that can be written to") from error
    try:
        yield
    finally:
        held.release()


def check_free_space(folder: Path, n_bytes: int) -> None:
    """Refuse to start a write of about `n_bytes` where it cannot fit (HDF5 crashes Python on a full disk).

    Raises:
        ZestError: less than `n_bytes` plus 64 MB is free on the disk of `folder`.
    """
    existing = next(p for p in (folder, *folder.parents) if p.exists())
    free, needed = shutil.disk_usage(existing).free, n_bytes + 64 * 2**20
    if free < needed:
        raise ZestError(
            f"not enough disk space at {existing}: {needed / 2**20:.0f} MB needed, {free / 2**20:.0f} MB free; "
            "free some or choose another folder"
        )


def git_revision() -> str | None:
    """Return the git commit of this source tree (``-dirty`` when changed), or None outside a checkout."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    try:
        out = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"],
            cwd=root, capture_output=True, text=True, timeout=10, check=True,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return None
    return out.stdout.strip()


def versions() -> dict[str, str]:
    """Return the versions of this package and of those of `PACKAGES` that are installed."""
    installed = {}
    for name in ("zest-rl", *PACKAGES):
        try:
            installed[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return installed


def provenance() -> dict[str, Any]:
    """Return command, versions, git revision and machine, JSON-ready, without host paths.

    The folders of absolute paths in the command are left out: ``--goal=/home/me/goals`` becomes ``--goal=…/goals``.
    """
    arguments = [re.sub(r"(?<![^=:@,])/(?!/)(?:[^,]*/)?", "…/", word) for word in sys.argv[1:]]
    return {
        "command": " ".join([Path(sys.argv[0]).name, *arguments]),
        "versions": versions(),
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        "git_revision": git_revision(),
    }


def shipped(kind: str) -> Path:
    """Return the folder of the recipes that come with the package: ``datasets``, ``train`` or ``eval``."""
    package = Path(__file__).resolve().parents[1]
    in_wheel = package / "recipes" / kind
    return in_wheel if in_wheel.exists() else package.parent / kind
