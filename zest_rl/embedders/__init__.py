"""Frozen networks that turn frames or sentences into vectors, chosen by a URI.

| URI | weights |
|---|---|
| `efficientnet-lite0` | ImageNet weights that are installed with this package: no download, and the default |
| `open_clip:MODEL/TAG` | open_clip's hub; reads sentences too |
| `torchvision:resnet50`, `torchvision:resnet50/WEIGHTS` | torchvision's hub; likewise resnet18, 34, 101, 152 |
| `timm:NAME` | timm's hub |
| `open_clip:MODEL@/path`, `open_clip:MODEL/TAG@/path`, and so on for the three above | a local checkpoint file |
| `moco:/path` | a pre-training checkpoint of MoCo v1 or v2 (ResNet50) |
| `transformers:/folder`, `transformers:NAME` | Hugging Face's CLIP, SigLIP, DINO, in `save_pretrained`'s layout |
| `NAME:REST` | a family that another package registers (entry point in the group `zest_rl.embedders`) |

With `@/path` the name still chooses architecture, activation and preprocessing, so keep the TAG when the file holds a
tag's weights. A checkpoint is a `.safetensors` file or what `torch.save` or TorchScript wrote, out of which tensors are
read and nothing is run. It must fill every parameter except the classification head, which is cut off: no embedder ever
runs on random weights. Images go through each model's own preprocessing.

On a CPU the default is computed by ONNX Runtime (`zest_rl.embedders.lite0`), which needs no torch; all others, and all
on a GPU, in bf16, or where ONNX Runtime is not installed, by torch, which is imported when a network is needed.
"""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, get_args

import numpy as np

from zest_rl.embedders.checkpoints import DEFAULT_EMBEDDER, LITE0_PREPROCESSING, installed_weights
from zest_rl.errors import BadInput, ZestError, nearest
from zest_rl.runtime.artifacts import hash_arrays, hash_file, hash_json
from zest_rl.runtime.parallel import one_thread as on_one_thread
from zest_rl.types import FloatArray, Frame

if TYPE_CHECKING:
    import torch

    from zest_rl.embedders.base import Network

__all__ = ["DEFAULT_EMBEDDER", "Backend", "Embedder", "Precision", "Vectors", "find_device", "load_embedder"]

Precision = Literal["auto", "fp32", "bf16"]
Backend = Literal["auto", "torch"]
"""What computes the default embedder in fp32 on a CPU: ONNX Runtime if it is installed, or torch in any case."""
Vectors = Literal["float32", "float16"]
"""Type of an embedding's numbers; float16 takes half of the space in the cache. They are rounded when they are
computed, so that it does not matter whether an embedding comes from there."""
ONNX_RUNTIME = "onnxruntime"
GPU_DRIVERS = ("/proc/driver/nvidia", "/dev/dxg", "/dev/nvhost-gpu", "/dev/kfd")
"""Where Linux shows a GPU that torch may use: NVIDIA's, also through WSL and of a Jetson, and AMD's."""


class Embedder(Protocol):
    """A frozen network ψ. Equal inputs give equal vectors to about 1e-6, not to the bit."""

    @property
    def uri(self) -> str:
        """The URI given to `load_embedder`."""

    @property
    def fingerprint(self) -> str:
        """64 hex digits over network, weights, preprocessing, precision, `vectors`; not device, backend, batch size."""

    @property
    def backend(self) -> str:
        """What computes the vectors of images: "torch" or "onnxruntime"; the two agree to 1e-5 of a vector's length."""

    @property
    def cache_key(self) -> str:
        """64 hex digits over fingerprint and backend, so that a cache holds vectors that repeat to the bit."""

    @property
    def dim(self) -> int:
        """Length D of a vector."""

    @property
    def vectors(self) -> Vectors:
        """The smallest type that holds the vectors as they are: that of the cache."""

    @property
    def reads_text(self) -> bool:
        """Whether `embed_texts` works."""

    def embed_images(self, frames: Sequence[Frame]) -> FloatArray:
        """Embed frames of any sizes, each (H, W, 3) uint8 RGB, as (N, D) float32 that is not normalised.

        Raises:
            BadInput: a frame has another shape or dtype.
            ZestError: the network returned NaN or infinity, or a number that float16 cannot hold.
        """

    def embed_texts(self, sentences: Sequence[str]) -> FloatArray:
        """Embed sentences as (N, D) float32 that is not normalised, in the space of the images.

        Raises:
            BadInput: this network reads no text.
            ZestError: as in `embed_images`, or its tokenizer is not available.
        """


