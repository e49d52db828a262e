"""Frames embedded per second of processor time: `zest_rl.embedders` against one frame at a time through timm.

Both run the same weights on the same 224x224 frames with one torch thread, preprocessing included. The peer is what
timm's documentation shows: fp32, one image per call. Ours is the default: batches, channels_last, bf16 where native.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from timm.data.transforms_factory import create_transform

from zest_rl.embedders import load_embedder
from zest_rl.embedders.checkpoints import LITE0_PREPROCESSING, installed_weights
from zest_rl.embedders.networks import build_lite0

REQUIRED_RATIO = 1.5
N_FRAMES = 64
N_ROUNDS = 3


def smooth_frames() -> list[NDArray[np.uint8]]:
    """Return N_FRAMES different (224, 224, 3) uint8 frames with large shapes, as renderings have."""
    coarse = np.random.default_rng(0).integers(0, 256, (N_FRAMES, 8, 8, 3), dtype=np.uint8)
    return [np.asarray(Image.fromarray(c).resize((224, 224), Image.Resampling.BICUBIC)) for c in coarse]


def frames_per_second(embed: Callable[[], object]) -> float:
    """Return the best of N_ROUNDS: the machine may be busy with other things."""
    embed()
    seconds = []
    for _ in range(N_ROUNDS):
        start = time.process_time()
        embed()
        seconds.append(time.process_time() - start)
    return N_FRAMES / min(seconds)


def run() -> dict[str, object]:
    """Return frames per second of both, their ratio, the share of preprocessing, and how near the vectors are."""
    torch.set_num_threads(1)
    frames = smooth_frames()
    transform, network = create_transform(**LITE0_PREPROCESSING), build_lite0(installed_weights()).module

    @torch.inference_mode()
    def peer() -> NDArray[np.float32]:
        return np.concatenate([network(transform(Image.fromarray(frame))[None]).numpy() for frame in frames])

    default, fp32 = load_embedder("efficientnet-lite0"), load_embedder("efficientnet-lite0", precision="fp32")
    rates = {
        "timm_fp32_single": frames_per_second(peer),
        "fp32_batched": frames_per_second(lambda: fp32.embed_images(frames)),
        "default": frames_per_second(lambda: default.embed_images(frames)),
    }
    preprocessing = frames_per_second(lambda: [transform(Image.fromarray(frame)) for frame in frames])
    ours, theirs = default.embed_images(frames), peer()
    cosines = (ours * theirs).sum(1) / np.linalg.norm(ours, axis=1) / np.linalg.norm(theirs, axis=1)
    ratio = rates["default"] / rates["timm_fp32_single"]
    return {
        **{f"{name}_frames_per_s": round(rate, 1) for name, rate in rates.items()},
        "preprocessing_share": round(rates["default"] / preprocessing, 2),
        "min_cosine_to_fp32": round(float(cosines.min()), 5),
        "ratio": round(ratio, 2),
        "required_ratio": REQUIRED_RATIO,
        "passed": ratio >= REQUIRED_RATIO,
    }
