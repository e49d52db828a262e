"""LeRobot's folders, in the layout of their format."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pyarrow
import pyarrow.parquet
from PIL import Image
from rollouts import SIDE, Episode, rows

KEY = "observation.images.top"


def write_lerobot(root: Path, maze: list[Episode], *, version: str = "v3.0", number: int = 0, step: int = 1) -> Path:
    """The layout of https://huggingface.co/docs/lerobot/lerobot-dataset-v3: two episodes in the first files."""
    fps, key = 10, KEY
    rows_of, first = [], 0
    for i, episode in enumerate(maze):
        n_steps = len(episode.actions)
        rows_of.append(
            {
                "observation.state": rows(episode, "observation")[:-1].astype(np.float32).tolist(),
                "action": episode.actions.tolist(),
                "next.reward": (episode.rewards + i).astype(np.float32).tolist(),
                "next.done": (np.arange(n_steps) == n_steps - 1).tolist(),
                "next.truncated": [False] * n_steps,
                "timestamp": (np.arange(n_steps) / fps).astype(np.float32).tolist(),
                "frame_index": list(range(n_steps)),
                "episode_index": [number + step * i] * n_steps,
                "index": list(range(first, first + n_steps)),
                "task_index": [0] * n_steps,
            }
        )
        first += n_steps
    listed = []
    for file, members in enumerate(([0, 1], [2])):
        data_file, video = (f"{at}/chunk-000/file-{file:03d}" for at in ("data", f"videos/{key}"))
        for path in (data_file, video):
            (root / path).parent.mkdir(parents=True, exist_ok=True)
        columns = {name: [value for i in members for value in rows_of[i][name]] for name in rows_of[0]}
        pyarrow.parquet.write_table(pyarrow.table(columns), root / f"{data_file}.parquet")
        frames = [frame for i in members for frame in maze[i].frames[:-1]]
        imageio.mimwrite(root / f"{video}.mp4", frames, fps=fps, codec="libx264", quality=9, macro_block_size=2)
        start = 0.0
        for i in members:
            length = len(maze[i].actions)
            place = {"chunk_index": 0, "file_index": file}
            listed.append(
                {
                    "episode_index": number + step * i,
                    "tasks": ["go there"],
                    "length": length,
                    **{f"data/{name}": value for name, value in place.items()},
                    **{f"videos/{key}/{name}": value for name, value in place.items()},
                    f"videos/{key}/from_timestamp": start,
                    f"videos/{key}/to_timestamp": start + length / fps,
                    "stats/action/mean": [0.0, 0.0],
                }
            )
            start += length / fps
    (root / "meta" / "episodes" / "chunk-000").mkdir(parents=True)
    table = pyarrow.Table.from_pylist(listed)
    pyarrow.parquet.write_table(table, root / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    one = {"dtype": "float32", "names": None}
    features = {
        key: {"dtype": "video", "shape": [SIDE, SIDE, 3], "info": {"video.is_depth_map": False}},
        "observation.state": {**one, "shape": [4]},
        "action": {**one, "shape": [2]},
        "next.reward": {**one, "shape": [1]},
        "next.done": {"dtype": "bool", "shape": [1]},
        "next.truncated": {"dtype": "bool", "shape": [1]},
        "episode_index": {"dtype": "int64", "shape": [1]},
    }
    info = {
        "codebase_version": version,
        "total_episodes": len(maze),
        "fps": fps,
        "features": features,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    }
    (root / "meta" / "info.json").write_text(json.dumps(info))
    return root


def change_info(root: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = root / "meta" / "info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info))


def change_rows(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    rows = pyarrow.parquet.read_table(path).to_pylist()
    for row in rows:
        change(row)
    pyarrow.parquet.write_table(pyarrow.Table.from_pylist(rows), path)


def store_pictures(root: Path, maze: list[Episode]) -> None:
    """Move the frames into the data files, as LeRobot's dtype image has them."""
    shutil.rmtree(root / "videos")
    change_info(root, lambda info: info["features"][KEY].update(dtype="image"))
    for path in sorted(root.glob("data/*/*.parquet")):

        def add(row: dict[str, Any]) -> None:
            buffer = io.BytesIO()
            Image.fromarray(maze[row["episode_index"]].frames[row["frame_index"]]).save(buffer, format="PNG")
            row[KEY] = {"bytes": buffer.getvalue(), "path": f"frame-{row['frame_index']:06d}.png"}

        change_rows(path, add)
