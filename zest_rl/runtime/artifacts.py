"""Artifacts on disk: atomic writes, content hashes, locks, provenance.

A file or folder under its final name is complete. Everything is built under a temporary name in the same folder and
renamed once, so an interruption at any point leaves either the old artifact or the new one. Temporary files that a
killed process left are removed by the next process that writes to their folder.
"""

from __future__ import annotations

import errno
import functools
import hashlib
import importlib.metadata
import json
import os
import platform
import re
import secrets
import shutil
import subprocess
import sys
import time
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zest_rl.errors import Notice, ZestError
from zest_rl.runtime.files import check_file
from zest_rl.runtime.privacy import masked

PACKAGES = (
    "torch", "torchvision", "timm", "open_clip_torch", "transformers", "gymnasium", "gymnasium-robotics", "mujoco",
    "minari", "h5py", "numpy", "scipy", "pillow", "safetensors", "onnxruntime",
)  # fmt: skip


FOLDERS = {"MINARI_DATASETS_PATH": (".minari", "datasets"), "ZEST_CACHE": (".cache", "zest_rl")}
"""Variables that name folders, and where these are in the home folder without the variable."""
PATIENCE = 1.0
"""Seconds of waiting for a lock after which the user is told."""
_TEMPORARY = re.compile(r"\..+\.([0-9a-f]{8})-(\d{1,9})-[0-9a-f]{8}\.tmp.*")
"""Of `atomic_path`: the machine and the process that write the file."""
_A_DAY = 86_400.0


def folder_of(variable: str) -> Path:
    """Return the folder that one of `FOLDERS` names, by default below the home folder. Not created here.

    Raises:
        ZestError: the variable is not set, and there is no home folder.
    """
    if value := os.environ.get(variable):
        return Path(value)
    try:
        return Path.home().joinpath(*FOLDERS[variable])
    except RuntimeError as error:
        raise ZestError(
            f"this account has no home folder; set HOME, or each of {' and '.join(FOLDERS)}, to a folder that can be "
            "written to"
        ) from error


def cache_dir() -> Path:
    """Return the folder of recomputable files: ``$ZEST_CACHE``, else ``~/.cache/zest_rl``. Not created here."""
    return folder_of("ZEST_CACHE")


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


def _cannot_write(path: Path, error: OSError) -> ZestError:
    """Say why, and which variable or argument chooses another folder."""
    variable = next((name for name in FOLDERS if _is_below(path, name)), None)
    choice = f"set {variable} to" if variable else "choose"
    if error.errno in (errno.ENOLCK, errno.EOPNOTSUPP):
        return ZestError(
            f"the file system of {path.parent} has no file locks ({error.strerror}), without which two commands could "
            f"write {path.name} at once; {choice} a folder on another file system, or mount this one with locks (NFS: "
            "without the option nolock)"
        )
    return ZestError(f"cannot write {path}: {error.strerror or error}; {choice} a folder that can be written to")


def _is_below(path: Path, variable: str) -> bool:
    try:
        return path.absolute().is_relative_to(folder_of(variable).absolute())
    except ZestError:  # no home folder
        return False


@functools.cache
def _machine() -> str:
    """Tell apart machines, even of one name, and containers, whose process ids mean different processes."""
    namespace, boot = Path("/proc/self/ns/pid"), Path("/proc/sys/kernel/random/boot_id")
    return hash_json([
        platform.node(),
        str(namespace.readlink()) if namespace.exists() else "",
        boot.read_text(encoding="utf-8") if boot.exists() else "",
    ])[:8]  # fmt: skip


def _is_stale(file: os.DirEntry[str]) -> bool:
    """Whether the process that wrote a temporary file is gone; one of another machine is after an idle day."""
    match = _TEMPORARY.fullmatch(file.name)
    if match is None:
        return False
    machine, process = match.groups()
    if machine != _machine():
        try:
            return time.time() - file.stat().st_mtime > _A_DAY
        except FileNotFoundError:  # it has just been renamed
            return False
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return True
    except PermissionError:  # of another user
        return False
    return False


@functools.lru_cache(maxsize=1024)
def _remove_stale(folder: Path) -> None:
    """Remove the stale temporary files of a folder, once per process: a cache may have many files."""
    for file in filter(_is_stale, os.scandir(folder)):
        Path(file).unlink(missing_ok=True)


def _new_temporary(path: Path) -> Path:
    """Make an empty file beside `path`, with the permissions of any new file, and remove the stale ones there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_stale(path.parent.absolute())
    temporary = path.with_name(f".{path.name}.{_machine()}-{os.getpid()}-{secrets.token_hex(4)}.tmp")
    os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
    return temporary


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it is flushed and renamed to `path`, on failure removed.

    Raises:
        ZestError: the folder cannot be written to (read-only, full).
    """
    try:
        temporary = _new_temporary(path)
    except OSError as error:
        raise _cannot_write(path, error) from error
    try:
        yield temporary
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
    if not path.exists():
        raise ZestError(f"{path} does not exist; was the stage before this one run to its end?")
    check_file(path)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ZestError(f"{path} cannot be read as JSON: {error}") from error


def read_checked(path: Path, sha256: str, advice: str) -> bytes:
    """Read a file whose hash is known.

    Raises:
        ZestError: it cannot be read, or is another one.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ZestError(f"cannot read {path}: {error.strerror}; {advice}") from error
    if hash_bytes(data) != sha256:
        raise ZestError(f"{path} is damaged: its sha256 is {hash_bytes(data)}, meta.json says {sha256}; {advice}")
    return data


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
        raise _cannot_write(final, error) from error
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
    """Hold the lock of an artifact; a second process says that it waits (a killed one frees its lock). May be nested.

    The file is deleted at the end; filelock takes a new one where the one that it waited for is gone.

    Raises:
        ZestError: the folder cannot be written to, or its file system has no locks.
    """
    from filelock import FileLock, Timeout

    path = target.parent / f".{target.name}.lock"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        held = FileLock(path, is_singleton=True)
        try:
            held.acquire(timeout=PATIENCE)
        except Timeout:
            warnings.warn(f"waiting for {path}, which another command holds until {target} is written", Notice, 3)
            held.acquire()
    except OSError as error:
        raise _cannot_write(target, error) from error
    try:
        yield
    finally:
        if held.lock_counter == 1:  # the outermost of nested ones
            with suppress(OSError):
                path.unlink()
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
    """Return command, versions, git revision and machine, JSON-ready, without folders and secrets (`masked`)."""
    return {
        "command": " ".join([Path(sys.argv[0]).name, *masked(sys.argv[1:])]),
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
