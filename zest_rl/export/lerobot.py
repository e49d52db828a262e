"""LeRobot's dataset folder of format v3.0, without videos, and its side-car of progress per frame.

Frame t of an episode of T actions holds o_t, a_t and, under ``next.``, r_t, o_{t+1}, the ends, the ZeST score and the
ground truth. o_t is stored twice, as ``observation.state`` and ``observation.environment_state``: LeRobot's policies
refuse to train without either a camera or the latter. ``next.done`` marks the last frame of every episode, as in
LeRobot's recordings; ``next.truncated`` those that a time limit ended.

The side-car ``sarm_progress.parquet`` holds the frame weights of LeRobot's reward-aligned behaviour cloning
(``--sample_weighting.type rabc``): ``progress_sparse`` of frame t is the ZeST score of o_t, scaled to [0, 1] over the
dataset.

Layout: lerobot 0.6.1, `datasets/dataset_metadata.py`, `datasets/io_utils.py`, `rewards/sarm/rabc.py`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zest_rl.data.provenance import DatasetRecord
from zest_rl.errors import BadInput, ZestError
from zest_rl.export.transitions import TransitionDataset, Transitions
from zest_rl.kitchen.tasks import TASKS
from zest_rl.runtime import artifacts

if TYPE_CHECKING:
    import pyarrow as pa

FPS = 12
"""Of the kitchen: 12.5 steps per second, as the integer that Gymnasium's ``render_fps`` and LeRobot require."""
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_FILE, DATA_FILE = "meta/episodes/chunk-000/file-000.parquet", "data/chunk-000/file-000.parquet"
TASKS_FILE, PROGRESS_FILE = "meta/tasks.parquet", "sarm_progress.parquet"
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}

Columns = dict[str, NDArray[Any]]
"""Equally long arrays (T,) or (T, dim) by LeRobot's names."""


def write(folder: Path, data: TransitionDataset, fps: int | None = None) -> list[str]:
    """Write a dataset, with the side-car if there are scores; `fps` as in `zest_rl.export.export`.

    Raises:
        BadInput: `fps` is below 1, or actions are whole numbers.
        ZestError: pyarrow is not installed.
    """
    data.check_continuous("LeRobot")
    if fps is None:
        fps = max(1, round(FPS if data.record.fps is None else data.record.fps))
    if fps < 1:
        raise BadInput(f"fps must be at least 1, got {fps}; give the steps per second of the robot")
    flat = data.flat
    lengths = np.bincount(flat["episode"])
    starts = np.cumsum(lengths) - lengths
    columns = _columns(flat, starts, fps)
    rows = [slice(start, start + length) for start, length in zip(starts.tolist(), lengths.tolist(), strict=True)]
    task = _task(data.record)
    for name in (DATA_FILE, EPISODES_FILE):
        (folder / name).parent.mkdir(parents=True)
    _write_parquet(folder / DATA_FILE, _table(columns), rows)
    _write_parquet(folder / EPISODES_FILE, _episodes(columns, rows, task))
    _write_parquet(folder / TASKS_FILE, _tasks(task))
    if data.scores is not None:
        write_progress(folder / PROGRESS_FILE, data)
    artifacts.write_json(folder / "meta/stats.json", {name: _stats(values) for name, values in columns.items()})
    artifacts.write_json(folder / "meta/zest.json", data.about)
    info = {
        "codebase_version": "v3.0",
        "robot_type": None,
        "total_episodes": len(rows),
        "total_frames": len(data),
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{len(rows)}"},
        "data_path": DATA_PATH,
        "video_path": None,
        "features": {
            name: {"dtype": values.dtype.name, "shape": [_width(values)], "names": None}
            for name, values in columns.items()
        },
    }
    artifacts.write_json(folder / "meta/info.json", info)
    return list(columns)


def write_progress(path: Path, data: TransitionDataset) -> list[str]:
    """Write only the side-car: index, episode_index, frame_index, progress_sparse, and the unscaled zest_score.

    Raises:
        ZestError: pyarrow is not installed.
    """
    assert data.scores is not None
    scores = np.concatenate([score[:-1] for score in data.scores])
    low, size = scores.min(), np.ptp(scores)
    lengths = [len(score) - 1 for score in data.scores]
    columns = {
        "index": np.arange(len(scores)),
        "episode_index": np.repeat(np.arange(len(lengths)), lengths),
        "frame_index": np.concatenate([np.arange(length) for length in lengths]),
        "progress_sparse": ((scores - low) / (size or 1)).astype(np.float32),
        "zest_score": scores,
    }
    _write_parquet(path, _table(columns))
    return list(columns)


