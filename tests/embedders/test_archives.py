"""Checkpoints of other people: their tensors are read, and nothing that they hold is run."""

from __future__ import annotations

import argparse
import collections
import pickle
import random
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import timm
import torch
from fuzzing import damaged_bytes, faults, outcome, outcomes
from safetensors.torch import save_file
from torch import nn

from zest_rl.embedders import archives, load_embedder
from zest_rl.embedders.archives import read_archive
from zest_rl.embedders.checkpoints import fill, read_checkpoint, read_openai
from zest_rl.errors import BadInput
from zest_rl.runtime.artifacts import hash_arrays

NESTED = b"K\x01" + 60 * b"2\x86"
"""Pickle of a tuple of itself twice, 60 times: without a memory of hashes, 2^60 steps."""
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit:FutureWarning")


class Block(nn.Module):
    """One of everything that a module may hold."""

    def __init__(self) -> None:
        super().__init__()
        self.last, self.norm, self.first = nn.Linear(2, 3), nn.BatchNorm1d(3), nn.Linear(2, 3)
        self.register_buffer("size", torch.tensor(5))
        self.register_buffer("mask", torch.ones(1, 2, dtype=torch.float64), persistent=False)
        self.plain, self.names, self.number = torch.ones(2), ["a"], 1.5

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.norm(self.last(x)) + self.first(x)


