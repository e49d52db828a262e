"""Too little memory: how errors say so, and the limit of the address space, in which libraries crash without a word."""

from __future__ import annotations

import resource

from zest_rl.errors import ZestError

GL, TORCH = 2 * 2**30, 6 * 2**30
"""What a GL library in software, and torch beside it, map in bytes; less than half of it is ever used."""

_WORDS = ("failed to map segment", "allocate memory", "out of memory")  # of the loader, the system and torch, CUDA


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says, under whatever type, that there was too little memory."""
    return isinstance(error, MemoryError) or any(words in str(error) for words in _WORDS)


def check_address_space(library: str, n_bytes: int) -> None:
    """Check that this process may map as much as a library needs.

    Raises:
        ZestError: the limit is lower.
    """
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY and limit < n_bytes:
        raise ZestError(
            f"{library} needs {n_bytes / 2**30:.0f} GB of address space and crashes with less, and this shell allows a "
            f"process {limit / 2**30:.1f} GB; raise the limit (ulimit -v unlimited), or ask the cluster for more memory"
        )
