"""Robot datasets of any kind → episodes and frames. One kind of input is one file here; `open_source` tells them apart.

| input | frames |
|---|---|
| Minari dataset with pictures among its observations | those (`pictures`) |
| Minari dataset with recorded MuJoCo states, or `--camera NAME` | rendered from the environment's model (`states`) |
"""

from __future__ import annotations

from collections.abc import Sequence

from zest_rl import data
from zest_rl.data_writer import Copied
from zest_rl.errors import BadInput
from zest_rl.observations import choose_pictures
from zest_rl.sources.base import Frames, Source
from zest_rl.sources.pictures import Pictures, picture_entries
from zest_rl.sources.states import find_states

__all__ = ["Frames", "Source", "is_kitchen", "open_source"]


def is_kitchen(dataset: str) -> bool:
    """Whether a dataset is of zest/Kitchen-v1, whose frames `zest_rl.relabel` renders."""
    return data.kitchen_task(dataset) is not None


def open_source(dataset: str, *, frames: Sequence[str] = (), cameras: Sequence[str] = ()) -> Source:
    """Find a dataset's episodes and their frames.

    Args:
        dataset: a Minari id.
        frames: entries of the observations, one per view; empty: the only pictures there are, else the states.
        cameras: of the environment's model, one per view, to render the recorded states from.

    Raises:
        BadInput: no such dataset, or its frames cannot be found or told apart; the message says what there is.
    """
    if frames and cameras:
        raise BadInput("--camera renders recorded states, --frames says where pictures are; give one of them")
    names = data.episode_names(dataset)
    file = data.dataset_path(dataset) / data.DATA_FILE
    found = picture_entries(file, f"{names[0]}/observations")
    if cameras or not (frames or any(found.values())):
        env_spec = data.read_metadata(dataset).get("env_spec")
        return Source(Copied(dataset), find_states(file, names, env_spec, cameras, f"dataset {dataset}"))
    keys = choose_pictures(found, frames, f"dataset {dataset}", "observations")
    views = tuple("/".join(part for part in ("observations", key) if part) for key in keys)
    return Source(Copied(dataset), Pictures(file, tuple(names), views))