class Trap(nn.Module):
    """Writes a file when `torch.jit.load` restores it."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(2))

    @torch.jit.export
    def __getstate__(self) -> tuple[torch.Tensor, bool]:
        return self.weight, self.training

    @torch.jit.export
    def __setstate__(self, state: tuple[torch.Tensor, bool]) -> None:
        self.weight = torch.from_file("executed", shared=True, size=2).copy_(state[0])
        self.training = state[1]

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x * self.weight


@pytest.fixture(scope="module")
def net() -> nn.Module:
    torch.manual_seed(0)
    return timm.create_model("resnet18", pretrained=False, num_classes=10)


@pytest.mark.parametrize("save", [torch.jit.script, lambda m: torch.jit.trace(m.eval(), torch.ones(1, 2)).half()])
def test_the_state_dict_of_torchscript_is_the_one_that_torch_would_load(
    save: Callable[..., Any], tmp_path: Path
) -> None:
    save(Block()).save(str(tmp_path / "block.pt"))
    ours, torchs = read_archive(tmp_path / "block.pt"), torch.jit.load(str(tmp_path / "block.pt")).state_dict()
    assert list(ours) == list(torchs)
    for name, tensor in torchs.items():
        assert ours[name].dtype == tensor.dtype
        assert torch.equal(ours[name], tensor)


def test_torchscript_weights_are_read_and_its_code_is_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.jit.script(Trap()).save("trap.pt")
    for uri in ("timm:resnet18", "open_clip:ViT-S-32-alt", "torchvision:resnet18"):
        with pytest.raises(BadInput, match=r"trap\.pt"):
            load_embedder(f"{uri}@trap.pt")
    assert not Path("executed").exists()
    torch.jit.load("trap.pt")
    assert Path("executed").exists(), "torch runs nothing on loading: this test could not fail"


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize(
    "wrap",
    [
        lambda s: {"model": s, "args": argparse.Namespace(lr=0.1), "epoch": 3},
        lambda s: {"model_state_dict": s, "optimizer_state_dict": {}},
        lambda s: {"state_dict": {f"model.{k}": v for k, v in s.items()} | {"loss.weight": torch.ones(1)}},
        lambda s: {"student": {f"module.backbone.{k}": v for k, v in s.items()} | {"module.head.w": torch.ones(1)}},
        lambda s: {f"_orig_mod.module.{k}": v for k, v in s.items()},
        lambda s: {f"module._orig_mod.{k}": v for k, v in s.items()},
        lambda s: {"model": {}, "model_ema": {f"module.{k}": v for k, v in s.items()} | {"n_averaged": torch.ones(1)}},
    ],
    ids=["options beside", "tutorial", "lightning", "dino", "compiled", "distributed", "averaged"],
)
def test_weights_are_found_in_what_training_scripts_wrap_around_them(
    wrap: Callable[[Any], Any], legacy: bool, net: nn.Module, tmp_path: Path
) -> None:
    torch.save(wrap(net.state_dict()), tmp_path / "w.pth", _use_new_zipfile_serialization=not legacy)
    empty = timm.create_model("resnet18", pretrained=False, num_classes=10)
    fill(empty, read_checkpoint(tmp_path / "w.pth"), tmp_path / "w.pth", "resnet18")
    for name, tensor in net.state_dict().items():
        assert torch.equal(empty.state_dict()[name], tensor)


def test_a_whole_model_is_refused_with_how_to_save_its_weights(net: nn.Module, tmp_path: Path) -> None:
    torch.save(net, tmp_path / "whole.pth")
    with pytest.raises(BadInput, match=r"whole object of timm\.models\.resnet\.ResNet.*torch.save\(model.state_dict"):
        load_embedder(f"timm:resnet18@{tmp_path / 'whole.pth'}")
    torch.save(net, tmp_path / "old.pth", _use_new_zipfile_serialization=False)
    with pytest.raises(BadInput, match="it holds objects besides tensors and plain values") as refused:
        load_embedder(f"timm:resnet18@{tmp_path / 'old.pth'}")
    assert "weights_only" not in str(refused.value)


def archive(path: Path, data: bytes, *, compression: int = zipfile.ZIP_STORED, **files: bytes) -> Path:
    with zipfile.ZipFile(path, "w", compression) as file:
        for name, content in {"data.pkl": data, **files}.items():
            file.writestr(f"a/{name}", content)
    return path


@pytest.mark.parametrize(
    ("data", "files", "message"),
    [
        (b"\x80\x05\x96" + (2**62).to_bytes(8, "little") + b".", {}, "cannot be read"),  # a bytearray of 4 EB
        (b"(" * 100_000 + b"t" * 100_000 + b".", {}, "whole object"),
        (pickle.dumps({}), {"x/data.pkl": b""}, "expected one data.pkl"),
        (pickle.dumps({}), {"byteorder": b"big"}, "big-endian"),
        (pickle.dumps([0] * archives.MAX_PICKLE), {}, "larger than"),
        (b"(K\x01K\x01" + NESTED + b"K\x01K\x01tQ.", {}, "a storage is named by a tuple"),
    ],
)
def test_a_malicious_archive_is_refused_before_room_is_made(
    data: bytes, files: dict[str, bytes], message: str, tmp_path: Path
) -> None:
    path = archive(tmp_path / "a.pth", data, **files)
    end = outcome(lambda: read_checkpoint(path))
    assert (end.kind, message in end.detail) == ("refused", True), end.detail


@pytest.mark.parametrize(
    "data",
    [
        b"}" + NESTED + b"K\x01s.",
        b"}(" + NESTED + b"K\x01u.",
        b"(" + NESTED + b"K\x01d.",
        b"}X\x01\0\0\0a\x8f(" + NESTED + b"\x90s.",
        b"}X\x01\0\0\0a(" + NESTED + b"\x91s.",
        b"ccollections\nOrderedDict\n(](" + NESTED + b"K\x01tatR.",
    ],
)
def test_keys_that_would_take_forever_to_hash_are_left_out(data: bytes, tmp_path: Path) -> None:
    path = archive(tmp_path / "a.pth", b"\x80\x04" + data)
    assert outcome(lambda: len(read_checkpoint(path))).kind == "read"


def test_counts_and_sets_beside_the_weights_do_not_keep_them_from_being_read(tmp_path: Path) -> None:
    beside = {"seen": {1, 2}, "counts": collections.defaultdict(int, {"a": 1}), ("a", 1): 2}
    torch.save({"model": {"w": torch.ones(2)}, **beside}, tmp_path / "a.pth")
    assert list(read_checkpoint(tmp_path / "a.pth")) == ["w"]


def test_weights_of_dtypes_that_torch_stores_untyped_are_read(tmp_path: Path) -> None:
    weights = {"a": torch.arange(6.0).reshape(2, 3).T.to(torch.float8_e4m3fn), "b": torch.ones(2, dtype=torch.uint16)}
    torch.save(weights, tmp_path / "a.pth")
    read = read_checkpoint(tmp_path / "a.pth")
    assert [(t.dtype, t.float().tolist()) for t in read.values()] == [
        (t.dtype, t.float().tolist()) for t in weights.values()
    ]


def test_the_format_of_a_file_that_torch_refuses_is_named(tmp_path: Path) -> None:
    with tarfile.open(tmp_path / "a.pth", "w") as file:
        for name in ("sys_info", "pickle", "storages", "tensors"):
            (tmp_path / name).write_bytes(pickle.dumps({}))
            file.add(tmp_path / name, name)
    (tmp_path / "b.pth").write_bytes(b"garbage")
    for name, message in (("a", "it is a tar archive"), ("b", "it is damaged, or no file of torch.save")):
        with pytest.raises(BadInput, match=message):
            read_checkpoint(tmp_path / f"{name}.pth")


def test_an_archive_that_expands_is_refused(tmp_path: Path) -> None:
    bomb = archive(tmp_path / "b.pth", pickle.dumps({}), compression=zipfile.ZIP_DEFLATED, data0=bytes(2**27))
    with pytest.raises(BadInput, match="together larger than the file"):
        read_checkpoint(bomb)


@pytest.mark.parametrize("n", [60, pytest.param(1500, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", ["zip", "legacy", "script", "safetensors"])
def test_a_damaged_checkpoint_is_read_or_refused(kind: str, n: int, tmp_path: Path) -> None:
    block = Block()
    path = tmp_path / ("c.safetensors" if kind == "safetensors" else "c.pt")
    match kind:
        case "zip" | "legacy":
            torch.save({"model": block.state_dict(), "args": argparse.Namespace(lr=1)}, path,
                       _use_new_zipfile_serialization=kind == "zip")  # fmt: skip
        case "script":
            torch.jit.script(block).save(str(path))
        case _:
            save_file(block.state_dict(), path)
    whole, rng = path.read_bytes(), random.Random(0)

    def read(i: int) -> str:
        path.write_bytes(damaged[i])
        read_openai(path)
        state = read_checkpoint(path)
        if kind != "script":  # which holds more than the state dict
            fill(block, state, path, "Block")
        return hash_arrays(*(tensor.numpy() for tensor in state.values()))

    damaged = [whole, *(damaged_bytes(whole, rng) for _ in range(n))]
    first, *others = outcomes(read, n + 1)
    counts, bad = faults(others)
    print(kind, n, dict(counts))
    assert first.kind == "read", first.detail
    assert not bad, bad[0].detail
