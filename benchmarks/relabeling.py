"""From recorded states to rewards: `zest_rl.rewards.relabel` against the loop that one would write, and scoring again.

The plain loop renders each frame with ``env.render()`` of gymnasium-robotics' FrankaKitchen-v1 and embeds it on its own
through timm in fp32, one view; it is timed on a few frames. Ours is the whole of `relabel` on an empty cache, 8 views:
goal, rendering, embedding, scoring, writing. Both are counted per frame and view of the dataset, on one torch thread,
in processor time of this process and its children; imports are left out.

Scoring again asks how long another goal or formula takes once the states are embedded: 60 episodes, 6,060 frames, 8
views. The episodes are rolled out; the vectors in the cache are those of the first part, handed out in turn, because
their values have no influence on the time.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zest_rl.data.reader import open_dataset
from zest_rl.data.writer import write_dataset
from zest_rl.kitchen.behaviour import Behaviour, recordings, rollout
from zest_rl.kitchen.env import env_spec
from zest_rl.kitchen.views import Views, distinct_states
from zest_rl.rewards import state_embeddings
from zest_rl.rewards.relabel import relabel_source
from zest_rl.rewards.scorer import ScorerConfig
from zest_rl.rewards.state_embeddings import STATES_PER_SHARD, StateEmbedder
from zest_rl.rewards.state_scorer import StateScorer
from zest_rl.runtime import artifacts
from zest_rl.runtime.arrays import concatenate, write_arrays
from zest_rl.runtime.gl import select_gl_backend
from zest_rl.runtime.parallel import chunks, one_thread
from zest_rl.sources.kitchen import kitchen_source

REQUIRED_RATIO = 180.0
REQUIRED_RESCORING_S = 0.5
N_PLAIN_FRAMES = 5
N_ROUNDS = 3
N_RELABELED, N_RESCORED = 4, 60
DATASET = "zest/kitchen-micro-benchmark-v0"
VIEWS = Views("micro", n_views=8)
CONFIG = ScorerConfig("same-scene")
OTHERS = {
    "goal": replace(CONFIG, goal="drawings"),
    "features": replace(CONFIG, features="raw"),
    "similarity": replace(CONFIG, similarity="l2"),
}


def cpu_seconds() -> float:
    """Return the processor time of this process and of its children that have ended."""
    return sum(os.times()[:4])


def plain_ms() -> float:
    """Return cpu-ms per frame of the plain loop."""
    # not at the top: the process in which a dataset is written imports this file
    import gymnasium
    import gymnasium_robotics
    import torch
    from PIL import Image
    from timm.data.transforms_factory import create_transform

    from zest_rl.embedders.checkpoints import LITE0_PREPROCESSING, installed_weights
    from zest_rl.embedders.networks import build_lite0

    select_gl_backend()
    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make("FrankaKitchen-v1", render_mode="rgb_array", width=224, height=224, disable_env_checker=True)
    network, transform = build_lite0(installed_weights()).module, create_transform(**LITE0_PREPROCESSING)

    @torch.inference_mode()
    def embed_frame() -> NDArray[np.float32]:
        frame: Any = env.render()
        return np.asarray(network(transform(Image.fromarray(frame))[None]).numpy())

    env.reset(seed=0)
    embed_frame()  # the first frame pays for the GL context
    seconds = 0.0
    for _ in range(N_PLAIN_FRAMES):
        env.step(env.action_space.sample())
        start = cpu_seconds()
        embed_frame()
        seconds += cpu_seconds() - start
    env.close()
    return 1e3 * seconds / N_PLAIN_FRAMES


def relabel_ms(episodes: dict[str, NDArray[Any]]) -> tuple[float, float]:
    """Return cpu-ms per frame and view, and cpu-ms per *distinct* state and view."""
    write_dataset(
        DATASET,
        recordings(episodes),
        env_spec=env_spec("micro").to_json(),
        ref_min_score=0.0,
        ref_max_score=70.0,
        algorithm_name="scripted expert with uniform action noise",
        description="episodes for a benchmark",
        zest={},
    )
    start = cpu_seconds()
    made = relabel_source(kitchen_source(DATASET, VIEWS), CONFIG, n_workers=1)
    milliseconds = 1e3 * (cpu_seconds() - start) / VIEWS.n_views
    with open_dataset(made.dataset_id) as ds:
        assert np.ptp([rewards.sum() for rewards in ds.rewards()]) > 0
    return milliseconds / made.n_frames, milliseconds / made.n_embedded


def fill_cache(embedded: NDArray[np.float64], states: NDArray[np.float64]) -> int:
    """Give all of `states` (N, 30) the embeddings of those that are `embedded`, in turn; return how many differ."""
    state_embeddings.N_CHECKED = 0  # these are not the embeddings of the states
    cache = StateEmbedder(VIEWS, CONFIG.embedder)
    vectors = cache.embedded(embedded).embeddings[1:]
    distinct = distinct_states(states, VIEWS)
    for path in cache.folder.glob("*.npz"):
        path.unlink()
    for part in chunks(len(distinct), STATES_PER_SHARD):
        keys = distinct[part.start : part.stop]
        path = cache.folder / f"{artifacts.hash_arrays(keys)[:20]}.npz"
        write_arrays(path, {"keys": keys, "embeddings": vectors[np.arange(part.start, part.stop) % len(vectors)]})
    return len(distinct)


def rescoring_seconds(config: ScorerConfig, episodes: list[NDArray[np.float64]]) -> float:
    """Return cpu-s from a new configuration to the scores of all episodes: goal, reading the cache, scoring.

    The best of N_ROUNDS, as the machine may be busy with other things; the goal is embedded in each.
    """
    seconds = []
    for _ in range(N_ROUNDS):
        shutil.rmtree(artifacts.cache_dir() / "goals", ignore_errors=True)
        state_embeddings._read_shard.cache_clear()
        start = cpu_seconds()
        scorer = StateScorer.build(config, VIEWS, episodes[0][0], n_workers=1)
        scores, _ = scorer.scorer.score_episodes(scorer.embeddings(episodes))
        seconds.append(cpu_seconds() - start)
        assert scorer.embedder.n_embedded == 0
        assert all(np.isfinite(score).all() for score in scores)
    return min(seconds)


def run() -> dict[str, object]:
    """Return cpu-ms per frame and view of both loops, cpu-s of scoring again, and whether both requirements are met."""
    behaviour = Behaviour("micro", "expert", noise_max=1.0)
    before = {name: os.environ.get(name) for name in ("MINARI_DATASETS_PATH", "ZEST_CACHE")}
    with tempfile.TemporaryDirectory() as folder, one_thread():
        os.environ.update(MINARI_DATASETS_PATH=str(Path(folder, "minari")), ZEST_CACHE=str(Path(folder, "cache")))
        try:
            plain = plain_ms()
            episodes = concatenate([rollout(behaviour, index) for index in range(N_RESCORED)])
            ours, per_state = relabel_ms({name: array[:N_RELABELED] for name, array in episodes.items()})
            states = list(episodes["qpos"])
            n_distinct = fill_cache(np.concatenate(states[:N_RELABELED]), np.concatenate(states))
            rescoring = {name: rescoring_seconds(config, states) for name, config in OTHERS.items()}
        finally:
            for name, value in before.items():
                os.environ.pop(name) if value is None else os.environ.update({name: value})
    return {
        "plain_cpu_ms_per_frame": round(plain, 1),
        "zest_rl_cpu_ms_per_frame_and_view": round(ours, 2),
        "zest_rl_cpu_ms_per_distinct_state_and_view": round(per_state, 2),
        "ratio": round(plain / ours, 1),
        "ratio_without_sharing_equal_states": round(plain / per_state, 1),
        "required_ratio": REQUIRED_RATIO,
        "rescoring_frames": sum(map(len, states)),
        "rescoring_distinct_states": n_distinct,
        **{f"rescoring_other_{name}_cpu_s": round(seconds, 2) for name, seconds in rescoring.items()},
        "required_rescoring_cpu_s": REQUIRED_RESCORING_S,
        "passed": plain / ours >= REQUIRED_RATIO and max(rescoring.values()) <= REQUIRED_RESCORING_S,
    }
