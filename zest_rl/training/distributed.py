"""Several processes, one training: the processes of ``torchrun`` share every batch and average their gradients.

All of them draw the same batch and each keeps a share of its rows, so that a training does not depend on the number of
processes: the batch size is that of all together, and if only the batches are random (no dropout), the weights agree
with those of one process up to rounding.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import TYPE_CHECKING, Any

from zest_rl.errors import BadInput, ZestError

if TYPE_CHECKING:  # the command line calls `launched` before it imports heavy packages
    import torch
    from torch import Tensor

PATIENCE = timedelta(hours=1)
"""How long a process waits for the others, of which the slowest may read its data from a busy disk."""


@dataclass(frozen=True)
class Group:
    """The processes of one training, as seen by one of them; a single process is a group of size 1."""

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this is the process that writes files and reports progress."""
        return self.rank == 0

    def share(self, batch: dict[str, Tensor]) -> tuple[dict[str, Tensor], float]:
        """Return this process's rows of a batch, and the weight of its loss.

        The mean of all processes' weighted losses is the loss of the whole batch. A loss averages over rows or, if the
        batch has ``valid``, over the elements where that is true.

        Raises:
            BadInput: there are fewer rows than processes.
        """
        if self.size == 1:
            return batch, 1.0
        n_rows = len(next(iter(batch.values())))
        if n_rows < self.size:
            raise BadInput(
                f"the batch size must be at least the number of processes, got {n_rows} for {self.size}; choose a "
                "larger --batch-size, which is that of all processes together"
            )
        share = {name: rows[self.rank :: self.size] for name, rows in batch.items()}
        if "valid" in batch:
            return share, float(self.size * share["valid"].sum() / batch["valid"].sum())
        return share, self.size * len(next(iter(share.values()))) / n_rows

    def average(self, tensors: Sequence[Tensor]) -> None:
        """Replace each tensor by its mean over the processes, which all pass the same shapes in the same order.

        Raises:
            ZestError: another process is gone.
        """
        if self.size == 1:
            return
        import torch
        import torch.distributed as dist

        flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
        with _naming_lost_processes():
            dist.all_reduce(flat)
        sizes = [tensor.numel() for tensor in tensors]
        parts = (flat / self.size).split(sizes)  # type: ignore[no-untyped-call]
        for tensor, part in zip(tensors, parts, strict=True):
            tensor.copy_(part.view_as(tensor))

    def agree(self, **facts: Any) -> None:
        """Wait for all processes and check that `facts` are equal in all of them.

        Raises:
            ZestError: they differ, or another process is gone.
        """
        if self.size == 1:
            return
        import torch.distributed as dist

        gathered: list[Any] = [None] * self.size
        with _naming_lost_processes():
            dist.all_gather_object(gathered, facts)
        for rank, theirs in enumerate(gathered):
            differing = [
                f"{name} is {gathered[0][name]!r} and {theirs[name]!r}" for name in facts if theirs != gathered[0]
            ]
            if differing:
                raise ZestError(
                    f"the processes of a training must have the same data and the same run folder, but for the first "
                    f"and number {rank}, {'; '.join(differing)}; on several machines use a folder that all share"
                )


@contextmanager
def _naming_lost_processes() -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:  # gloo and NCCL have no finer kind
        raise ZestError(f"another process of this training is gone, and says why ({error})") from error


def launched() -> Group:
    """Return this process's rank and the number of processes, as ``torchrun`` sets them."""
    return Group(int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1)))


def local_index() -> int:
    """Return the index of this process on its machine, which is also the index of its GPU."""
    return int(os.environ.get("LOCAL_RANK", 0))


def _die_with_torchrun(parent: int) -> None:
    """End this process when torchrun is killed: nothing else would end it."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def process_group(device: torch.device) -> Iterator[Group]:
    """Join the processes that ``torchrun`` started while the context is open; a single process does nothing."""
    group = launched()
    if group.size == 1:
        yield group
        return
    _die_with_torchrun(os.getppid())
    import torch
    import torch.distributed as dist

    if device.type == "cuda":
        torch.cuda.set_device(device)
    with _naming_lost_processes():
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=PATIENCE)
    try:
        yield group
    finally:
        dist.destroy_process_group()
