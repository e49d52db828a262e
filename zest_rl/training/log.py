"""The log of a training: ``metrics.csv`` for programs, ``tb/`` for TensorBoard; both hold the same rows."""

from __future__ import annotations

import csv
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from torch.utils.tensorboard import SummaryWriter

from zest_rl.runtime import artifacts
from zest_rl.runtime.records import reading_record

COLUMNS = ("update", "loss", "grad_norm", "learning_rate", "updates_per_s")
"""Of a training on a dataset. The first column of a log counts."""


class MetricsLog:
    """Appends rows to the log of a run; use it as a context manager."""

    def __init__(self, run_dir: Path, n_done: int, columns: Sequence[str] = COLUMNS) -> None:
        """Open the log, and drop the rows that a killed run logged after `n_done`.

        Args:
            run_dir: the run's folder.
            n_done: what is done, as the first column counts it.
            columns: of the log.

        Raises:
            BadInput: what is there is no log.
        """
        path, header = run_dir / "metrics.csv", ",".join(columns)
        self._columns = columns[1:]
        with reading_record(path, "delete it to go on without the rows before this update"):
            lines = path.read_text(encoding="utf-8").splitlines() if path.exists() and n_done else []
            whole = [line for line in lines[1:] if line.count(",") == len(self._columns)]
            kept = [line for line in whole if int(line.partition(",")[0]) <= n_done]
        artifacts.write_bytes(path, "".join(f"{line}\n" for line in (header, *kept)).encode())
        if not n_done:
            shutil.rmtree(run_dir / "tb", ignore_errors=True)
        self._board = SummaryWriter(run_dir / "tb", purge_step=n_done + 1)
        self._file = path.open("a", newline="", encoding="utf-8")
        self._rows = csv.writer(self._file, lineterminator="\n")

    def write(self, update: int, row: Mapping[str, float]) -> None:
        """Append the values of the columns at an update; they are on disk when this returns."""
        self._rows.writerow([update, *(row[column] for column in self._columns)])
        self._file.flush()
        os.fsync(self._file.fileno())  # a checkpoint after this row must find it
        for column in self._columns:
            self._board.add_scalar(column, row[column], update)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._file.close()
        self._board.close()
