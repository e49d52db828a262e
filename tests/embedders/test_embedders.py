from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import open_clip
import pytest
import timm
import torch
import torchvision
from PIL import Image
from safetensors.torch import save_file
from timm.data.config import resolve_model_data_config
from timm.data.transforms_factory import create_transform

from zest_rl.data.images import list_images, read_image
from zest_rl.embedders import load_embedder
from zest_rl.embedders.checkpoints import installed_weights
from zest_rl.embedders.networks import build_lite0
from zest_rl.errors import BadInput, ZestError

DRAWINGS = Path(__file__).parents[2] / "datasets" / "goals" / "micro"
MICROWAVE = 651  # ImageNet class
OPEN_CLIP = "ViT-S-32-alt"
SENTENCES = ["closed microwave", "open microwave", "stove"]


@pytest.fixture(scope="module")
def frames() -> list[np.ndarray]:
    """Five pictures of different sizes; the last has the networks' input size already."""
    drawings = [read_image(path) for path in list_images(DRAWINGS / "init") + list_images(DRAWINGS / "goal")][:4]
    square = np.asarray(Image.fromarray(drawings[3]).resize((224, 224)))
    return [drawings[0], drawings[1][:200], drawings[2][:, :240], drawings[3], square]


@pytest.fixture(scope="module")
def clip_model() -> tuple[torch.nn.Module, Callable[[Image.Image], torch.Tensor]]:
    torch.manual_seed(0)
    model, _, preprocess = open_clip.create_model_and_transforms(OPEN_CLIP)
    return model.eval(), preprocess


