"""Pictures per second of embedders' networks alone, with the input on the device: the most that a GPU can give."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import product
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from zest_rl.embedders import DEFAULT_EMBEDDER
from zest_rl.embedders.checkpoints import installed_weights
from zest_rl.embedders.networks import Network, build_lite0
from zest_rl.types import Frame

Encode = Callable[[Tensor], Tensor]


def _vit_b_32() -> Network:
    import open_clip

    module, _, preprocess = open_clip.create_model_and_transforms("ViT-B-32")
    return Network(module, preprocess, module.encode_image)


NETWORKS: dict[str, Callable[[], Network]] = {
    DEFAULT_EMBEDDER: lambda: build_lite0(installed_weights()),
    "open_clip:ViT-B-32": _vit_b_32,
}
DTYPES = {"fp32": torch.float32, "tf32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}
LAYOUTS = {"": torch.channels_last, "_nchw": torch.contiguous_format}
COMPILED = (("fp32", 64),)
"""Precisions and batches that are also compiled, which takes ten seconds each."""


def eager(encode: Encode, pixels: Tensor) -> Callable[[], Any]:
    """Call the network."""
    return lambda: encode(pixels)


def graph(encode: Encode, pixels: Tensor) -> Callable[[], Any]:
    """Replay what the network did to the GPU."""
    side = torch.cuda.Stream()  # type: ignore[no-untyped-call]
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):  # what is chosen and allocated at the first calls must not be captured
        for _ in range(3):
            encode(pixels)
    torch.cuda.current_stream().wait_stream(side)
    captured = torch.cuda.CUDAGraph()
    with torch.cuda.graph(captured):
        encode(pixels)
    return captured.replay


def compiled(encode: Encode, pixels: Tensor) -> Callable[[], Any]:
    """Replay what the compiled network did to the GPU."""
    return graph(torch.compile(encode, dynamic=False), pixels)


def pictures_per_s(
    network: Network, frames: Sequence[Frame], device: torch.device, batches: Sequence[int], seconds: float
) -> dict[str, Any]:
    """Return pictures per second by precision, mode, memory layout and batch; `seconds` is the time for each.

    There are at least as many frames as the largest of `batches`. On a CPU only what runs there is measured.
    """
    images = torch.stack([network.preprocess(Image.fromarray(frame)) for frame in frames[: max(batches)]])
    rates: dict[str, Any] = {}
    on_gpu = device.type == "cuda"
    for precision, (suffix, layout) in product(DTYPES if on_gpu else ("fp32",), LAYOUTS.items()):
        network.place(device, DTYPES[precision]).module.to(memory_format=layout)
        for batch, mode in product(batches, (eager, graph, compiled) if on_gpu else (eager,)):
            if mode is compiled and ((precision, batch) not in COMPILED or suffix):
                continue
            key = f"{precision}_{mode.__name__}{suffix}_{batch}"
            with torch.inference_mode(), _tf32(precision == "tf32"):
                try:
                    pixels = images[:batch].to(device, DTYPES[precision], memory_format=layout)
                    rates[key] = round(batch * _calls_per_s(mode(network.encode_images, pixels), on_gpu, seconds), 1)
                except Exception as error:  # no C compiler, say
                    rates[key] = f"{type(error).__name__}: {error}"[:200]
    return rates


@contextmanager
def _tf32(allowed: bool) -> Iterator[None]:
    torch.backends.cuda.matmul.allow_tf32 = allowed
    with torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=allowed):
        yield
    torch.backends.cuda.matmul.allow_tf32 = False


def _calls_per_s(call: Callable[[], Any], on_gpu: bool, seconds: float) -> float:
    call()
    wait = torch.cuda.synchronize if on_gpu else bool
    wait()
    n, start = 0, time.perf_counter()
    while n == 0 or time.perf_counter() - start < seconds:
        for _ in range(5):
            call()
        wait()
        n += 5
    return n / (time.perf_counter() - start)