def _columns(flat: Transitions, starts: NDArray[Any], fps: int) -> Columns:
    index = np.arange(len(flat["rewards"]))
    frame = index - starts[flat["episode"]]
    columns = {
        "observation.state": flat["observations"],
        "observation.environment_state": flat["observations"],
        "action": flat["actions"],
        "next.observation.state": flat["next_observations"],
        "next.reward": flat["rewards"],
        "next.done": flat["terminals"] | flat["timeouts"],
        "next.truncated": flat["timeouts"],
        "timestamp": (frame / fps).astype(np.float32),
        "frame_index": frame,
        "episode_index": flat["episode"],
        "index": index,
        "task_index": np.zeros_like(index),
    }
    extras = {
        "next.zest_score": "zest_score",
        "next.gt_reward": "gt_reward",
        "next.source_reward": "source_reward",
        "next.success": "success",
        "gt_episode_success": "gt_episode_success",
    }
    return columns | {name: flat[key] for name, key in extras.items() if key in flat}


def _task(record: DatasetRecord) -> str:
    """The task in words, for policies that read language."""
    task = TASKS.get(record.env.get("kwargs", {}).get("task"))
    return task.goal_text if task else str(record.env.get("id") or record.id)


def _width(values: NDArray[Any]) -> int:
    return values.shape[1] if values.ndim == 2 else 1


def _stats(values: NDArray[Any]) -> dict[str, list[Any]]:
    """Statistics per dimension, with exact quantiles (LeRobot's own come from histograms)."""
    rows = values.reshape(len(values), -1).astype(np.float64)
    stats = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0)}
    stats |= {name: np.quantile(rows, share, axis=0) for name, share in QUANTILES.items()}
    return {name: list(map(float, numbers)) for name, numbers in stats.items()} | {"count": [len(rows)]}


def _pyarrow() -> Any:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ZestError("LeRobot's files are Parquet, which needs pyarrow; pip install 'zest-rl[lerobot]'") from error
    return pyarrow


def _table(columns: Columns) -> pa.Table:
    """Vectors as lists of fixed size, and vectors of one number as plain numbers, as in LeRobot's files."""
    arrow = _pyarrow()
    arrays = {}
    for name, values in columns.items():
        numbers = arrow.array(values.reshape(-1))
        width = _width(values)
        arrays[name] = numbers if width == 1 else arrow.FixedSizeListArray.from_arrays(numbers, width)
    return arrow.table(arrays)


def _episodes(columns: Columns, rows: list[slice], task: str) -> pa.Table:
    table: dict[str, list[Any]] = {
        "episode_index": list(range(len(rows))),
        "tasks": [[task]] * len(rows),
        "length": [row.stop - row.start for row in rows],
        "dataset_from_index": [row.start for row in rows],
        "dataset_to_index": [row.stop for row in rows],
    }
    for key in ("data/chunk_index", "data/file_index", "meta/episodes/chunk_index", "meta/episodes/file_index"):
        table[key] = [0] * len(rows)
    for name, values in columns.items():
        by_episode = [_stats(values[row]) for row in rows]
        table |= {f"stats/{name}/{key}": [stats[key] for stats in by_episode] for key in by_episode[0]}
    return _pyarrow().table(table)


def _tasks(task: str) -> pa.Table:
    """One row, with metadata that make the task the index in pandas, with which LeRobot reads it."""
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_type, "metadata": None}
        for name, kind, numpy_type in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    pandas = {"index_columns": ["task"], "column_indexes": [], "columns": columns}
    table = _pyarrow().table({"task_index": [0], "task": [task]})
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})


def _write_parquet(path: Path, table: pa.Table, rows: list[slice] | None = None) -> None:
    """Write one row group, or one for each of `rows` so that an episode can be read alone."""
    with _pyarrow().parquet.ParquetWriter(path, table.schema) as writer:
        for row in rows or [slice(0, len(table))]:
            writer.write_table(table.slice(row.start, row.stop - row.start))