@pytest.fixture(scope="module")
def clip_file(clip_model: tuple[torch.nn.Module, object], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Laid out as open_clip's training writes it: one of several entries, keys of a distributed wrapper."""
    path = tmp_path_factory.mktemp("clip") / "epoch_1.pt"
    state = {f"module.{name}": value for name, value in clip_model[0].state_dict().items()}
    torch.save({"epoch": 1, "name": "run", "state_dict": state}, path)
    return path


@pytest.fixture(scope="module")
def timm_model() -> torch.nn.Module:
    torch.manual_seed(0)
    return timm.create_model("resnet10t", pretrained=False).eval()


@pytest.fixture(scope="module")
def timm_file(timm_model: torch.nn.Module, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("timm") / "model.safetensors"
    save_file(timm_model.state_dict(), path)
    return path


def cosines(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)


def by_library(
    network: Callable[[torch.Tensor], torch.Tensor], preprocess: Callable[[Image.Image], torch.Tensor], frames: list
) -> np.ndarray:
    with torch.inference_mode():
        return np.concatenate([network(preprocess(Image.fromarray(frame))[None]).numpy() for frame in frames])


# ---- the embedded default ----


def test_the_default_tells_fingerprint_and_size_without_importing_torch() -> None:
    code = (
        "import sys; from zest_rl.embedders import load_embedder; e = load_embedder('efficientnet-lite0');"
        "print(len(e.fingerprint), e.dim, e.reads_text, 'torch' in sys.modules, 'timm' in sys.modules)"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.split() == ["64", "1280", "False", "False", "False"]


def microwave_ranks(frames: list[np.ndarray]) -> np.ndarray:
    """Rank of "microwave" among the 1000 ImageNet classes per frame: our vectors through the file's own classifier."""
    *_, weight, bias = torch.load(installed_weights(), weights_only=True).values()
    logits = load_embedder("efficientnet-lite0").embed_images(frames) @ weight.numpy().T + bias.numpy()
    return (logits > logits[:, MICROWAVE, None]).sum(axis=1)


def test_the_default_recognises_drawn_microwaves() -> None:
    drawn = [read_image(DRAWINGS / name) for name in ("init/closed_flat.png", "goal/open_flat.png")]
    assert (microwave_ranks(drawn) < 5).all()


@pytest.mark.data
def test_the_default_recognises_photographed_microwaves(visual_tasks: Path) -> None:
    folder = visual_tasks / "real_imgs" / "open_microwave"
    ranks = microwave_ranks([read_image(path) for path in list_images(folder / "init") + list_images(folder / "goal")])
    assert (ranks < 5).mean() > 0.95
    assert (ranks == 0).mean() > 0.75


def test_the_default_follows_timm_preprocessing_and_network(frames: list[np.ndarray]) -> None:
    ours = load_embedder("efficientnet-lite0", precision="fp32").embed_images(frames)
    module = timm.create_model("tf_efficientnet_lite0", pretrained=False).eval()
    state = torch.load(installed_weights(), weights_only=True)
    module.load_state_dict(dict(zip(module.state_dict(), state.values(), strict=True)))
    module.reset_classifier(0)
    preprocess = create_transform(**resolve_model_data_config(module))
    np.testing.assert_allclose(ours, by_library(module, preprocess, frames), atol=1e-4)


@pytest.mark.parametrize("side", [1, 64, 224, 256, 301])
def test_squares_are_preprocessed_at_once_as_pillow_does_to_the_bit(side: int) -> None:
    rng = np.random.default_rng(side)
    noise = rng.integers(0, 256, (2, side, side, 3), dtype=np.uint8)
    squares = np.concatenate([noise, 255 * (noise > 127).astype(np.uint8)])  # whose edges leave 0 … 255 in between
    network = build_lite0(installed_weights())
    one_by_one = torch.stack([network.preprocess(Image.fromarray(square)) for square in squares])
    assert network.preprocess_squares is not None
    assert torch.equal(network.preprocess_squares(torch.from_numpy(squares)), one_by_one)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
def test_a_gpu_embeds_in_fp32_as_the_cpu_does(frames: list[np.ndarray]) -> None:
    squares = [np.ascontiguousarray(frame[:100, :100]) for frame in frames]
    for pictures in (frames, squares):
        ours, theirs = (load_embedder("efficientnet-lite0", device=d).embed_images(pictures) for d in ("cuda", "cpu"))
        assert (np.linalg.norm(ours - theirs, axis=1) <= 1e-5 * np.linalg.norm(theirs, axis=1)).all()


def test_bf16_keeps_the_direction_of_the_default_to_a_percent(frames: list[np.ndarray]) -> None:
    fp32, bf16 = (load_embedder("efficientnet-lite0", precision=p) for p in ("fp32", "bf16"))
    assert cosines(fp32.embed_images(frames), bf16.embed_images(frames)).min() > 0.99
    assert fp32.fingerprint != bf16.fingerprint


def test_batches_of_any_size_give_the_same_vectors(frames: list[np.ndarray]) -> None:
    one, two, many = (load_embedder("efficientnet-lite0", precision="fp32", batch_size=n) for n in (1, 2, 16))
    vectors = many.embed_images(frames)
    assert vectors.shape == (5, 1280)
    assert vectors.dtype == np.float32
    np.testing.assert_allclose(one.embed_images(frames), vectors, atol=1e-4)
    np.testing.assert_allclose(two.embed_images(frames), vectors, atol=1e-4)
    assert many.embed_images([]).shape == (0, 1280)
    assert one.fingerprint == many.fingerprint


@pytest.mark.parametrize("frame", [np.zeros((8, 8), np.uint8), np.zeros((8, 8, 4), np.uint8), np.zeros((8, 8, 3))])
def test_a_frame_that_is_not_rgb_bytes_is_refused(frame: np.ndarray) -> None:
    with pytest.raises(BadInput, match=r"frame 1 must have shape \(H, W, 3\) and dtype uint8, got shape \(8, 8"):
        load_embedder("efficientnet-lite0").embed_images([np.zeros((8, 8, 3), np.uint8), frame])


def test_an_embedder_of_images_refuses_sentences_and_names_one_that_reads_them() -> None:
    with pytest.raises(BadInput, match=r"reads images only.*open_clip:ViT-B-32/openai"):
        load_embedder("efficientnet-lite0").embed_texts(SENTENCES)


# ---- other families, from local checkpoints ----


def test_open_clip_embeds_images_and_sentences_as_the_library_does(
    clip_model: tuple[torch.nn.Module, Callable[[Image.Image], torch.Tensor]], clip_file: Path, frames: list[np.ndarray]
) -> None:
    model, preprocess = clip_model
    embedder = load_embedder(f"open_clip:{OPEN_CLIP}@{clip_file}", precision="fp32")
    assert (embedder.dim, embedder.reads_text) == (256, True)
    np.testing.assert_allclose(
        embedder.embed_images(frames), by_library(model.encode_image, preprocess, frames), atol=1e-4
    )
    with torch.inference_mode():
        texts = model.encode_text(open_clip.get_tokenizer(OPEN_CLIP)(SENTENCES)).numpy()
    np.testing.assert_allclose(embedder.embed_texts(SENTENCES), texts, atol=1e-4)


def test_bf16_keeps_the_direction_of_open_clip(clip_file: Path, frames: list[np.ndarray]) -> None:
    fp32, bf16 = (load_embedder(f"open_clip:{OPEN_CLIP}@{clip_file}", precision=p) for p in ("fp32", "bf16"))
    assert cosines(fp32.embed_images(frames), bf16.embed_images(frames)).min() > 0.999
    assert cosines(fp32.embed_texts(SENTENCES), bf16.embed_texts(SENTENCES)).min() > 0.999


def test_weights_trained_with_quick_gelu_run_with_quick_gelu(tmp_path: Path, frames: list[np.ndarray]) -> None:
    """open_clip itself runs ViT-B-32/openai with another activation and only warns."""
    torch.manual_seed(0)
    model, _, preprocess = open_clip.create_model_and_transforms("ViT-B-32-quickgelu")
    torch.save(model.state_dict(), tmp_path / "clip.pt")
    embedder = load_embedder(f"open_clip:ViT-B-32/openai@{tmp_path / 'clip.pt'}", precision="fp32")
    expected = by_library(model.eval().encode_image, preprocess, frames)
    np.testing.assert_allclose(embedder.embed_images(frames), expected, atol=1e-4)


@pytest.mark.parametrize("torch_script", [True, False])
def test_clip_as_openai_published_it_embeds_as_the_library_does(
    clip_model: tuple[torch.nn.Module, Callable[[Image.Image], torch.Tensor]],
    tmp_path: Path,
    frames: list[np.ndarray],
    torch_script: bool,
) -> None:
    """In half precision, with three sizes among the weights, for another activation than open_clip's default."""
    preprocess = clip_model[1]
    torch.manual_seed(0)
    model = open_clip.create_model(OPEN_CLIP, force_quick_gelu=True)
    for name, size in (("input_resolution", 224), ("context_length", 77), ("vocab_size", 49408)):
        vars(model).pop(name, None)  # the library keeps some as plain numbers
        model.register_buffer(name, torch.tensor(size))
    file = tmp_path / "clip.pt"
    if torch_script:
        model.attn_mask = None  # it is built, not stored
        pixels = {"encode_image": torch.zeros(1, 3, 224, 224)}
        torch.jit.trace_module(model.eval(), pixels, check_trace=False).half().save(file)
    else:
        torch.save(model.half().state_dict(), file)
    library = open_clip.load_openai_model(str(file), precision="fp32", device="cpu").eval()
    embedder = load_embedder(f"open_clip:{OPEN_CLIP}@{file}", precision="fp32")
    expected = by_library(library.encode_image, preprocess, frames)
    np.testing.assert_allclose(embedder.embed_images(frames), expected, atol=1e-4)
    with torch.inference_mode():
        texts = library.encode_text(open_clip.get_tokenizer(OPEN_CLIP)(SENTENCES)).numpy()
    np.testing.assert_allclose(embedder.embed_texts(SENTENCES), texts, atol=1e-4)
    with pytest.raises(BadInput, match="does not hold exactly the weights of ViT-B-16"):
        load_embedder(f"open_clip:ViT-B-16@{file}")


def test_torchvision_embeds_as_the_library_does_before_its_classifier(tmp_path: Path, frames: list[np.ndarray]) -> None:
    torch.manual_seed(0)
    model = torchvision.models.resnet50().eval()
    torch.save(model.state_dict(), tmp_path / "resnet50.pth")
    embedder = load_embedder(f"torchvision:resnet50@{tmp_path / 'resnet50.pth'}", precision="fp32")
    model.fc = torch.nn.Identity()
    preprocess = torchvision.models.ResNet50_Weights.DEFAULT.transforms()
    assert (embedder.dim, embedder.reads_text) == (2048, False)
    np.testing.assert_allclose(embedder.embed_images(frames), by_library(model, preprocess, frames), atol=1e-4)


def test_moco_reads_the_query_encoder_of_a_pretraining_checkpoint(tmp_path: Path, frames: list[np.ndarray]) -> None:
    torch.manual_seed(0)
    query, key = (torchvision.models.resnet50(num_classes=128).eval() for _ in range(2))
    for encoder in (query, key):  # MoCo v2's projection head
        encoder.fc = torch.nn.Sequential(torch.nn.Linear(2048, 2048), torch.nn.ReLU(), encoder.fc)
    state = {f"module.encoder_q.{name}": value for name, value in query.state_dict().items()}
    state |= {f"module.encoder_k.{name}": value for name, value in key.state_dict().items()}
    state |= {"module.queue": torch.zeros(128, 64), "module.queue_ptr": torch.zeros(1, dtype=torch.long)}
    torch.save({"epoch": 200, "arch": "resnet50", "state_dict": state}, tmp_path / "moco_v2.pth.tar")
    embedder = load_embedder(f"moco:{tmp_path / 'moco_v2.pth.tar'}", precision="fp32")
    query.fc = torch.nn.Identity()
    preprocess = torchvision.models.ResNet50_Weights.IMAGENET1K_V1.transforms()
    np.testing.assert_allclose(embedder.embed_images(frames), by_library(query, preprocess, frames), atol=1e-4)


def test_timm_embeds_as_the_library_does_before_its_classifier(
    timm_model: torch.nn.Module, timm_file: Path, frames: list[np.ndarray]
) -> None:
    embedder = load_embedder(f"timm:resnet10t@{timm_file}", precision="fp32")
    preprocess = create_transform(**resolve_model_data_config(timm_model))

    def pooled(pixels: torch.Tensor) -> torch.Tensor:
        return timm_model.forward_head(timm_model.forward_features(pixels), pre_logits=True)

    np.testing.assert_allclose(embedder.embed_images(frames), by_library(pooled, preprocess, frames), atol=1e-4)


def test_equal_weights_in_another_file_give_the_same_fingerprint_and_others_do_not(
    timm_model: torch.nn.Module, timm_file: Path, tmp_path: Path
) -> None:
    def fingerprint(path: Path, **options: str) -> str:
        return load_embedder(f"timm:resnet10t@{path}", **{"precision": "fp32"} | options).fingerprint

    first = fingerprint(timm_file)
    state = dict(timm_model.state_dict())
    torch.save({"state_dict": state, "epoch": 3}, tmp_path / "copy.pth")
    assert fingerprint(tmp_path / "copy.pth") == first
    assert fingerprint(timm_file, precision="bf16") != first
    changed = state["conv1.0.weight"].clone()
    changed[0, 0, 0, 0] += 1e-3
    torch.save(state | {"conv1.0.weight": changed}, tmp_path / "changed.pth")
    assert fingerprint(tmp_path / "changed.pth") != first


# ---- refusals ----


def test_a_checkpoint_that_does_not_fit_is_refused_with_counts_and_names(
    timm_model: torch.nn.Module, tmp_path: Path
) -> None:
    state = dict(timm_model.state_dict())
    for name in [name for name in state if name.startswith("layer4.")]:
        del state[name]
    state |= {"surplus.weight": torch.zeros(1), "bn1.weight": torch.zeros(7)}
    torch.save(state, tmp_path / "part.pth")
    expected = (
        r"part\.pth does not hold exactly the weights of resnet10t: keys \d+ missing \(layer4\.\S+, \S+, \S+, …\); "
        r"1 unexpected \(surplus\.weight\); 1 of another shape \(bn1\.weight\)"
    )
    with pytest.raises(BadInput, match=expected):
        load_embedder(f"timm:resnet10t@{tmp_path / 'part.pth'}")


def test_an_open_clip_checkpoint_with_missing_keys_is_refused(
    clip_model: tuple[torch.nn.Module, object], tmp_path: Path
) -> None:
    state = {name: value for name, value in clip_model[0].state_dict().items() if "resblocks.3." not in name}
    torch.save(state, tmp_path / "part.pt")
    with pytest.raises(BadInput, match=rf"weights of {OPEN_CLIP}: keys \d+ missing \(\S*resblocks\.3\."):
        load_embedder(f"open_clip:{OPEN_CLIP}@{tmp_path / 'part.pt'}")


class Payload:
    def __reduce__(self) -> tuple[Callable[..., object], tuple[str, ...]]:
        return Path.touch, (Path("executed"),)  # type: ignore[return-value]


@pytest.mark.parametrize("uri", ["timm:resnet10t", "torchvision:resnet18", f"open_clip:{OPEN_CLIP}"])
def test_a_file_that_is_no_checkpoint_is_refused_and_never_executed(
    uri: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save({"state_dict": Payload()}, tmp_path / "evil.pt")
    (tmp_path / "text.pt").write_text("not a checkpoint")
    (tmp_path / "text.safetensors").write_text("not a checkpoint")
    for name in ("evil.pt", "text.pt", "text.safetensors"):
        with pytest.raises(BadInput, match=f"{name} (cannot be read as|does not hold exactly) the weights") as refused:
            load_embedder(f"{uri}@{tmp_path / name}")
        assert "weights_only" not in str(refused.value), "torch's advice would run the file"
    assert not (tmp_path / "executed").exists()


def test_broken_weights_are_reported_instead_of_nan(timm_model: torch.nn.Module, tmp_path: Path) -> None:
    state = dict(timm_model.state_dict())
    state["conv1.0.weight"] = torch.full_like(state["conv1.0.weight"], float("nan"))
    torch.save(state, tmp_path / "nan.pth")
    with pytest.raises(ZestError, match=r"NaN or infinity for 2 of 2 frames \(the first is frame 0\)"):
        load_embedder(f"timm:resnet10t@{tmp_path / 'nan.pth'}").embed_images([np.zeros((8, 8, 3), np.uint8)] * 2)


def test_a_number_that_float16_cannot_hold_is_reported_instead_of_infinity(
    timm_model: torch.nn.Module, tmp_path: Path
) -> None:
    state = dict(timm_model.state_dict())
    last = [name for name in state if name.startswith("layer4") and name.endswith("bn2.weight")][-1]
    state[last] = torch.full_like(state[last], 1e7)
    torch.save(state, tmp_path / "large.pth")
    frames = [np.full((8, 8, 3), 200, np.uint8)]
    assert np.isfinite(load_embedder(f"timm:resnet10t@{tmp_path / 'large.pth'}").embed_images(frames)).all()
    halves = load_embedder(f"timm:resnet10t@{tmp_path / 'large.pth'}", vectors="float16")
    with pytest.raises(ZestError, match=r"returned \d+, and float16 holds 65504 at most; leave --vectors float16 out"):
        halves.embed_images(frames)


@pytest.mark.parametrize(
    "uri", ["timm:resnet10t", "open_clip:ViT-B-32/openai", "torchvision:resnet50", "torchvision:resnet50/IMAGENET1K_V1"]
)
def test_an_unreachable_hub_is_told_quickly_with_the_offline_ways(
    uri: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from huggingface_hub import constants

    monkeypatch.setenv("https_proxy", "http://127.0.0.1:9")  # nothing listens there
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    setting, start = constants.HF_HUB_OFFLINE, time.monotonic()
    with pytest.raises(ZestError, match=f"{uri}@/path/to/checkpoint, or use efficientnet-lite0") as caught:
        load_embedder(uri)
    assert not isinstance(caught.value, BadInput)
    assert time.monotonic() - start < 60, "it would try again for minutes"
    assert setting == constants.HF_HUB_OFFLINE


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("efficientnet-lite", "unknown embedder.*did you mean 'efficientnet-lite0'"),
        ("opnclip:ViT-B-32/openai", "unknown embedder.*did you mean 'open_clip'"),
        ("open_clip:ViT-B32/openai", "unknown open_clip model 'ViT-B32'; did you mean 'ViT-B-32'"),
        ("open_clip:ViT-B-32/opena", "unknown weights 'opena' of open_clip:ViT-B-32; did you mean 'openai'"),
        ("open_clip:ViT-B-32", "unknown weights '' of open_clip:ViT-B-32; valid: .*openai"),
        ("timm:resnet5o", "unknown timm model 'resnet5o'; did you mean 'resnet50'"),
        ("timm:vit_base_patch16_xp_224", "timm publishes no weights.*timm:vit_base_patch16_xp_224@/path"),
        ("torchvision:resnet51", "unknown torchvision model 'resnet51'; did you mean 'resnet50'"),
        ("torchvision:resnet50/V1", "unknown weights 'V1' of torchvision:resnet50.*IMAGENET1K_V1"),
        ("timm:resnet10t@/none.pth", "/none.pth does not exist"),
        ("moco:/none.pth", "/none.pth does not exist"),
    ],
)
def test_a_wrong_name_is_refused_with_the_nearest_right_one(uri: str, message: str) -> None:
    with pytest.raises(BadInput, match=message):
        load_embedder(uri)


def test_a_wrong_option_is_refused() -> None:
    with pytest.raises(BadInput, match=r"unknown device 'gpu'.*valid: auto, cpu, cuda"):
        load_embedder("efficientnet-lite0", device="gpu")
    with pytest.raises(BadInput, match="finds no device 'cuda:99'"):
        load_embedder("efficientnet-lite0", device="cuda:99")
    with pytest.raises(BadInput, match="unknown precision 'fp16'"):
        load_embedder("efficientnet-lite0", precision="fp16")  # type: ignore[arg-type]
    with pytest.raises(BadInput, match="batch_size must be at least 1, got 0"):
        load_embedder("efficientnet-lite0", batch_size=0)
    with pytest.raises(BadInput, match=r"unknown type of vectors 'fp16'; did you mean 'float16'"):
        load_embedder("efficientnet-lite0", vectors="fp16")  # type: ignore[arg-type]


# ---- registered from outside ----

PLUGIN = """
import torch
from torchvision.transforms.functional import pil_to_tensor
from zest_rl.embedders.networks import Network

def build(rest):  # what stands after "colour:" in the URI
    torch.manual_seed(0)
    size = int(rest)
    module = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(4), torch.nn.Flatten(), torch.nn.Linear(48, 16))
    return Network(module, lambda image: pil_to_tensor(image.resize((size, size))) / 255, module)
"""


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package beside this one that registers the family ``colour:``; also for processes that are started."""
    site = tmp_path / "site"
    (site / "colourful-1.0.dist-info").mkdir(parents=True)
    (site / "colourful.py").write_text(PLUGIN)
    (site / "colourful-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: colourful\nVersion: 1.0\n")
    entry = (
        "[zest_rl.embedders]\ncolour = colourful:build\nbroken = colourful:nothing\nwrong = colourful:pil_to_tensor\n"
    )
    (site / "colourful-1.0.dist-info" / "entry_points.txt").write_text(entry)
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.setenv("PYTHONPATH", str(site))
    return site


@pytest.mark.usefixtures("plugin")
def test_an_embedder_registered_by_another_package_embeds(frames: list[np.ndarray]) -> None:
    assert len(PLUGIN.strip().splitlines()) <= 15
    embedder = load_embedder("colour:32", precision="fp32")
    assert (embedder.dim, embedder.reads_text, embedder.embed_images(frames).shape) == (16, False, (5, 16))
    other = load_embedder("colour:16", precision="fp32")
    assert other.fingerprint != embedder.fingerprint, "equal weights, another preprocessing"
    with pytest.raises(BadInput, match=r"unknown embedder 'color:3'.*colour"):
        load_embedder("color:3")


@pytest.mark.usefixtures("plugin")
@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("broken:1", "colourful:nothing, which is registered for broken:, failed on 'broken:1'"),
        ("colour:x", "colourful:build, which is registered for colour:, failed on 'colour:x' .ValueError"),
        ("wrong:1", "failed on 'wrong:1'"),
    ],
)
def test_a_registered_embedder_that_fails_is_named(uri: str, message: str) -> None:
    with pytest.raises(ZestError, match=message):
        load_embedder(uri)


@pytest.mark.usefixtures("plugin")
def test_a_registered_embedder_works_in_every_verb(
    collected: str, frames: list[np.ndarray], tmp_path: Path, zest: Callable[..., dict[str, Any]]
) -> None:
    embedder = ("--embedder", "colour:32")
    kitchen = (*embedder, "--views", 2, "--tolerance", 0.05, "--n-workers", 2)
    for what in ("goals", "actions"):
        assert zest("select", what, collected, "--top", 1, *kitchen)["n_satisfying"] > 0
    assert zest("follow", "kitchen", "knob3", "sdoor", *kitchen, "--output", tmp_path / "f.html")["sub_goals"]
    clips = tmp_path / "clips" / "oven"
    for clip in "abc":
        (clips / clip).mkdir(parents=True)
        for i, frame in enumerate(frames):
            Image.fromarray(frame).save(clips / clip / f"{i}.png")
    assert zest("select", "footage", clips.parent, *embedder)["objects"]
    goals = ("--goals", clips / "a" / "4.png", "--output", tmp_path / "v.html")
    assert zest("follow", "video", clips / "b", *embedder, *goals)["sub_goals"]
    relabeled = zest("relabel", collected, *kitchen)["dataset"]
    zest("export", relabeled, "--to", "npz", "--output", tmp_path / "data.npz")
    assert (tmp_path / "data.npz").is_file()
    assert zest("inspect", relabeled, "--output", tmp_path / "page.html")["datasets"][relabeled]["figures"]
    small = ("--n-updates", 5, "--hidden-size", 32, "--n-layers", 1, "--context-len", 2)
    run = zest("train", "dt", relabeled, "--run-dir", tmp_path / "run", *small)["run"]
    evaluated = zest("evaluate", run, "--n-episodes", 2, "--n-workers", 2, "--no-videos")
    assert evaluated["n_episodes"] == 2
    assert zest("report", run, "--output", tmp_path / "report.html")["rows"]
