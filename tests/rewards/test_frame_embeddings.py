from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from PIL import Image

from zest_rl.kitchen.views import Views
from zest_rl.rewards.frame_embeddings import FrameEmbeddings
from zest_rl.rewards.state_embeddings import StateEmbedder, StateEmbeddings
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
    source = kitchen_source(collected, Views("micro", n_views=2, size=96, tolerance=0.05))
    frames = source.frames
    assert isinstance(frames, KitchenStates)
    by_state = StateEmbeddings(StateEmbedder(frames.ring, "efficientnet-lite0", n_workers=1), frames.states)
    by_frame = FrameEmbeddings(source, "efficientnet-lite0", n_workers=1)
    for embeddings in (by_state, by_frame):
        embeddings.embed()
    assert by_state.n_embedded < sum(map(len, frames.states)) / 2, "equal states are embedded once"
    for one, other in zip(by_state, by_frame, strict=True):
        np.testing.assert_allclose(one.embeddings[one.index], other.embeddings[other.index], atol=1e-4)
