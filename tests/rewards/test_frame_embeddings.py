from __future__ import annotations

import random
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from fuzzing import damaged_bytes, faults, outcomes
from PIL import Image

from zest_rl.errors import ZestError
from zest_rl.kitchen.views import Views
from zest_rl.rewards.frame_embeddings import FrameEmbeddings
from zest_rl.rewards.state_embeddings import StateEmbedder, StateEmbeddings
from zest_rl.runtime import artifacts
from zest_rl.runtime.arrays import write_arrays
from zest_rl.sources import Source, open_source
from zest_rl.sources.kitchen import KitchenStates, kitchen_source
from zest_rl.sources.videos import EpisodeVideos
from zest_rl.types import Frame

N_EPISODES = 4


@dataclass(frozen=True)
class CountedVideos(EpisodeVideos):
    """Real pictures in folders, that tell how often they are sent to a process; here they wait for all but one."""

    cache: Path
    n_sent: list[int]

    def __reduce__(self) -> tuple[Any, ...]:
        self.n_sent[0] += 1
        return EpisodeVideos, (self.paths,)

    def read(self, episode: int) -> Iterator[Sequence[Frame]]:
        deadline = time.monotonic() + 60
        while len(list(self.cache.glob("frames/*/*.npz"))) < N_EPISODES - 1 and time.monotonic() < deadline:
            time.sleep(0.02)
        return super().read(episode)


@pytest.fixture
def source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Source:
    """Episodes of one action in robomimic's file, and two pictures of each in a folder."""
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "cache"))
    rng = np.random.default_rng(0)
    with h5py.File(tmp_path / "some.hdf5", "w") as file:
        for i in range(N_EPISODES):
            file[f"data/demo_{i}/actions"], file[f"data/demo_{i}/obs/joints"] = np.zeros((1, 2)), np.zeros((1, 3))
            (tmp_path / f"films/episode_{i}").mkdir(parents=True)
            for t in range(2):
                Image.fromarray(picture(rng)).save(tmp_path / f"films/episode_{i}/{t}.png")
    for part in ("init", "goal"):
        (tmp_path / "goal" / part).mkdir(parents=True)
        Image.fromarray(picture(rng)).save(tmp_path / "goal" / part / "0.png")
    return open_source(str(tmp_path / "some.hdf5"), frames=[str(tmp_path / "films")])


def picture(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 256, (16, 16, 3), dtype=np.uint8)


def test_the_paths_of_all_episodes_are_not_sent_with_each_job(source: Source, tmp_path: Path) -> None:
    assert isinstance(source.frames, EpisodeVideos)
    counted = CountedVideos(source.frames.paths, tmp_path / "cache", [0])
    embeddings = FrameEmbeddings(Source(source.trajectories, counted), "efficientnet-lite0", device="cpu", n_workers=2)
    embeddings.embed()
    assert counted.n_sent == [2], "once to each worker"
    assert [episode.embeddings.shape for episode in embeddings] == [(2, 1, 1280)] * N_EPISODES


def test_the_kitchen_embedded_by_distinct_states_is_the_kitchen_embedded_frame_by_frame(collected: str) -> None:
    source = kitchen_source(collected, Views("micro", n_views=1, size=96, tolerance=0.05))
    frames = source.frames
    assert isinstance(frames, KitchenStates)
    by_state = StateEmbeddings(StateEmbedder(frames.ring, "efficientnet-lite0", n_workers=1), frames.states)
    by_frame = FrameEmbeddings(source, "efficientnet-lite0", n_workers=1)
    for embeddings in (by_state, by_frame):
        embeddings.embed()
    assert by_state.n_embedded < sum(map(len, frames.states)) / 2, "equal states are embedded once"
    for one, other in zip(by_state, by_frame, strict=True):
        np.testing.assert_allclose(one.embeddings[one.index], other.embeddings[other.index], atol=1e-4)


