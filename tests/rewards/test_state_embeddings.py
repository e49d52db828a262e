from __future__ import annotations

import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from zest_rl.embedders import load_embedder
from zest_rl.errors import ZestError
from zest_rl.kitchen.env import KitchenEnv
from zest_rl.kitchen.views import Views, canonical_states
from zest_rl.rewards import state_embeddings
from zest_rl.rewards.embeddings import check_equal
from zest_rl.rewards.state_embeddings import STATES_PER_SHARD, StateEmbedder
from zest_rl.runtime.arrays import read_arrays, write_arrays
from zest_rl.runtime.parallel import chunks, one_thread

VIEWS = Views("micro", n_views=2, size=96)
EMBEDDER = "efficientnet-lite0"
MICROWAVE, ELBOW, KNOB, BURNER = 22, 3, 11, 12
"""Places in qpos."""


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def opening(n: int, last: float = -0.75) -> np.ndarray:
    """(n, 30) states: the microwave opens, from closed to `last`."""
    states = np.tile(KitchenEnv("micro").start_qpos, (n, 1))
    states[:, MICROWAVE] = np.linspace(0, last, n)
    return states


def single(views: Views = VIEWS, embedder: str = EMBEDDER, **options: Any) -> StateEmbedder:
    return StateEmbedder(views, embedder, n_workers=1, **options)


