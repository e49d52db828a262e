"""A relabeled dataset → the frames that were scored, if it holds them or they are where they were; to look at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from zest_rl.data.reader import Dataset
from zest_rl.errors import BadInput, ZestError
from zest_rl.runtime import artifacts
from zest_rl.runtime.records import from_json, reading_record
from zest_rl.simulation.framing import ObjectRing
from zest_rl.simulation.makers import check_named
from zest_rl.simulation.scene import SceneConfig
from zest_rl.sources.base import EpisodeFrames
from zest_rl.sources.masked import without_masked
from zest_rl.sources.pictures import Pictures, picture_entries
from zest_rl.sources.scenes import find_scene
from zest_rl.sources.states import DEFAULT_CAMERA, check_env, find_states
from zest_rl.sources.videos import find_videos, videos_of


def middle_view(ds: Dataset) -> EpisodeFrames:
    """Return the frames of the middle view alone of a dataset that was not relabeled from kitchen states.

    Raises:
        ZestError: the frames lie outside the dataset and are not what they were; or its environment cannot be made
            here or is not trusted.
    """
    assert ds.record.relabel is not None
    facts = ds.record.relabel.frames or {}
    kind, names, what = facts.get("kind"), tuple(ds.groups), f"dataset {ds.id}"
    with reading_record(ds.path, "relabel the dataset again"):
        view = facts["views"][len(facts["views"]) // 2]
        if "masks" not in facts and kind == "pictures" and view in picture_entries(ds.file, names[0]):
            return Pictures(ds.file, names, (view,))
        if kind == "clips" and "folders" in facts:
            return _in_folders(ds, facts)
        if "masks" in facts or kind not in ("scene", "states"):
            raise ZestError("its frames lie outside the dataset")
        env_spec = ds.record.maker or ds.record.env_spec
        check_named(env_spec or "", what)
        checked = check_env(env_spec, what)
        if kind == "states":
            return find_states(ds.file, names, checked, () if view == DEFAULT_CAMERA else (view,), what)
        ring = from_json(ObjectRing, facts["ring"])
        drawn = [i for i in range(ring.n_views) if i not in ring.dropped]
        rest = tuple(i for i in range(ring.n_views) if i != drawn[len(drawn) // 2])
        robot = tuple(facts["robot"])
        config = SceneConfig(robot, facts["look_at"], not robot, ring.n_views, facts["tolerance"])
        return replace(find_scene(ds.file, names, checked, config, what), ring=replace(ring, dropped=rest))


def _in_folders(ds: Dataset, facts: Mapping[str, Any]) -> EpisodeFrames:
    """Find the frames in the folders that were given to relabel.

    A dataset of somebody else shows no more than its maker has: all files must be those that were scored.
    """
    assert ds.record.relabel is not None
    folders, masks = ([Path(path) for path in facts.get(name, ())] for name in ("folders", "mask_folders"))
    lay, what = f"its frames lay in {', '.join(folder.name for folder in folders + masks)}", f"dataset {ds.id}"
    numbers = None if ds.record.curate is None else ds.record.curate.episodes
    if not all(folder.is_dir() for folder in folders + masks):
        raise ZestError(f"{lay}, which is not there")
    changed = ZestError(f"{lay}, and the files there are not those that were scored")

    def find(views: slice, n_episodes: int, numbers: Sequence[int] | None) -> EpisodeFrames:
        clips = find_videos(folders[views], n_episodes, what, numbers)
        return without_masked(clips, masks[views], n_episodes, what, numbers) if masks else clips

    try:
        n_found = len(ds.groups) if numbers is None else len(videos_of(folders[0]))
        everything = find(slice(None), n_found, None)
        digests = [everything.digest(episode) for episode in range(n_found)]
        of_these = [digests[number] for number in numbers or ()]  # what was scored if it was after they were chosen
        if ds.record.relabel.frames_sha256 not in [artifacts.hash_json(digests), artifacts.hash_json(of_these)]:
            raise changed
        middle = len(folders) // 2
        return find(slice(middle, middle + 1), len(ds.groups), numbers)
    except (BadInput, IndexError) as error:
        raise changed from error