def test_float16_embeddings_take_half_of_the_space_and_are_those_of_float32_rounded(
    source: Source, tmp_path: Path
) -> None:
    expected, files = filled(source, tmp_path / "cache")
    for n_workers in (1, 2, 1):  # the last one finds them in the cache
        halves = FrameEmbeddings(source, "efficientnet-lite0", vectors="float16", device="cpu", n_workers=n_workers)
        halves.embed()
        for episode, whole in zip(halves, expected, strict=True):
            np.testing.assert_array_equal(episode.embeddings, whole.astype(np.float16).astype(np.float32))
            assert episode.embeddings.dtype == np.float32
        if n_workers == 1:
            small = set((tmp_path / "cache").glob("frames/*/*.npz")) - set(files)
            assert len(small) == len(files)
            assert max(path.stat().st_size for path in small) < 0.6 * min(path.stat().st_size for path in files)
            for path in small if halves.n_embedded else ():
                path.unlink()


# --- damage and other numbers -----------------------------------------------------------------------------------------


def embeddings_of(source: Source) -> FrameEmbeddings:
    return FrameEmbeddings(source, "efficientnet-lite0", device="cpu", n_workers=1)


def filled(source: Source, cache: Path) -> tuple[list[np.ndarray], list[Path]]:
    """Embed all episodes; return their embeddings and the files of the cache."""
    embeddings = embeddings_of(source)
    embeddings.embed()
    return [episode.embeddings for episode in embeddings], sorted(cache.glob("frames/*/*.npz"))


@pytest.mark.parametrize("n_inputs", [8, pytest.param(300, marks=pytest.mark.slow)])
def test_whatever_happens_to_the_files_the_embeddings_are_those_of_the_frames(
    n_inputs: int, source: Source, tmp_path: Path
) -> None:
    expected, files = filled(source, tmp_path / "cache")
    whole = {path: path.read_bytes() for path in files}

    def read(seed: int) -> str:
        rng = random.Random(seed)
        late = embeddings_of(source)
        damage(rng)
        late.embed()
        damage(rng)  # what is read was whole a moment before
        return artifacts.hash_arrays(*(episode.embeddings for episode in late))

    def damage(rng: random.Random) -> None:
        for path in files:
            path.write_bytes(damaged_bytes(whole[path], rng) if rng.random() < 0.5 else whole[path])

    ends = outcomes(read, n_inputs)
    kinds, wrong = faults(ends)
    assert not wrong
    assert kinds == {"read": n_inputs}
    assert {end.detail for end in ends} == {repr(artifacts.hash_arrays(*expected))}


def test_whole_files_with_other_numbers_are_refused_and_nothing_is_deleted(source: Source, tmp_path: Path) -> None:
    _, files = filled(source, tmp_path / "cache")
    content = [path.read_bytes() for path in files]
    for path, other in zip(files, content[1:] + content[:1], strict=True):
        path.write_bytes(other)
    with pytest.raises(ZestError, match=rf"cache {files[0].parent} are not those .*; delete that folder, then run"):
        embeddings_of(source).embed()
    assert [path.read_bytes() for path in files] == content[1:] + content[:1]


def test_a_cached_episode_costs_no_more_than_the_frames_that_are_compared(source: Source, tmp_path: Path) -> None:
    filled(source, tmp_path / "cache")
    again, state = embeddings_of(source), random.getstate()
    again.embed()
    assert again.n_embedded == 0
    assert random.getstate() == state, "the caller's random numbers are left alone"


@pytest.mark.parametrize("shape", [(2, 3, 1280), (4, 1, 1280)], ids=["views", "steps"])
def test_a_file_of_other_views_or_steps_is_damage_and_not_the_dataset_s_fault(
    shape: tuple[int, ...], source: Source, tmp_path: Path
) -> None:
    expected, files = filled(source, tmp_path / "cache")
    for path in files:
        write_arrays(path, {"embeddings": np.ones(shape, np.float32)})
    again = embeddings_of(source)
    again.embed()
    for episode, embeddings in zip(again, expected, strict=True):
        np.testing.assert_array_equal(episode.embeddings, embeddings)