def embedded(embedder: StateEmbedder, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    embedder.embed(states)
    episode = embedder.embedded(states)
    return episode.embeddings[1:], episode.index - 1  # without x_0 at the top, which is there twice


# --- once ---


def test_each_distinct_state_is_embedded_once_and_found_again_by_its_index() -> None:
    states = opening(3)[[0, 0, 2, 1, 2, 0]]
    states[:, ELBOW] += np.linspace(0, 1, 6)  # the robot is hidden
    states[3, MICROWAVE] += 1e-4  # within the tolerance
    embedder = single()
    embeddings, index = embedded(embedder, states)
    assert embeddings.shape == (3, 2, 1280)
    assert embeddings.dtype == np.float32
    assert embedder.n_embedded == 3
    assert index[0] == index[1] == index[5]
    assert index[2] == index[4]
    assert len({index[0], index[2], index[3]}) == 3

    with VIEWS.renderer() as renderer, one_thread():
        for state, row in zip(states, embeddings[index], strict=True):
            frames = renderer.render(np.round(state / VIEWS.tolerance) * VIEWS.tolerance)
            alone = np.concatenate([load_embedder("efficientnet-lite0").embed_images([frame]) for frame in frames])
            np.testing.assert_allclose(row, alone, atol=1e-4)


def test_states_that_differ_in_what_no_view_sees_have_the_bits_of_one() -> None:
    states = np.tile(KitchenEnv("knob2").start_qpos, (4, 1))
    states[:, KNOB] = [0, -0.1, -0.2, -0.2]
    states[3, BURNER] = -0.009
    together = single(Views("knob2", size=96)).embed_now(states)
    assert together.shape == (4, 4, 1280)
    np.testing.assert_array_equal(together[0], together[1])
    np.testing.assert_array_equal(together[0], together[2])
    assert (together[0] != together[3]).any()
    alone = [single(Views("knob2", size=96)).embed_now(state[None])[0] for state in states]
    np.testing.assert_array_equal(together, alone)


def test_what_was_embedded_is_taken_from_the_cache_by_the_same_object_and_by_the_next() -> None:
    first = single()
    embeddings, _ = embedded(first, opening(4))
    first.embed(opening(4))
    assert first.n_embedded == 4

    later = single()
    again, _ = embedded(later, opening(4)[::-1])
    assert later.n_embedded == 0
    np.testing.assert_array_equal(again, embeddings)
    more, index = embedded(later, np.concatenate([opening(4), opening(2, last=-0.1)]))
    assert later.n_embedded == 1
    np.testing.assert_array_equal(more[index[:4]], embeddings[::-1])  # the states are sorted: opening is negative


def test_progress_is_told_in_shards_and_only_for_what_is_missing() -> None:
    embedder = single(replace(VIEWS, n_views=1, size=32))
    told: list[tuple[int, int]] = []
    states = opening(STATES_PER_SHARD + 1)
    embedder.embed(states, lambda done, total: told.append((done, total)))
    assert told == [(1, 2), (2, 2)]
    embedder.embed(states, lambda done, total: told.append((done, total)))
    assert told == [(1, 2), (2, 2)]
    assert len(list(embedder.folder.glob("*.npz"))) == 2


@pytest.mark.parametrize("damage", ["cut off", "emptied", "overwritten", "removed"])
def test_a_damaged_shard_is_embedded_again_and_replaced(damage: str) -> None:
    first = single()
    expected, _ = embedded(first, opening(2))
    first.embed(opening(2, last=-0.3))
    shards = sorted(first.folder.glob("*.npz"))
    assert len(shards) == 2
    content = shards[0].read_bytes()
    if damage == "removed":
        shards[0].unlink()
    else:
        damaged = {"cut off": content[: len(content) // 2], "emptied": b"", "overwritten": b"no numpy file"}
        shards[0].write_bytes(damaged[damage])

    second = single()
    np.testing.assert_array_equal(embedded(second, opening(2))[0], expected)
    second.embed(opening(2, last=-0.3))
    assert 1 <= second.n_embedded <= 2
    third = single()
    np.testing.assert_array_equal(embedded(third, opening(2))[0], expected)
    third.embed(opening(2, last=-0.3))
    assert third.n_embedded == 0


def test_damage_that_shows_late_is_mended_without_a_word(capfd: pytest.CaptureFixture[str]) -> None:
    first = single()
    expected, _ = embedded(first, opening(2))
    (shard,) = first.folder.glob("*.npz")
    content = bytearray(shard.read_bytes())
    content[content.index(b"embeddings.npy") + 2000] ^= 1  # among the numbers
    shard.write_bytes(content)
    state_embeddings._read_shard.cache_clear()
    again = first.embedded(opening(2))
    np.testing.assert_array_equal(again.embeddings[1:], expected)
    assert first.n_embedded == 4, "the same object embeds them again"
    later = single()
    np.testing.assert_array_equal(embedded(later, opening(2))[0], expected)
    assert later.n_embedded == 0, "and keeps them"
    assert capfd.readouterr() == ("", "")


def exchange(folder: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Give whole files, with their digests, other numbers."""
    for path in folder.glob("*.npz"):
        arrays = read_arrays(path)
        assert arrays is not None
        write_arrays(path, {**arrays, "embeddings": change(arrays["embeddings"])})
    state_embeddings._read_shard.cache_clear()


@pytest.mark.parametrize("online", [False, True], ids=["recorded", "in a rollout"])
def test_whole_files_with_other_numbers_are_refused_and_nothing_is_deleted(online: bool) -> None:
    first = single()
    embedded(first, opening(40))
    exchange(first.folder, lambda vectors: np.roll(vectors, len(vectors) // 2, axis=0))
    before = {path: path.read_bytes() for path in first.folder.iterdir()}
    later = single()
    with pytest.raises(
        ZestError, match=rf"cache {first.folder} are not .* off by \d+% of .*; delete that folder, then"
    ):
        later.embed_now(opening(3, last=-0.9)) if online else later.embed(opening(40))
    assert {path: path.read_bytes() for path in first.folder.iterdir()} == before


def test_numbers_whose_norm_float16_cannot_hold_are_compared(cache: Path) -> None:
    computed = np.full((1, 1280), 100, np.float16)
    check_equal(cache, [(computed, computed)])
    with pytest.raises(ZestError, match="are not those that this machine computes: one is off by 50% of its length"):
        check_equal(cache, [(computed / 2, computed)])


def test_the_last_digits_of_another_device_are_no_other_numbers() -> None:
    first = single()
    expected, _ = embedded(first, opening(4))
    noise = np.random.default_rng(0).normal(size=(4, 2, 1280)).astype(np.float32)
    exchange(first.folder, lambda vectors: vectors * (1 + 0.01 * noise))
    assert not np.array_equal(embedded(single(), opening(4))[0], expected)


@pytest.mark.parametrize(
    "change", [lambda v: v[:, :1].copy(), lambda v: v.astype(np.float64), lambda v: v * np.nan, lambda v: v[:1]]
)
def test_whole_files_of_another_form_are_damage(change: Callable[[np.ndarray], np.ndarray]) -> None:
    first = single()
    expected, _ = embedded(first, opening(3))
    exchange(first.folder, change)
    np.testing.assert_array_equal(embedded(single(), opening(3))[0], expected)


def test_memory_does_not_grow_with_the_number_of_states(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state_embeddings, "N_CHECKED", 0)  # here a state's vector is its number
    monkeypatch.setattr(state_embeddings, "_read_shard", lru_cache(maxsize=2)(state_embeddings._read_shard.__wrapped__))
    states = canonical_states(opening(1200), VIEWS)
    folder = single().folder
    for part in chunks(len(states), STATES_PER_SHARD):
        vectors = np.repeat(np.arange(part.start, part.stop, dtype=np.float32), 2560).reshape(-1, 2, 1280)
        write_arrays(folder / f"{part.start}.npz", {"keys": states[part.start : part.stop], "embeddings": vectors})
    tracemalloc.start()
    try:
        embedder = single()
        embedder.embed(states)
        for i, state in enumerate(states):
            assert embedder.embedded(state[None]).embeddings[0, 0, 0] in (i, i - 1, i + 1), (
                "states within the tolerance are one"
            )
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert embedder.n_embedded == 0
    assert peak < 4e6 < states.shape[0] * 2 * 1280 * 4, "all embeddings are 12 MB"


# --- the same bits, whichever way ---


def test_embedding_within_a_rollout_gives_the_bits_that_embedding_a_dataset_gives(cache: Path) -> None:
    states = opening(5)[[0, 3, 3, 1, 4, 2]]
    online = single()
    rows = online.embed_now(states)
    assert rows.shape == (6, 2, 1280)
    assert online.n_embedded == 5
    assert not list(cache.rglob("*.npz")), "nothing is written during a rollout"

    embeddings, index = embedded(single(), states)
    np.testing.assert_array_equal(rows, embeddings[index])


def test_flush_leaves_what_a_rollout_embedded_in_the_cache() -> None:
    online = single()
    rows = online.embed_now(opening(3))
    online.flush()
    online.flush()
    later = single()
    np.testing.assert_array_equal(later.embed_now(opening(3)), rows)
    embeddings, index = embedded(later, opening(3))
    np.testing.assert_array_equal(embeddings[index], rows)
    assert later.n_embedded == 0
    assert len(list(online.folder.glob("*.npz"))) == 1


def test_two_worker_processes_give_the_bits_of_one_and_end_quietly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    states = opening(6)
    here, _ = embedded(single(), states)
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "of two"))
    monkeypatch.setattr(state_embeddings, "STATES_PER_SHARD", 2)
    spread = StateEmbedder(VIEWS, EMBEDDER, n_workers=2)
    there, _ = embedded(spread, states)
    assert len(list(spread.folder.glob("*.npz"))) == 3
    np.testing.assert_array_equal(there, here)
    assert "Traceback" not in capfd.readouterr().err


def test_a_process_that_rendered_ends_quietly() -> None:
    code = (
        "import numpy as np; from zest_rl.kitchen.views import Views\n"
        "for size in (32, 64): print(Views('micro', n_views=1, size=size).shared_renderer().render(np.zeros(30)).shape)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.split("\n")[:2] == ["(1, 32, 32, 3)", "(1, 64, 64, 3)"]


@pytest.mark.parametrize("backend", ["auto", "torch"])
def test_embeddings_do_not_depend_on_torchs_threads_and_leave_them_alone(
    backend: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = torch.get_num_threads()
    results = []
    try:
        for n_threads in (1, 3):
            monkeypatch.setenv("ZEST_CACHE", str(tmp_path / str(n_threads)))
            torch.set_num_threads(n_threads)
            results.append(embedded(single(backend=backend), opening(2))[0])
            assert torch.get_num_threads() == n_threads
    finally:
        torch.set_num_threads(before)
    np.testing.assert_array_equal(*results)


# --- half precision ---


def test_float16_embeddings_are_those_of_float32_rounded_wherever_they_come_from(cache: Path) -> None:
    states = opening(3)
    expected = single().embed_now(states).astype(np.float16).astype(np.float32)
    halves = single(vectors="float16")
    np.testing.assert_array_equal(halves.embed_now(states), expected)
    halves.flush()
    for embedder in (single(vectors="float16"), StateEmbedder(VIEWS, EMBEDDER, vectors="float16", n_workers=2)):
        embedder.embed(np.concatenate([states, opening(2, last=-0.5)]))
        np.testing.assert_array_equal(embedder.embed_now(states), expected)
    for path in halves.folder.glob("*.npz"):
        arrays = read_arrays(path)
        assert arrays is not None
        assert arrays["embeddings"].dtype == np.float16


# --- one cache per way of looking ---


def test_other_views_networks_precisions_backends_or_types_have_another_cache_and_another_device_has_not() -> None:
    embedders = [
        single(),
        single(replace(VIEWS, n_views=3)),
        single(replace(VIEWS, task="sdoor")),
        single(replace(VIEWS, robot=True)),
        single(replace(VIEWS, tolerance=0)),
        single(precision="bf16"),
        single(backend="torch"),
        single(vectors="float16"),
    ]
    folders = [embedder.folder for embedder in embedders]
    assert len(set(folders)) == len(embedders)
    assert single(device="cpu").folder == folders[0]


def test_equal_weights_share_a_cache_and_other_weights_do_not(tmp_path: Path) -> None:
    import timm

    folders = []
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        torch.manual_seed(seed)
        torch.save(timm.create_model("resnet10t", pretrained=False).state_dict(), tmp_path / f"{name}.pth")
        folders.append(single(embedder=f"timm:resnet10t@{tmp_path / name}.pth").folder)
    assert folders[0] == folders[1] != folders[2]
