"""Small models with random weights, as transformers writes them."""

from __future__ import annotations

import json
from pathlib import Path

import torch
import transformers


def save_clip_tokenizer(folder: Path, **options: object) -> None:
    """A tokenizer in CLIP's layout that knows single letters."""
    letters = [*"abcdefghijklmnopqrstuvwxyz", *(f"{c}</w>" for c in "abcdefghijklmnopqrstuvwxyz")]
    vocabulary = {token: i for i, token in enumerate([*letters, "<|startoftext|>", "<|endoftext|>"])}
    (folder / "vocab.json").write_text(json.dumps(vocabulary))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    transformers.CLIPTokenizer(str(folder / "vocab.json"), str(folder / "merges.txt"), **options).save_pretrained(
        folder
    )


SMALL = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2}
TEXT = {**SMALL, "vocab_size": 54, "max_position_embeddings": 16}
VISION = {**SMALL, "image_size": 32, "patch_size": 8}
PROCESSOR = {"size": {"height": 32, "width": 32}, "crop_size": {"height": 32, "width": 32}}


def save_hugging_face(kind: str, folder: Path) -> torch.nn.Module:
    """A small model with random weights, its processor and its tokenizer, as `save_pretrained` leaves them."""
    torch.manual_seed(0)
    if kind == "dinov2":
        model = transformers.Dinov2Model(transformers.Dinov2Config(**{**VISION, "mlp_ratio": 2}))
        transformers.BitImageProcessor(**PROCESSOR).save_pretrained(folder)
    elif kind == "clip":
        ends = {"bos_token_id": 52, "eos_token_id": 53, "pad_token_id": 53}
        config = transformers.CLIPConfig(text_config=TEXT | ends, vision_config=VISION, projection_dim=24)
        model = transformers.CLIPModel(config)
        transformers.CLIPImageProcessor(**PROCESSOR).save_pretrained(folder)
        save_clip_tokenizer(folder)
    else:
        ends = {"bos_token_id": 52, "eos_token_id": 53, "pad_token_id": 53, "projection_size": 32}
        model = transformers.SiglipModel(transformers.SiglipConfig(text_config=TEXT | ends, vision_config=VISION))
        transformers.SiglipImageProcessor(size=PROCESSOR["size"]).save_pretrained(folder)
        save_clip_tokenizer(folder, model_input_names=["input_ids"])  # as SigLIP's own: it attends to the padding
    model.eval().save_pretrained(folder)
    return model
