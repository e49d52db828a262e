"""Models of transformers, small and in the real layout, embed as the library itself does."""

from __future__ import annotations

import json
import random
from pathlib import Path

import numpy as np
import pytest
import tokenizers
import torch
import transformers
from fuzzing import damaged_json, faults, outcomes
from hugging_face_files import PROCESSOR, VISION, save_hugging_face
from PIL import Image
from safetensors.torch import load_file, save_file

from zest_rl.embedders import load_embedder
from zest_rl.errors import BadInput

SENTENCES = ["closed microwave", "open microwave", "stove"]


@pytest.fixture
def frames() -> list[np.ndarray]:
    """Noise of three sizes."""
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, size=(*size, 3), dtype=np.uint8) for size in ((32, 32), (48, 40), (64, 100))]


@pytest.mark.parametrize(("kind", "dim"), [("clip", 24), ("siglip", 32), ("dinov2", 32)])
def test_transformers_embeds_images_as_the_library_does(
    kind: str, dim: int, tmp_path: Path, frames: list[np.ndarray]
) -> None:
    model = save_hugging_face(kind, tmp_path)
    embedder = load_embedder(f"transformers:{tmp_path}", precision="fp32")
    assert (embedder.dim, embedder.reads_text) == (dim, kind != "dinov2")
    processor = transformers.AutoImageProcessor.from_pretrained(tmp_path)
    pixels = processor(images=[Image.fromarray(frame) for frame in frames], return_tensors="pt")
    with torch.inference_mode():
        output = model(**pixels) if kind == "dinov2" else model.get_image_features(**pixels)
    np.testing.assert_allclose(embedder.embed_images(frames), output.pooler_output.numpy(), atol=1e-4)
    assert load_embedder(f"transformers:{tmp_path}", precision="fp32").fingerprint == embedder.fingerprint


def test_a_folder_without_a_tokenizer_is_told_so(tmp_path: Path) -> None:
    save_hugging_face("clip", tmp_path)
    (tmp_path / "tokenizer_config.json").unlink()
    with pytest.raises(BadInput, match=r"tokenizer_config\.json does not exist"):
        load_embedder(f"transformers:{tmp_path}").embed_texts(SENTENCES)


@pytest.mark.parametrize(("kind", "padding"), [("clip", True), ("siglip", "max_length")])
def test_transformers_embeds_sentences_as_the_library_does(kind: str, padding: bool | str, tmp_path: Path) -> None:
    model = save_hugging_face(kind, tmp_path)
    embedder = load_embedder(f"transformers:{tmp_path}", precision="fp32")
    tokenizer = transformers.AutoTokenizer.from_pretrained(tmp_path)
    tokens = tokenizer(SENTENCES, padding=padding, max_length=16, truncation=True, return_tensors="pt")
    with torch.inference_mode():
        expected = model.get_text_features(**tokens).pooler_output.numpy()
    vectors = embedder.embed_texts(SENTENCES)
    np.testing.assert_allclose(vectors, expected, atol=1e-4)
    assert not np.allclose(vectors[0], vectors[1])


def test_siglip_reads_sentences_in_lower_case_as_it_was_trained(tmp_path: Path) -> None:
    """SigLIP 2 is published with Gemma's tokenizer, which keeps capitals."""
    save_hugging_face("siglip", tmp_path)
    words = ["<pad>", "<unk>", "Open", "DOOR", "open", "door"]
    tokenizer = tokenizers.Tokenizer(tokenizers.models.WordLevel({w: i for i, w in enumerate(words)}, "<unk>"))
    tokenizer.pre_tokenizer = tokenizers.pre_tokenizers.Whitespace()
    transformers.PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token="<pad>", unk_token="<unk>", model_input_names=["input_ids"]
    ).save_pretrained(tmp_path)
    capitals, small, other = load_embedder(f"transformers:{tmp_path}").embed_texts(["Open DOOR", "open door", "door"])
    np.testing.assert_array_equal(capitals, small)
    assert not np.allclose(small, other)


def test_a_vision_transformer_without_weights_for_its_pooling_gives_its_class_token(
    tmp_path: Path, frames: list[np.ndarray]
) -> None:
    torch.manual_seed(0)
    model = transformers.ViTModel(transformers.ViTConfig(**VISION), add_pooling_layer=False).eval()
    model.save_pretrained(tmp_path)
    transformers.ViTImageProcessor(size=PROCESSOR["size"]).save_pretrained(tmp_path)
    processor = transformers.AutoImageProcessor.from_pretrained(tmp_path)
    pixels = processor(images=[Image.fromarray(frame) for frame in frames], return_tensors="pt")
    with torch.inference_mode():
        expected = model(**pixels).last_hidden_state[:, 0].numpy()
    vectors = load_embedder(f"transformers:{tmp_path}", precision="fp32").embed_images(frames)
    np.testing.assert_allclose(vectors, expected, atol=1e-4)


def test_transformers_weights_that_are_not_all_there_are_refused(tmp_path: Path) -> None:
    """Transformers itself fills them with random numbers and only logs it."""
    save_hugging_face("clip", tmp_path)
    state = load_file(tmp_path / "model.safetensors")
    del state["visual_projection.weight"]
    save_file(state, tmp_path / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(BadInput, match=r"1 missing \(visual_projection.weight\)"):
        load_embedder(f"transformers:{tmp_path}")
    with pytest.raises(BadInput, match="nowhere is not a folder"):
        load_embedder(f"transformers:{tmp_path}/nowhere")
    (tmp_path / "config.json").unlink()
    with pytest.raises(BadInput, match=r"config\.json does not exist"):
        load_embedder(f"transformers:{tmp_path}")


@pytest.mark.parametrize("change", [{"hidden_size": 10**9}, {"num_hidden_layers": 10**7}])
def test_a_config_of_absurd_size_is_refused_before_the_model_is_built(change: dict[str, int], tmp_path: Path) -> None:
    save_hugging_face("clip", tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    config["vision_config"] |= change
    (tmp_path / "config.json").write_text(json.dumps(config))
    ((name, size),) = change.items()
    with pytest.raises(BadInput, match=rf"config.json cannot be read .*{name} = {size}"):
        load_embedder(f"transformers:{tmp_path}")


def test_a_damaged_config_is_read_or_refused(tmp_path: Path) -> None:
    save_hugging_face("clip", tmp_path)
    whole, rng = json.loads((tmp_path / "config.json").read_text()), random.Random(0)
    damaged = [json.dumps(damaged_json(whole, rng)) for _ in range(20)]

    def read(i: int) -> int:
        (tmp_path / "config.json").write_text(damaged[i])
        return load_embedder(f"transformers:{tmp_path}").dim

    counts, bad = faults(outcomes(read, len(damaged)))
    print("config.json", len(damaged), dict(counts))
    assert not bad, bad[0].detail
