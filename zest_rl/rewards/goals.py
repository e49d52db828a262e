"""Goal specs: pictures or sentences of the start and the goal state, read and validated.

A spec is one string:

- ``same-scene``: the scene itself, rendered before and after; each camera view gets its own pair;
- ``toys``: toy scenes of the task, made of simple shapes, before and after (`zest_rl.kitchen.toys`);
- ``drawings``: three small drawings of a microwave, an example of a goal that is found out to be wrong;
- a folder with ``init/`` and ``goal/``, each holding one or more pictures;
- ``visual-tasks:real_imgs`` or ``visual-tasks:drawings``: the task's folder in the paper's Visual Tasks Dataset, at the
  path in the environment variable ZEST_VISUAL_TASKS; for other robots ``visual-tasks:real_imgs/open_cabinet``;
- ``text:closed microwave -> open microwave`` (several sentences are separated by ``|``);
- ``text``: the task's own two sentences.
"""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zest_rl.data.images import left_out, list_images, read_image
from zest_rl.errors import BadInput, Notice
from zest_rl.kitchen.tasks import Task, get_task
from zest_rl.kitchen.toys import toy_pictures
from zest_rl.kitchen.views import Views, scene_pair
from zest_rl.runtime import artifacts
from zest_rl.runtime.arrays import read_arrays, write_arrays
from zest_rl.runtime.cache import cache_folder
from zest_rl.runtime.files import is_there, user_path
from zest_rl.types import Frame

SAME_SCENE, TOYS, DRAWINGS, VISUAL_TASKS = "same-scene", "toys", "drawings", "visual-tasks:"
TASK_TEXT, TEXT = "text", "text:"
VISUAL_TASKS_VARIABLE = "ZEST_VISUAL_TASKS"


@dataclass(frozen=True)
class GoalSpec:
    """Start and goal states as pictures or as sentences, one or several of each."""

    name: str
    """The spec as the user wrote it."""
    starts: tuple[Frame, ...] | tuple[str, ...]
    goals: tuple[Frame, ...] | tuple[str, ...]
    per_view: bool = False
    """Each camera view v has its own pair, picture v of both (same-scene goals)."""

    def __post_init__(self) -> None:
        if not self.starts or not self.goals:
            raise BadInput(
                f"goal spec {self.name!r} needs at least 1 start and 1 goal, "
                f"got {len(self.starts)} and {len(self.goals)}"
            )

    @property
    def is_text(self) -> bool:
        """Whether starts and goals are sentences rather than pictures."""
        return isinstance(self.goals[0], str)

    def fingerprint(self) -> str:
        """Hash of the content; `name` does not matter."""
        parts = [
            [item if isinstance(item, str) else artifacts.hash_arrays(item) for item in items]
            for items in (self.starts, self.goals)
        ]
        return artifacts.hash_json([*parts, self.per_view])


def read_folder(folder: Path, name: str | None = None) -> GoalSpec:
    """Read a folder with ``init/`` and ``goal/``; a `Notice` names the files in it that are no images.

    Raises:
        BadInput: a folder is missing or empty, or a picture cannot be read.
    """
    for part in ("init", "goal"):
        if not (folder / part).is_dir():
            problem = "is not a folder"
            if folder.is_dir():
                contents = sorted(p.name for p in folder.iterdir())
                problem = f"has no {part}/, it holds {', '.join(contents[:8]) or 'nothing'}"
            raise BadInput(
                f"a goal folder must hold init/ (pictures of the start) and goal/ (pictures of the goal); {folder} "
                + problem
            )
    starts, goals = (tuple(read_image(p) for p in list_images(folder / part)) for part in ("init", "goal"))
    for part in ("init", "goal"):
        if others := left_out(folder / part):
            warnings.warn(
                f"{folder / part}: left out, as they are no images that are read: {', '.join(others)}; convert "
                "pictures among them, such as HEIC, to JPEG or PNG",
                Notice,
                stacklevel=2,
            )
    return GoalSpec(name or str(folder), starts, goals)


def read_text(spec: str) -> GoalSpec:
    """Parse ``text:START -> GOAL``.

    Raises:
        BadInput: the text does not have two sides.
    """
    sides = [side.strip() for side in spec.removeprefix(TEXT).split("->")]
    if len(sides) != 2 or not all(sides):
        raise BadInput(f"a text goal must look like 'text:closed microwave -> open microwave', got {spec!r}")
    starts, goals = (tuple(s.strip() for s in side.split("|") if s.strip()) for side in sides)
    return GoalSpec(spec, starts, goals)


def goal_folder(spec: str, task: Task) -> Path | None:
    """Return the folder of pictures that a spec names; None for sentences, toys and the scene itself.

    Raises:
        BadInput: there is no such folder, or the spec is of no known kind.
    """
    if spec in (SAME_SCENE, TOYS, TASK_TEXT) or spec.startswith(TEXT):
        return None
    if spec == DRAWINGS:
        return _drawings(task)
    if spec.startswith(VISUAL_TASKS):
        return _visual_tasks(spec) / task.goal_folder
    folder = user_path(spec)
    if not is_there(folder):
        raise BadInput(
            f"unknown goal {spec!r}: it is neither {SAME_SCENE!r}, {TOYS!r}, {DRAWINGS!r}, '{VISUAL_TASKS}real_imgs', "
            "'text', 'text:START -> GOAL', 'episode:3', nor an existing folder with init/ and goal/"
        )
    return folder


