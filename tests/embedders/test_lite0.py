from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from timm.data.transforms_factory import create_transform

from zest_rl.data.images import list_images, read_image
from zest_rl.embedders import lite0, load_embedder
from zest_rl.embedders.checkpoints import LITE0_PREPROCESSING, installed_weights
from zest_rl.errors import BadInput, ZestError

DRAWINGS = Path(__file__).parents[2] / "datasets" / "goals"


@pytest.mark.parametrize(
    ("height", "width"), [(224, 224), (256, 256), (64, 64), (225, 225), (480, 640), (641, 479), (8, 8), (1, 7)]
)
def test_preprocessing_is_timms_to_the_bit(height: int, width: int) -> None:
    frame = np.random.default_rng(height).integers(0, 256, (height, width, 3), dtype=np.uint8)
    image = Image.fromarray(frame)
    np.testing.assert_array_equal(lite0.pixels(image), create_transform(**LITE0_PREPROCESSING)(image).numpy())


def test_onnx_runtime_gives_the_vectors_of_torch_to_1e_5_of_their_length() -> None:
    rng = np.random.default_rng(0)
    frames = [read_image(path) for path in sorted(DRAWINGS.glob("*/*/*.png"))]
    frames += [np.full((224, 224, 3), level, np.uint8) for level in (0, 255)]
    frames += [rng.integers(0, 256, (size, size, 3), dtype=np.uint8) for size in (32, 224)]
    onnx, torch = (load_embedder("efficientnet-lite0", device="cpu", backend=name) for name in ("auto", "torch"))
    assert (onnx.backend, torch.backend) == ("onnxruntime", "torch")
    vectors, expected = onnx.embed_images(frames), torch.embed_images(frames)
    assert (np.linalg.norm(vectors - expected, axis=1) < 1e-5 * np.linalg.norm(expected, axis=1)).all()


def test_the_backend_is_part_of_the_caches_key_and_not_of_the_fingerprint() -> None:
    onnx, torch = (load_embedder("efficientnet-lite0", device="cpu", backend=name) for name in ("auto", "torch"))
    assert onnx.fingerprint == torch.fingerprint
    assert onnx.cache_key != torch.cache_key == torch.fingerprint


def test_one_thread_or_all_cores_and_batches_of_any_size_give_the_same_vectors() -> None:
    frames = [read_image(path) for path in list_images(DRAWINGS / "micro" / "goal")]
    alone, together = (
        load_embedder("efficientnet-lite0", device="cpu", one_thread=one_thread, batch_size=n).embed_images(frames)
        for one_thread, n in ((True, 1), (False, 16))
    )
    np.testing.assert_allclose(alone, together, atol=1e-4)


def test_a_picture_has_the_same_vector_in_any_company() -> None:
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 256, (224, 224, 3), dtype=np.uint8) for _ in range(5)]
    embedder = load_embedder("efficientnet-lite0", device="cpu", one_thread=True)
    assert embedder.backend == "onnxruntime"
    one_by_one = np.concatenate([embedder.embed_images([frame]) for frame in frames])
    np.testing.assert_array_equal(embedder.embed_images(frames), one_by_one)


def test_a_process_that_embeds_does_not_load_torch() -> None:
    code = (
        "import sys; import numpy as np; from zest_rl.rewards.embeddings import shared_embedder;"
        "embedder = shared_embedder('efficientnet-lite0', 'auto', 'cpu', 'auto', 'float32');"
        "embedder.embed_images([np.zeros((224, 224, 3), np.uint8)]);"
        "print([name for name in ('torch', 'torchvision', 'timm') if name in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_bf16_is_computed_by_torch() -> None:
    assert load_embedder("efficientnet-lite0", device="cpu", precision="bf16").backend == "torch"


def test_without_onnx_runtime_torch_computes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    embedder = load_embedder("efficientnet-lite0", device="cpu")
    assert embedder.backend == "torch"
    assert embedder.embed_images([np.zeros((8, 8, 3), np.uint8)]).shape == (1, 1280)


def test_an_unknown_backend_is_refused() -> None:
    with pytest.raises(BadInput, match=r"unknown backend 'onnx'; .*torch"):
        load_embedder("efficientnet-lite0", backend="onnx")  # type: ignore[arg-type]


def test_a_file_of_another_layout_is_refused(tmp_path: Path) -> None:
    content = installed_weights().read_bytes()
    (tmp_path / "short.pth").write_bytes(content[:-1000])
    (tmp_path / "noise.pth").write_bytes(b"no weights")
    for name in ("short.pth", "noise.pth"):
        with pytest.raises(ZestError, match=rf"{name} is not laid out as expected; reinstall efficientnet-lite0-py"):
            lite0.load(tmp_path / name, one_thread=True)
