"""A relabeled dataset → the frames that were scored, as far as the dataset itself holds them; for people to look at."""

from __future__ import annotations

from dataclasses import replace

from zest_rl.data.reader import Dataset
from zest_rl.errors import ZestError
from zest_rl.runtime.records import from_json, reading_record
from zest_rl.simulation.framing import ObjectRing
from zest_rl.simulation.makers import check_named
from zest_rl.simulation.scene import SceneConfig
from zest_rl.sources.base import EpisodeFrames
from zest_rl.sources.pictures import Pictures, picture_entries
from zest_rl.sources.scenes import find_scene
from zest_rl.sources.states import DEFAULT_CAMERA, check_env, find_states


def middle_view(ds: Dataset) -> EpisodeFrames:
    """Return the frames of the middle view alone of a dataset that was not relabeled from kitchen states.

    Raises:
        ZestError: the frames lie outside the dataset, or its environment cannot be made here or is not trusted.
    """
    assert ds.record.relabel is not None
    facts = ds.record.relabel.frames or {}
    kind, names, what = facts.get("kind"), tuple(ds.groups), f"dataset {ds.id}"
    with reading_record(ds.path, "relabel the dataset again"):
        view = facts["views"][len(facts["views"]) // 2]
        if "masks" not in facts and kind == "pictures" and view in picture_entries(ds.file, names[0]):
            return Pictures(ds.file, names, (view,))
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
