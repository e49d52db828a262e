"""Pictures per second of embedders on one CPU thread, preprocessing included: the figures of docs/embedders.md.

Speed does not depend on the values of weights, so all but the embedded default run on random ones here; nothing else in
this project does. 224×224 pictures in batches of 8, CPU time, the best of three.

The default is also computed by ONNX Runtime, in turn with torch's eager mode; both have batch norms folded into the
convolutions. Pictures per second include the preprocessing, the ratios are those of the networks alone: to torch in
batches of 8, and in those in which it is fastest here.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import timm
import torch
from timm.data.config import resolve_model_data_config
from timm.data.transforms_factory import create_transform

from zest_rl.embedders import lite0
from zest_rl.embedders.checkpoints import installed_weights
from zest_rl.embedders.networks import Network, build_lite0

BATCH, REPEATS = 8, 3
TORCH_BATCHES = (1, 2, 4, BATCH)
REQUIRED_RATIO = 1.9


def _timm(name: str) -> Network:
    module = timm.create_model(name, pretrained=False, num_classes=0)
    return Network(module, create_transform(**resolve_model_data_config(module)), module)


def _open_clip(name: str) -> Network:
    import open_clip

    module, _, preprocess = open_clip.create_model_and_transforms(name)
    return Network(module, preprocess, module.encode_image)


def _resnet50() -> Network:
    from torchvision import models

    module = models.resnet50(weights=None)
    module.fc = torch.nn.Identity()
    return Network(module, models.ResNet50_Weights.DEFAULT.transforms(), module)


NETWORKS: dict[str, Callable[[], Network]] = {
    "efficientnet-lite0": lambda: build_lite0(installed_weights()),
    "torchvision:resnet50, moco": _resnet50,
    "open_clip:ViT-B-32": lambda: _open_clip("ViT-B-32"),
    "open_clip:ViT-B-16": lambda: _open_clip("ViT-B-16"),
    "timm:vit_base_patch16_siglip_224": lambda: _timm("vit_base_patch16_siglip_224"),
    "timm:vit_small_patch16_dinov3": lambda: _timm("vit_small_patch16_dinov3"),
    "timm:vit_small_patch14_dinov2": lambda: _timm("vit_small_patch14_dinov2"),
}


def pictures_per_second(network: Network, frames: list[np.ndarray]) -> float:
    """Measure one network."""
    seconds = []
    with torch.inference_mode():
        network.embed_frames(frames)
        for _ in range(REPEATS):
            start = time.process_time()
            network.embed_frames(frames)
            seconds.append(time.process_time() - start)
    return len(frames) / min(seconds)


def onnx_runtime(frames: list[np.ndarray]) -> tuple[float, dict[int, float]]:
    """Return the default's pictures per second by ONNX Runtime, and its speed relative to torch's, by torch's batch."""
    eager = build_lite0(installed_weights()).place(torch.device("cpu"), torch.float32)
    session = lite0.load(installed_weights(), one_thread=True)
    pixels = lite0.batch(frames)
    last = torch.from_numpy(pixels).to(memory_format=torch.channels_last)

    def by_torch(batch: int) -> None:
        for part in last.split(batch):
            eager.encode_images(part)

    ways: dict[object, Callable[[], Any]] = {
        "onnx": lambda: session(pixels),
        "whole": lambda: session(lite0.batch(frames)),
        **{batch: partial(by_torch, batch) for batch in TORCH_BATCHES},
    }
    seconds: dict[object, list[float]] = {name: [] for name in ways}
    with torch.inference_mode():
        for _ in range(1 + 3 * REPEATS):
            for name, embed in ways.items():
                start = time.process_time()
                embed()
                seconds[name].append(time.process_time() - start)
    best = {name: min(each[1:]) for name, each in seconds.items()}  # the first of each only warms up
    return len(frames) / best["whole"], {batch: best[batch] / best["onnx"] for batch in TORCH_BATCHES}


def run() -> dict[str, Any]:
    """Measure all, in fp32 and bf16."""
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 256, (224, 224, 3), dtype=np.uint8) for _ in range(BATCH)]
    found: dict[str, Any] = {}
    for name, make in NETWORKS.items():
        network = make()
        size = sum(parameter.numel() for parameter in network.module.parameters()) / 1e6
        fp32 = pictures_per_second(network.place("cpu", torch.float32), frames)
        bf16 = pictures_per_second(network.place("cpu", torch.bfloat16), frames)
        found[name] = f"D {network.dim}, {size:.0f} M weights, {fp32:.1f} fp32, {bf16:.1f} bf16 pictures/s"
    per_second, ratios = onnx_runtime(frames)
    found["efficientnet-lite0 by ONNX Runtime"] = (
        f"{per_second:.1f} fp32 pictures/s, {ratios[BATCH]:.2f} × torch's eager mode in batches of {BATCH}, "
        f"{min(ratios.values()):.2f} × at its fastest, in batches of {min(ratios, key=ratios.__getitem__)}"
    )
    return {**found, "required_ratio": REQUIRED_RATIO, "passed": min(ratios.values()) >= REQUIRED_RATIO}
