"""Networks of Hugging Face's transformers, from a folder that ``save_pretrained`` wrote or from the hub."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import torch
from PIL import Image

from zest_rl.embedders import checkpoints
from zest_rl.embedders.base import Network
from zest_rl.errors import BadInput
from zest_rl.runtime.files import user_path

MOST_HIDDEN_LAYERS, LARGEST_SIZE = 1000, 10**7
"""Of a model's config; the largest size of one is its vocabulary."""


@dataclass(frozen=True, repr=False)
class _Preprocess:
    """A model's own image processor as a function of one picture."""

    processor: Any

    def __call__(self, image: Image.Image) -> torch.Tensor:
        pixels: torch.Tensor = self.processor(images=image, return_tensors="pt")["pixel_values"][0]
        return pixels

    def __repr__(self) -> str:
        return str(self.processor.to_json_string())


def build(uri: str, source: str) -> Network:
    """Return the image tower of a model of any family, and its text tower where there is one.

    Vectors are `get_image_features` and `get_text_features` where the model has them (CLIP, SigLIP), else its pooled
    output (DINOv2), else its class token: where it has no pooling, or the checkpoint no weights for it (ViT, DINO).

    Args:
        uri: for messages.
        source: a folder with config, weights and processor, or a name on the hub.

    Raises:
        BadInput: the folder cannot be read, weights are missing, or the model reads no pictures.
        ZestError: the hub does not answer.
    """
    from transformers import AutoImageProcessor, AutoModel, AutoTokenizer

    folder = user_path(source)

    def load() -> tuple[Any, dict[str, Any], Any]:
        name = str(folder) if folder.is_dir() else source
        model, info = AutoModel.from_pretrained(
            name, output_loading_info=True, dtype=torch.float32, trust_remote_code=False
        )
        return model, info, AutoImageProcessor.from_pretrained(name, trust_remote_code=False)  # type: ignore[no-untyped-call]

    if folder.is_dir():
        with checkpoints.reading(folder / "config.json"):
            _check_sizes(json.loads((folder / "config.json").read_text(encoding="utf-8")))
            module, info, processor = load()
    elif source.startswith(("/", "~", ".")):
        raise BadInput(f"{source} is not a folder; give one that save_pretrained left, or a name on the hub")
    else:
        module, info, processor = checkpoints.fetch(uri, load)
    missing = sorted(info["missing_keys"])
    if missing and all(name.startswith("pooler.") for name in missing):
        module.pooler, missing = None, []  # classifiers are published without a pooler
    checkpoints.refuse_misfits(folder, type(module).__name__, missing, (), sorted(map(str, info["mismatched_keys"])))
    if processor.model_input_names != ["pixel_values"]:
        raise BadInput(
            f"{uri} wants {', '.join(processor.model_input_names)} of a picture, only models that want pixel_values "
            "alone are supported; use the fixed-resolution model of its family"
        )

    def encode_images(pixels: torch.Tensor) -> torch.Tensor:
        if hasattr(module, "get_image_features"):
            return _vector(module.get_image_features(pixel_values=pixels))
        return _vector(module(pixel_values=pixels))

    if not hasattr(module, "get_text_features"):
        return Network(module, _Preprocess(processor), encode_images)
    tokenizer = None
    siglip = module.config.model_type.startswith("siglip")  # which was trained on padded sentences in lower case

    def encode_texts(sentences: list[str]) -> torch.Tensor:
        nonlocal tokenizer
        if tokenizer is None:
            if folder.is_dir():
                with checkpoints.reading(folder / "tokenizer_config.json"):
                    tokenizer = AutoTokenizer.from_pretrained(str(folder), trust_remote_code=False)
            else:
                tokenizer = checkpoints.fetch(
                    uri, lambda: AutoTokenizer.from_pretrained(source, trust_remote_code=False)
                )
        sentences = [sentence.lower() for sentence in sentences] if siglip else sentences
        length = module.config.text_config.max_position_embeddings
        tokens = tokenizer(
            sentences, padding="max_length" if siglip else True, max_length=length, truncation=True, return_tensors="pt"
        )
        return _vector(module.get_text_features(**tokens.to(module.device)))

    return Network(module, _Preprocess(processor), encode_images, encode_texts, "lower case" if siglip else "")


def _check_sizes(config: Any, name: str = "") -> None:
    """Refuse sizes that no published model has, before the model is built; its weights are read afterwards."""
    if isinstance(config, dict | list):
        for key, value in config.items() if isinstance(config, dict) else ((name, item) for item in config):
            _check_sizes(value, str(key))
    elif isinstance(config, int | float) and config > (MOST_HIDDEN_LAYERS if "layers" in name else LARGEST_SIZE):
        raise ValueError(f"{name} = {config}")


def _vector(output: Any) -> torch.Tensor:
    """Return a model's vectors of whole inputs, (N, D), from whatever object its version returns."""
    if isinstance(output, torch.Tensor):
        return output
    pooled = getattr(output, "pooler_output", None)
    vector: torch.Tensor = output.last_hidden_state[:, 0] if pooled is None else pooled
    return vector
