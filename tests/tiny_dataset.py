"""What `conftest` makes once for all tests: a tiny dataset, and policies that are trained on it."""

from __future__ import annotations

COLLECTED = "zest/kitchen-micro-tiny-v0"
SHORT_HORIZON = 25
"""Steps of an evaluated episode."""


def collect_some(dataset_id: str, task: str, n_episodes: int) -> None:
    """Leave a few noisy episodes of the expert in the Minari root."""
    from zest_rl.data.writer import write_dataset
    from zest_rl.kitchen.behaviour import Behaviour, recordings, rollout
    from zest_rl.kitchen.env import env_spec
    from zest_rl.runtime.arrays import concatenate

    behaviour = Behaviour(task, "expert", noise_max=1.0)
    episodes = concatenate([rollout(behaviour, index) for index in range(n_episodes)])
    write_dataset(
        dataset_id,
        recordings(episodes),
        env_spec=env_spec(task).to_json(),
        ref_min_score=0.0,
        ref_max_score=70.0,
        algorithm_name="scripted expert with uniform action noise",
        description="a few episodes for tests",
        zest={"collect": {"asked": {"task": task}}},
    )
