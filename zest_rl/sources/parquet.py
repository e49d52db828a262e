"""Parquet files of other people: tables and columns of numbers, or an error that says what is wrong with which file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from zest_rl.errors import BadInput
from zest_rl.runtime.files import check_file
from zest_rl.types import FloatArray

MAX_ROWS = 10**8
"""Of one file, far beyond any of LeRobot, which has at most 100 MB: more is damage."""


@contextmanager
def open_parquet(path: Path, max_rows: int) -> Iterator[Any]:
    """Open a file for as long as the context lasts; the context may read from it, and nothing else.

    Args:
        path: the file.
        max_rows: more are refused by the header alone: a file of a few kB can unpack to terabytes.

    Yields:
        A `pyarrow.parquet.ParquetFile`.

    Raises:
        BadInput: the file is missing, damaged, a Git LFS pointer, too long or larger than memory; or pyarrow is not
            installed.
    """
    try:
        import pyarrow.parquet
    except ImportError as error:
        raise BadInput("LeRobot's parquet files need pyarrow: pip install 'zest-rl[lerobot]'") from error
    check_file(path)
    try:
        with path.open("rb") as file:  # Arrow itself takes names in UTF-8 only, whatever the locale
            opened = pyarrow.parquet.ParquetFile(file)
            n_rows = opened.metadata.num_rows
            if not 0 <= n_rows <= max_rows:
                raise BadInput(f"{path} says that it has {n_rows} rows, at most {max_rows} are read; download it again")
            yield opened
    except BadInput:
        raise
    except MemoryError as error:
        raise BadInput(f"{path} needs more memory than there is ({error}); free some") from error
    except Exception as error:  # on damaged files Arrow raises many kinds
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise BadInput(f"{path} cannot be read as parquet ({reason}); download it again") from error


def read_table(path: Path, columns: Sequence[str], max_rows: int) -> Any:
    """Read columns as a `pyarrow.Table`; arguments and errors as in `open_parquet`.

    Raises:
        BadInput: also if the file lacks a column, or has two of a name.
    """
    with open_parquet(path, max_rows) as file:
        names = file.schema_arrow.names
        if missing := [name for name in columns if name not in names]:
            raise BadInput(f"{path} has no column {missing[0]!r}, got {', '.join(names)[:300]}; download it again")
        if double := [name for name in columns if names.count(name) > 1]:
            raise BadInput(
                f"{path} has {names.count(double[0])} columns {double[0]!r}; leave one, or download it again"
            )
        return file.read(columns=list(columns))


def as_numbers(values: Any, what: str) -> FloatArray:
    """Turn an Arrow column of T >= 1 numbers, or of equally long lists of them, into (T, n) float32.

    Raises:
        BadInput: values are missing, no numbers, or lists of different lengths; `what` names them.
    """
    import pyarrow.compute
    import pyarrow.types

    array: Any = values.combine_chunks()
    is_list = (pyarrow.types.is_list, pyarrow.types.is_large_list, pyarrow.types.is_fixed_size_list)
    flat = array.flatten() if any(known(array.type) for known in is_list) else array
    is_number = (pyarrow.types.is_integer, pyarrow.types.is_floating, pyarrow.types.is_boolean)
    if not any(known(flat.type) for known in is_number):
        raise BadInput(f"{what} must hold numbers or lists of them, got {array.type}; leave it out of info.json")
    if array.null_count or flat.null_count:
        row = pyarrow.compute.index(pyarrow.compute.is_null(array), True).as_py()
        at = f"at step {row}" if array.null_count else "in a list"
        raise BadInput(f"{what} has no value {at}; fill it, or leave out the episode")
    lengths = [1] if flat is array else pyarrow.compute.list_value_length(array).unique().to_pylist()
    if lengths == [0] or len(lengths) > 1:
        raise BadInput(f"{what} must hold equally long lists, of 1 number at least, got lengths {sorted(lengths)[:5]}")
    return np.asarray(flat.to_numpy(zero_copy_only=False), np.float32).reshape(len(array), -1)