def _drawings(task: Task) -> Path:
    folder = artifacts.shipped("datasets") / "goals" / task.name
    if not folder.is_dir():
        drawn = sorted(p.name for p in folder.parent.iterdir() if p.is_dir()) if folder.parent.is_dir() else []
        raise BadInput(
            f"there are no drawings of task {task.name!r} (only of {', '.join(drawn) or 'none'}); "
            "give a folder with init/ and goal/ instead"
        )
    return folder


def _visual_tasks(spec: str) -> Path:
    root = os.environ.get(VISUAL_TASKS_VARIABLE)
    if not root:
        raise BadInput(
            f"goal {spec!r} needs the environment variable {VISUAL_TASKS_VARIABLE}: set it to your copy of the Visual "
            "Tasks Dataset (the folder that holds real_imgs/ and drawings/)"
        )
    return Path(root) / spec.removeprefix(VISUAL_TASKS)


def read_goal(spec: str, task: Task, scene: tuple[NDArray[np.uint8], NDArray[np.uint8]] | None = None) -> GoalSpec:
    """Read a goal spec of any kind.

    Args:
        spec: see the module's docstring.
        task: for specs that depend on the task.
        scene: (V, H, W, 3) start and goal frames of the scene itself, needed for ``same-scene``.

    Raises:
        BadInput: the spec is of no known kind, or cannot be read.
    """
    if spec == SAME_SCENE:
        if scene is None:
            raise BadInput(f"goal {SAME_SCENE!r} needs frames of the scene")
        return GoalSpec(spec, tuple(scene[0]), tuple(scene[1]), per_view=True)
    if spec == TASK_TEXT:
        return GoalSpec(spec, (task.start_text,), (task.goal_text,))
    if spec == TOYS:
        return GoalSpec(spec, *toy_pictures(task))
    folder = goal_folder(spec, task)
    return read_text(spec) if folder is None else read_folder(folder, spec)


def read_kitchen_goal(spec: str, views: Views, scene_qpos: NDArray[np.float64], *, cached: bool = False) -> GoalSpec:
    """Read a goal spec of a kitchen task, and render the scene for a same-scene goal.

    Args:
        spec: see the module's docstring.
        views: of the task.
        scene_qpos: (nq,) a start state of the scene.
        cached: take the pictures from the cache if they are there, else keep them there: a quick answer, to be checked
            before anything is made from it.

    Raises:
        BadInput: as `read_goal`.
    """
    task, scene = get_task(views.task), None
    if spec == SAME_SCENE:
        draw = _cached_scene_pair if cached else _scene_pair
        scene = draw(views, scene_qpos, task)
    return read_goal(spec, task, scene)


def _scene_pair(views: Views, qpos: NDArray[np.float64], task: Task) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    return scene_pair(views.shared_renderer(), qpos, task)


def _cached_scene_pair(
    views: Views, qpos: NDArray[np.float64], task: Task
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the scene pair through the cache: opening GL takes longer than finding finished work."""
    digest = artifacts.hash_json([views.fingerprint(), task.joint, task.goal, artifacts.hash_arrays(qpos)])
    path = cache_folder("goals") / f"scene-{digest[:20]}.npz"
    form = (np.uint8, (views.n_drawn, views.size, views.size, 3))
    if (kept := read_arrays(path, {"starts": form, "goals": form})) is not None:
        return kept["starts"], kept["goals"]
    starts, goals = _scene_pair(views, qpos, task)
    write_arrays(path, {"starts": starts, "goals": goals})
    return starts, goals


def free_goal_folder(spec: str) -> Path | None:
    """Return the folder of pictures that a spec names without a kitchen task; None for sentences.

    Raises:
        BadInput: there is no such folder, or the spec is for kitchen tasks only.
    """
    if spec.startswith(TEXT):
        return None
    if spec.startswith(VISUAL_TASKS):
        return _visual_tasks(spec)
    folder = user_path(spec)
    if spec in (SAME_SCENE, TOYS, DRAWINGS, TASK_TEXT) or not is_there(folder):
        kitchen = f"{SAME_SCENE!r}, {TOYS!r}, {DRAWINGS!r} and 'text' are of zest/Kitchen-v1's tasks alone"
        raise BadInput(
            f"frames from elsewhere need a goal of their own, got {spec!r} ({kitchen}); give --goal a folder with "
            "init/ and goal/ pictures, 'episode:3', or 'text:closed drawer -> open drawer'"
        )
    return folder


def read_free_goal(spec: str) -> GoalSpec:
    """Read a goal spec that needs no kitchen task: a folder, also one of the Visual Tasks Dataset, or two sentences.

    Raises:
        BadInput: as `free_goal_folder`, or it cannot be read.
    """
    folder = free_goal_folder(spec)
    return read_text(spec) if folder is None else read_folder(folder, spec)


def embed_goal(goal: GoalSpec, embedder: Any) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Embed the starts and the goals of a spec.

    Args:
        goal: S starts and K goals.
        embedder: a `zest_rl.embedders.Embedder`.

    Returns:
        (S, D) and (K, D) float32; (V, 1, D) each for a spec that gives each of V views its own pair.

    Raises:
        BadInput: sentences were given to an embedder that reads pictures only.
    """
    embed = embedder.embed_texts if goal.is_text else embedder.embed_images
    starts, goals = embed(goal.starts), embed(goal.goals)
    return (starts[:, None], goals[:, None]) if goal.per_view else (starts, goals)
