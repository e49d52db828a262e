"""Robot datasets of any kind → episodes and frames. One file per kind of input; `open_source` recognises the kind.

| input | episodes | frames |
|---|---|---|
| Minari dataset of zest/Kitchen-v1 | copied | its states, rendered from a ring of views (`kitchen`) |
| Minari dataset with pictures among its observations | copied | those (`pictures`) |
| Minari dataset with recorded MuJoCo states | copied | what is moved, without the robot, from a ring (`scenes`) |
| the same with `--camera NAME` or `default` | copied | rendered with everything in it (`states`) |
| any of these with `--frames FOLDER …` | | videos or pictures in a folder (`videos`) |
| any with `--masks FOLDER …` | | with masked pixels filled from other frames (`masked`) |
| robomimic's HDF5 | imported (`robomimic`) | its pictures |
| LeRobot v3 folder | imported (`lerobot`) | its videos, or pictures (`parquet_pictures`) |
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path

from zest_rl.data import reader
from zest_rl.data.observations import choose_pictures, joined, rejected
from zest_rl.data.writer import DatasetCopy, Trajectories
from zest_rl.errors import BadInput
from zest_rl.kitchen.views import Views
from zest_rl.runtime.files import is_there, user_path
from zest_rl.simulation.makers import named_by_user
from zest_rl.simulation.scene import SceneConfig
from zest_rl.sources.base import EpisodeFrames, Source
from zest_rl.sources.kitchen import KitchenStates, read_kitchen
from zest_rl.sources.masked import without_masked
from zest_rl.sources.pictures import Pictures, picture_entries
from zest_rl.sources.videos import find_videos

__all__ = ["EpisodeFrames", "KitchenStates", "Source", "open_source"]


OWN_CAMERA = ("default",)
"""The cameras that stand for the environment's own one."""


def _is_path(dataset: str) -> bool:
    path, is_id = user_path(dataset), reader.DATASET_ID.fullmatch(dataset)
    if not (is_there(path) or is_id) and (path.suffix or dataset.startswith(("/", ".", "~"))):
        raise BadInput(
            f"there is no file or folder {dataset}; give a robomimic HDF5 file, a LeRobot folder or a Minari id"
        )
    return is_there(path) and not (is_id and reader.exists(dataset))


