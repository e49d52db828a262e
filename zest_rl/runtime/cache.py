"""The folder of what was computed before: this user's own, because what it holds is taken for true."""

from __future__ import annotations

import os
from pathlib import Path

from zest_rl.errors import ZestError
from zest_rl.runtime import artifacts


def cache_folder(*names: str) -> Path:
    """Return a folder below `artifacts.cache_dir`, made for this user alone (mode 0700) if it is not there.

    Raises:
        ZestError: it cannot be made, belongs to someone else, or others may write to it.
    """
    path = artifacts.cache_dir()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for step in ("", *names):
            path /= step
            path.mkdir(mode=0o700, exist_ok=True)
            check_private(path)
    except OSError as error:
        raise ZestError(
            f"the cache {path} cannot be used: {error.strerror}; set ZEST_CACHE to a folder of your own"
        ) from error
    return path


def check_private(folder: Path) -> None:
    """Check that only this user can write to a folder.

    Raises:
        ZestError: it belongs to someone else, or others may write to it.
    """
    status = folder.stat()
    if status.st_uid != os.geteuid():
        raise ZestError(
            f"the cache {folder} belongs to user {status.st_uid} and not to you (user {os.geteuid()}), so its numbers "
            "may be anyone's; set ZEST_CACHE to a folder of your own"
        )
    if status.st_mode & 0o022:
        raise ZestError(
            f"others can write to the cache {folder} (mode {status.st_mode & 0o777:o}), so its numbers may be anyone's;"
            f" if you trust them: chmod -R go-w {folder}, else delete it"
        )