def load_embedder(
    uri: str,
    *,
    device: str = "auto",
    precision: Precision = "auto",
    batch_size: int = 16,
    backend: Backend = "auto",
    vectors: Vectors = "float32",
    one_thread: bool = False,
) -> Embedder:
    """Return the embedder that `uri` names (see the table above).

    Args:
        uri: the embedder.
        device: "auto" (CUDA where there is one, else the CPU), "cpu", "cuda", "cuda:1", "mps".
        precision: of weights and activations; "auto" is bf16 where the hardware computes it natively, else fp32. The
            embedded default stays fp32: its small deltas suffer from bf16 (cosine to fp32 .89 to .99 on renderings,
            against ≥ .9999 for ViT-B/32 and ResNet50).
        batch_size: frames or sentences per forward pass; ONNX Runtime takes them one by one.
        backend: "auto", or "torch" for vectors that equal those of versions without ONNX Runtime.
        vectors: "float32", or "float16" to round the numbers of all vectors to that type; they are returned as float32.
        one_thread: compute on one thread, so that vectors do not depend on the number of cores.

    Raises:
        BadInput: unknown family, model, tag, device, backend or type of vectors; a checkpoint that cannot be read or
            does not fit.
        ZestError: the weights are not cached and cannot be fetched.
    """
    if precision not in get_args(Precision):
        raise BadInput(f"unknown precision {precision!r}; {nearest(precision, get_args(Precision))}")
    if backend not in get_args(Backend):
        raise BadInput(f"unknown backend {backend!r}; {nearest(backend, get_args(Backend))}")
    if vectors not in get_args(Vectors):
        raise BadInput(f"unknown type of vectors {vectors!r}; {nearest(vectors, get_args(Vectors))}")
    if batch_size < 1:
        raise BadInput(f"batch_size must be at least 1, got {batch_size}")
    _check_device(device)
    bf16 = precision == "bf16" or (precision == "auto" and computes_bf16(device) and uri != DEFAULT_EMBEDDER)

    if uri == DEFAULT_EMBEDDER:
        weights = installed_weights()

        def load_lite0() -> Network:
            from zest_rl.embedders.networks import build_lite0

            return _place(build_lite0(weights), device, bf16)

        fingerprint = hash_json(
            [uri, hash_file(weights), LITE0_PREPROCESSING, bf16, "batch norms folded, padded evenly"]
        )
        by_onnx = backend == "auto" and not bf16 and importlib.util.find_spec(ONNX_RUNTIME) and _is_cpu(device)
        embedder = _NetworkEmbedder(
            uri, fingerprint, 1280, False, batch_size, one_thread, load_lite0, weights if by_onnx else None
        )
    else:
        from zest_rl.embedders.networks import build

        network = build(uri)
        fingerprint = _fingerprint(uri, network, bf16)
        _place(network, device, bf16)
        reads_text = network.encode_texts is not None
        embedder = _NetworkEmbedder(uri, fingerprint, network.dim, reads_text, batch_size, one_thread, lambda: network)
    if vectors == "float32":
        return embedder
    return replace(embedder, fingerprint=hash_json([fingerprint, vectors]), vectors=vectors)