def open_source(
    dataset: str,
    *,
    frames: Sequence[str] = (),
    cameras: Sequence[str] = (),
    env: str | None = None,
    robot: Sequence[str] = (),
    look_at: str | None = None,
    n_views: int = Views.n_views,
    show_robot: bool = Views.robot,
    tolerance: float = Views.tolerance,
    skip_incomplete: bool = False,
    masks: Sequence[str] = (),
) -> Source:
    """Find a dataset's episodes and their frames.

    Args:
        dataset: a Minari id, or the path of a robomimic file or a LeRobot folder.
        frames: entries with pictures, or folders with videos, one per view; empty: the only pictures, else the
            recorded states.
        cameras: of the environment's model, one per view, to render the recorded states from, with the robot in view;
            or ``default``, the environment's own. Empty: a ring of views round what is moved.
        env: ``package.module:make``, a function that makes the environment of recorded states; None: the dataset's.
        robot: scenes only: bodies that are hidden; empty: what is driven.
        look_at: scenes only: body in the middle of the views; None: the one that moves most.
        n_views: scenes and kitchen only: cameras around the object.
        show_robot: scenes and kitchen only: keep the robot in view.
        tolerance: scenes and kitchen only: grid of the states.
        skip_incomplete: LeRobot only: leave out episodes without steps, and those whose files are missing.
        masks: folders with masks of what hides the scene, one per view of frames that show a robot (`masked`).

    Raises:
        BadInput: no such dataset, or its frames are missing or ambiguous; the message lists the candidates.
    """
    with nullcontext() if _is_path(dataset) else reader.open_dataset(dataset) as ds:
        of_states = {"--env": env is not None}
        of_scenes = {"--robot": bool(robot), "--look-at": look_at is not None}
        of_frames = {"--masks": bool(masks)}
        rendering = {
            **of_scenes,
            "--views": n_views != Views.n_views,
            "--show-robot": show_robot != Views.robot,
            "--tolerance": tolerance != Views.tolerance,
        }
        if ds is not None and ds.record.task is not None and not (frames or cameras):
            _refuse(
                of_states | of_scenes | of_frames,
                "cannot be given for zest/Kitchen-v1, whose robot and objects are known",
            )
            return read_kitchen(ds, Views(ds.record.task, n_views, robot=show_robot, tolerance=tolerance))
        if frames or cameras or ds is None:
            _refuse(rendering, "belong to the ring of views round an object, which needs recorded MuJoCo states alone")
        if frames or ds is None:
            _refuse(
                of_states, "makes the environment of a Minari dataset's recorded states, which are not what is seen"
            )
        if env is not None:
            named_by_user(env)
        if frames and cameras:
            raise BadInput("--camera renders recorded states, --frames says where pictures are; give one of them")
        if skip_incomplete and (ds is not None or not user_path(dataset).is_dir()):
            raise BadInput("--skip-incomplete is for LeRobot folders alone; leave it out")
        folders = [path.resolve() for path in (user_path(name) for name in frames) if is_there(path) and path.is_dir()]
        if folders and len(folders) < len(frames):
            raise BadInput(f"--frames must be folders or entries of the dataset, not both; got {', '.join(frames)}")
        keys = [] if folders else frames
        episode_frames: EpisodeFrames | None
        trajectories: Trajectories
        if ds is None:
            if cameras:
                raise BadInput("--camera renders the states of Minari datasets alone; leave it out")
            trajectories, episode_frames = _open_path(
                user_path(dataset), keys, with_frames=not folders, skip_incomplete=skip_incomplete
            )
        else:
            scene = SceneConfig(tuple(robot), look_at, show_robot, n_views, tolerance)
            episode_frames = None if folders else _minari_frames(ds, keys, cameras, env, scene)
            trajectories = DatasetCopy.of(ds)
        numbers = None if ds is None or ds.record.curate is None else ds.record.curate.episodes
    n_episodes = len(trajectories.n_steps)
    if folders:
        episode_frames = find_videos(folders, n_episodes, dataset, numbers)
    if episode_frames is None:
        raise BadInput(f"{dataset} shows no frames; give --frames FOLDER with a video of each episode")
    if masks:
        if episode_frames.describe()["kind"] == "scene":
            raise BadInput("--masks is for frames that show a robot (--frames, --camera), hidden here; leave it out")
        mask_folders = [user_path(name) for name in masks]
        episode_frames = without_masked(episode_frames, mask_folders, n_episodes, dataset, numbers)
    return Source(trajectories, episode_frames)


def _open_path(
    path: Path, keys: Sequence[str], *, with_frames: bool, skip_incomplete: bool
) -> tuple[Trajectories, EpisodeFrames | None]:
    from zest_rl.sources.lerobot import is_lerobot, open_lerobot
    from zest_rl.sources.robomimic import open_robomimic

    if is_lerobot(path):
        return open_lerobot(path, keys, with_frames=with_frames, skip_incomplete=skip_incomplete)
    if path.is_dir():
        raise BadInput(
            f"{path} is a folder, but no LeRobot dataset (it has no meta/info.json); give a Minari id, a robomimic "
            "HDF5 file or a LeRobot folder"
        )
    return open_robomimic(path, keys, with_frames=with_frames)


def _refuse(flags: Mapping[str, bool], why: str) -> None:
    if given := [flag for flag, is_given in flags.items() if is_given]:
        raise BadInput(f"{' and '.join(given)} {why}; leave {'them' if len(given) > 1 else 'it'} out")


def _minari_frames(
    ds: reader.Dataset, keys: Sequence[str], cameras: Sequence[str], env: str | None, scene: SceneConfig
) -> EpisodeFrames:
    names = list(ds.groups)
    pictures = picture_entries(ds.file, f"{names[0]}/observations")
    rendered = (
        cameras or env or scene != SceneConfig() or not (keys or any(form.channels for form in pictures.values()))
    )
    if rendered:
        from zest_rl.sources.scenes import find_scene
        from zest_rl.sources.states import find_states

        what, env_spec = f"dataset {ds.id}", ds.record.env_spec if env is None else env
        try:
            if cameras:
                return find_states(ds.file, names, env_spec, () if tuple(cameras) == OWN_CAMERA else cameras, what)
            return find_scene(ds.file, names, env_spec, scene, what)
        except BadInput as error:
            raise BadInput(f"{error}{rejected(pictures, 'observations')}") from error
    chosen = choose_pictures(pictures, keys, f"dataset {ds.id}", "observations")
    return Pictures(ds.file, tuple(names), tuple(joined("observations", key) for key in chosen))
