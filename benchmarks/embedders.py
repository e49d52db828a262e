"""Pictures per second of embedders on one CPU thread, preprocessing included: the figures of docs/embedders.md.

Speed does not depend on the values of weights, so all but the embedded default run on random ones here; nothing else in
this project does. 224×224 pictures in batches of 8, CPU time, the best of three.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import timm
import torch
from timm.data.config import resolve_model_data_config
from timm.data.transforms_factory import create_transform

from zest_rl.embedders.checkpoints import installed_weights
from zest_rl.embedders.networks import Network, build_lite0

BATCH, REPEATS = 8, 3


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
    return {**found, "passed": True}