@dataclass(frozen=True)
class _NetworkEmbedder:
    """The one implementation of `Embedder`; the network is loaded when first used."""

    uri: str
    fingerprint: str
    dim: int
    reads_text: bool
    batch_size: int
    one_thread: bool
    load: Callable[[], Network]
    lite0_weights: Path | None = None
    """Of the default embedder if ONNX Runtime computes it."""
    vectors: Vectors = "float32"

    @property
    def backend(self) -> str:
        return "torch" if self.lite0_weights is None else ONNX_RUNTIME

    @property
    def cache_key(self) -> str:
        return self.fingerprint if self.lite0_weights is None else hash_json([self.fingerprint, self.backend])

    @cached_property
    def _network(self) -> Network:
        return self.load()

    @cached_property
    def _embed_frames(self) -> Callable[[Sequence[Frame]], FloatArray]:
        if self.lite0_weights is None:
            return self._by_torch(self._network.embed_frames)
        from zest_rl.embedders import lite0

        network = lite0.load(self.lite0_weights, one_thread=self.one_thread)
        return lambda frames: network(lite0.batch(frames))

    def _by_torch(self, encode: Callable[[Any], torch.Tensor]) -> Callable[[Any], FloatArray]:
        import torch

        def by_torch(items: Any) -> FloatArray:
            with torch.inference_mode(), on_one_thread() if self.one_thread else nullcontext():
                vectors: FloatArray = encode(items).float().cpu().numpy()
                return vectors

        return by_torch

    def embed_images(self, frames: Sequence[Frame]) -> FloatArray:
        for i, frame in enumerate(frames):
            if frame.ndim != 3 or frame.shape[2] != 3 or 0 in frame.shape or frame.dtype != np.uint8:
                raise BadInput(
                    f"frame {i} must have shape (H, W, 3) and dtype uint8, "
                    f"got shape {frame.shape} and dtype {frame.dtype}"
                )
        return self._embed(frames, self._embed_frames, "frame")

    def embed_texts(self, sentences: Sequence[str]) -> FloatArray:
        encode = self._network.encode_texts if self.reads_text else None
        if encode is None:
            raise BadInput(f"{self.uri} reads images only; for sentences use one like open_clip:ViT-B-32/openai")
        return self._embed(list(sentences), self._by_torch(encode), "sentence")

    def _embed(self, items: Sequence[Any], encode: Callable[[Any], FloatArray], what: str) -> FloatArray:
        vectors = np.empty((len(items), self.dim), np.float32)
        for start in range(0, len(items), self.batch_size):
            batch = slice(start, start + self.batch_size)
            vectors[batch] = encode(items[batch])
        bad = np.flatnonzero(~np.isfinite(vectors).all(axis=1))
        if len(bad):
            raise ZestError(
                f"{self.uri} returned NaN or infinity for {len(bad)} of {len(items)} {what}s (the first is {what} "
                f"{bad[0]}); try precision fp32, and if that does not help use other weights, for these are broken"
            )
        if self.vectors == "float32":
            return vectors
        if (largest := np.abs(vectors).max(initial=0)) > np.finfo(np.float16).max:
            raise ZestError(
                f"{self.uri} returned {largest:.0f}, and float16 holds {np.finfo(np.float16).max:.0f} at most; leave "
                "--vectors float16 out"
            )
        return vectors.astype(np.float16).astype(np.float32)


def _check_device(device: str) -> None:
    if device in ("auto", "cpu"):
        return  # needs no torch
    if not re.fullmatch(r"cuda(:\d+)?|mps", device):
        raise BadInput(f"unknown device {device!r}; {nearest(device, ('auto', 'cpu', 'cuda', 'cuda:0', 'mps'))}")
    import torch

    index = int(device.partition(":")[2] or 0)
    available = torch.backends.mps.is_available() if device == "mps" else index < torch.cuda.device_count()
    if not available:
        raise BadInput(f"torch finds no device {device!r} on this machine; use 'auto' or 'cpu'")


def computes_bf16(device: str) -> bool:
    """Whether the hardware computes bf16 natively; without torch, since fingerprints must not wait for its import."""
    if device.startswith("cuda") or (device == "auto" and Path("/proc/driver/nvidia/gpus").is_dir()):
        return True
    cpu = Path("/proc/cpuinfo")
    flags = set(re.findall(r"\w+", cpu.read_text(encoding="utf-8"))) if cpu.is_file() else set()
    return device != "mps" and bool(flags & {"avx512_bf16", "amx_bf16", "bf16"})


def find_device(device: str) -> torch.device:
    """Return the device of this name; ``auto`` is CUDA where there is one, else the CPU.

    Raises:
        BadInput: unknown name, or this machine has no such device.
    """
    _check_device(device)
    import torch

    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(device)


def _is_cpu(device: str) -> bool:
    """Whether `find_device` returns the CPU; asks torch only where there is a GPU."""
    if device == "auto" and not any(Path(driver).exists() for driver in GPU_DRIVERS):
        return True
    return device == "cpu" or find_device(device).type == "cpu"


def _place(network: Network, device: str, bf16: bool) -> Network:
    import torch

    return network.place(find_device(device), torch.bfloat16 if bf16 else torch.float32)


def _fingerprint(uri: str, network: Network, bf16: bool) -> str:
    """Hash the loaded weights, so that the same checkpoint in another file or format has the same fingerprint."""
    state = network.module.state_dict()
    weights = [list(state), hash_arrays(*(value.numpy() for value in state.values()))]
    layout = [re.sub(r" at 0x[0-9a-f]+", "", repr(part)) for part in (network.module, network.preprocess)]
    return hash_json([uri.partition(":")[0], weights, layout, bf16, network.identity])
