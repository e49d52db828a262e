"""Files that users give and that data name: they lie where they may, and hold content of their own."""

from __future__ import annotations

import stat
from pathlib import Path

from zest_rl.errors import BadInput

_LFS_POINTER = b"version https://git-lfs.github.com/spec/"


def user_path(text: str | Path) -> Path:
    """Return the path that a user typed; ``~`` and ``~name`` are home folders where these are known."""
    try:
        return Path(text).expanduser()
    except RuntimeError:
        return Path(text)


def check_file(path: Path) -> None:
    """Refuse what no parser should see: no regular file (a pipe, ``/dev/zero``), empty, or a Git LFS pointer.

    Raises:
        BadInput: the file is one of these, is missing, or may not be read; the message says what to do.
    """
    try:
        is_file, start = stat.S_ISREG(path.stat().st_mode), b""
        if is_file:
            with path.open("rb") as file:
                start = file.read(len(_LFS_POINTER))
    except PermissionError as error:
        raise BadInput(f"{path} may not be read; change its permissions") from error
    except (OSError, ValueError) as error:  # also names that no file can have
        raise BadInput(f"{path} does not exist; check the path, or download it again") from error
    if not is_file:
        raise BadInput(f"{path} is not a file; give the path of a file")
    if not start:
        raise BadInput(f"{path} is empty (0 bytes); copy or download it again")
    if start == _LFS_POINTER:
        raise BadInput(
            f"{path} is a Git LFS pointer, not the file itself; run `git lfs install` and `git lfs pull` in its folder"
        )


def is_there(path: Path) -> bool:
    """Whether something has this name; no error for names that nothing can have."""
    try:
        path.stat()
    except (OSError, ValueError):
        return False
    return True


def path_under(root: Path, name: str) -> Path:
    """Return where a file is that data in a folder name, whether or not it exists.

    The name itself may not leave the folder. Links in the folder may: downloads of the Hugging Face Hub keep a
    snapshot's files in ``../../blobs``.

    Args:
        root: the folder that the data came in.
        name: relative to it.

    Raises:
        BadInput: the name is absolute or goes up.
    """
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise BadInput(f"{root} names the file {name[:200]!r}, which is outside that folder; do not use this download")
    return root / name


def file_under(root: Path, name: str) -> Path:
    """Return the file that data in a folder name.

    Raises:
        BadInput: as in `path_under`, or the file is one that `check_file` refuses.
    """
    path = path_under(root, name)
    check_file(path)
    return path
