"""The folder of what was computed before: this user's own, because what it holds is taken for true."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

from zest_rl.errors import Notice, ZestError
from zest_rl.runtime import artifacts


def cache_folder(*names: str) -> Path:
    """Return a folder below `artifacts.cache_dir`, made for this user alone (mode 0700) if it is not there.

    A folder that its group may write to, as the umask 002 left it, becomes this user's alone; a `Notice` says so.

    Raises:
        ZestError: it cannot be made, belongs to someone else, or everybody may write to it.
    """
    path = artifacts.cache_dir()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for step in ("", *names):
            path /= step
            path.mkdir(mode=0o700, exist_ok=True)
            if check_private(path) & 0o020:
                path.chmod(0o700)
                if not step:
                    warnings.warn(f"the cache {path}, which its group could write to, is yours alone now", Notice, 2)
    except OSError as error:
        raise ZestError(
            f"the cache {path} cannot be used: {error.strerror}; set ZEST_CACHE to a folder of your own"
        ) from error
    return path


def check_private(folder: Path) -> int:
    """Return the mode of a folder that only this user, or its group, can write to.

    Raises:
        ZestError: it belongs to someone else, or everybody may write to it.
    """
    status = folder.stat()
    if status.st_uid != os.geteuid():
        raise ZestError(
            f"the cache {folder} belongs to user {status.st_uid} and not to you (user {os.geteuid()}), so its numbers "
            "may be anyone's; set ZEST_CACHE to a folder of your own"
        )
    if status.st_mode & 0o002:
        raise ZestError(
            f"everybody can write to the cache {folder} (mode {status.st_mode & 0o777:o}), so its numbers may be "
            f"anyone's; if you trust them: chmod -R go-w {folder}, else delete it"
        )
    return status.st_mode
