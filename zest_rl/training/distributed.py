"""Several processes, one training: the processes of ``torchrun`` share every batch and average their gradients.

All of them draw the same batch and keep a share of its rows each, so that a training means the same however many
processes it has: the batch size is that of all of them, and where nothing is random but the batches (no dropout), the
weights agree with those of one process but for rounding.
"""

from __future__ import annotations

import os
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
"""How long a process waits for the others: the slowest may read its data from a busy disk."""


@dataclass(frozen=True)
class Group:
    """The processes of one training, as one of them sees them. A process that is alone is a group, too."""

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this is the process that writes files and reports progress."""
        return self.rank == 0

    def share(self, batch: dict[str, Tensor]) -> tuple[dict[str, Tensor], float]:
        """Return this process's rows of a batch, and the weight of a loss that is an average over them.

        The mean of all processes' weighted losses is the loss of the whole batch. A loss averages over rows, or, where
        a batch has ``valid``, over its elements that are true.

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
        """Replace each tensor by its mean over the processes; all give the same shapes in the same order.

        Raises:
            ZestError: another process is gone.
        """
        if self.size == 1:
            return
        import torch
        import torch.distributed as dist

        flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
        with _others():
            dist.all_reduce(flat)
        sizes = [tensor.numel() for tensor in tensors]
        parts = (flat / self.size).split(sizes)  # type: ignore[no-untyped-call]
        for tensor, part in zip(tensors, parts, strict=True):
            tensor.copy_(part.view_as(tensor))

    def agree(self, **facts: Any) -> None:
        """Wait for all processes, and compare what must be equal in all of them.

        Raises:
            ZestError: they differ, or another process is gone.
        """
        if self.size == 1:
            return
        import torch.distributed as dist

        seen: list[Any] = [None] * self.size
        with _others():
            dist.all_gather_object(seen, facts)
        for rank, theirs in enumerate(seen):
            differing = [f"{name} is {seen[0][name]!r} and {theirs[name]!r}" for name in facts if theirs != seen[0]]
            if differing:
                raise ZestError(
                    f"the processes of a training must have the same data and the same run folder, but for the first "
                    f"and number {rank}, {'; '.join(differing)}; on several machines use a folder that all share"
                )


@contextmanager
def _others() -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:  # gloo and NCCL have no finer kind
        raise ZestError(f"another process of this training is gone, and says why ({error})") from error


def launched() -> Group:
    """Return what ``torchrun`` says of this process: its rank, and how many there are."""
    return Group(int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1)))


def local_index() -> int:
    """Index of this process among those of its machine, which is also that of its GPU."""
    return int(os.environ.get("LOCAL_RANK", 0))


@contextmanager
def joined(device: torch.device) -> Iterator[Group]:
    """Join the processes that ``torchrun`` started for as long as the context is open; alone, do nothing."""
    group = launched()
    if group.size == 1:
        yield group
        return
    import torch
    import torch.distributed as dist

    if device.type == "cuda":
        torch.cuda.set_device(device)
    with _others():
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=PATIENCE)
    try:
        yield group
    finally:
        dist.destroy_process_group()
