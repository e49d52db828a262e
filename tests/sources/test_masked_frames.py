"""Frames with a robot in view, and masks of it that are rendered: what is filled in is the scene without the robot."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import gymnasium
import gymnasium_robotics  # noqa: F401  # registers its environments
import numpy as np
import pytest
from PIL import Image
from read_dataset import read
from rollouts import Run

from zest_rl.data.reader import Dataset
from zest_rl.errors import BadInput
from zest_rl.simulation.bodies import robot_bodies
from zest_rl.simulation.recorder import Recorder
from zest_rl.sources import open_source
from zest_rl.sources.stage import stage_of
from zest_rl.sources.states import States

CAMERA = "external_camera_0"


@pytest.fixture
def waving(tmp_path: Path) -> str:
    """An episode of FetchPush in which the arm waves; the block rests."""
    env = Recorder(gymnasium.make("FetchPush-v4"))
    env.reset(seed=0)
    for t in range(12):
        env.step(np.array([0.0, 1.0 if t < 6 else -1.0, 1.0, 0.0], np.float32))
    env.write("push/waving-v0")
    return "push/waving-v0"


def write_masks(folder: Path, states: States, *, side: int = 224, n_left_out: int = 0) -> list[np.ndarray]:
    """Which pixels show the robot, as a segmenter would say."""
    stage = stage_of(states.env_spec, states.cameras)
    model = stage.simulation.model
    robot = np.flatnonzero(robot_bodies(model)[model.geom_bodyid])
    (folder / "episode_0").mkdir(parents=True)
    masks, recorded = [], states.read_states(0)
    for step in range(len(recorded["qpos"]) - n_left_out):
        stage.render({name: values[step] for name, values in recorded.items()}, states.pose)
        masks.append(np.isin(stage._canvas.segments(stage.simulation.data)[0], robot))
        picture = Image.fromarray(255 * masks[-1].astype(np.uint8)).resize((side, side))
        picture.save(folder / "episode_0" / f"{step}.png")
    return masks


def rendered(dataset: str) -> States:
    frames = open_source(dataset, cameras=[CAMERA]).frames
    assert isinstance(frames, States)
    return frames


def test_masked_pixels_show_what_is_behind_the_robot_and_the_metadata_name_the_masks(
    waving: str, tmp_path: Path
) -> None:
    states = rendered(waving)
    masks = write_masks(tmp_path / "masks", states)
    source = open_source(waving, cameras=[CAMERA], masks=[str(tmp_path / "masks")])
    frames = [views[0] for views in source.frames.read(0)]
    seen = np.zeros_like(masks[0])
    stage = stage_of(states.env_spec, states.cameras)
    model = stage.simulation.model
    robot = robot_bodies(model)[model.geom_bodyid]
    shown, model.geom_group[robot] = model.geom_group.copy(), 5
    without = [views[0] for views in states.read(0)]
    model.geom_group[:] = shown
    ever = ~np.all(masks, axis=0)
    assert masks[0].mean() > 0.02, "the robot is in view"
    for frame, mask, scene in zip(frames, masks, without, strict=True):
        seen |= ~mask
        assert (frame[seen & ever] != scene[seen & ever]).mean() < 0.01, "the robot leaves no trace"
    assert source.frames.describe()["masks"] == ["masks"]
    assert source.frames.digest(0) != states.digest(0)


def test_masks_that_do_not_fit_are_refused(
    waving: str, goal: Path, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    words = ["relabel", waving, "--goal", goal, "--n-workers", "1", "--camera", CAMERA, "--masks"]
    code, error = refusal(*words, tmp_path / "none")
    assert (code, "none is not a folder; give one that holds episode_0.mp4" in error) == (2, True)
    write_masks(tmp_path / "small", rendered(waving), side=64)
    code, error = refusal(*words, tmp_path / "small")
    assert (code, "but that of frame 0 is 64×64, the frame 224×224" in error) == (2, True)
    write_masks(tmp_path / "few", rendered(waving), n_left_out=2)
    code, error = refusal(*words, tmp_path / "few")
    assert (code, "episode 0 must have one mask for each frame" in error) == (2, True)
    code, error = refusal(*words, tmp_path / "few", tmp_path / "small")
    assert (code, "--masks needs a folder for each of the 1 views (external_camera_0)" in error) == (2, True)


def test_a_block_at_rest_scores_flat_where_the_arm_is_masked(
    waving: str, goal: Path, zest: Run, tmp_path: Path
) -> None:
    write_masks(tmp_path / "masks", rendered(waving))
    words = ["relabel", waving, "--goal", goal, "--n-workers", "1", "--camera", CAMERA]
    with_robot, without = zest(*words), zest(*words, "--masks", tmp_path / "masks")
    moved, still = (np.ptp(read(result["dataset"], Dataset.scores)[0]) for result in (with_robot, without))
    assert moved > 2 * still


def test_masks_of_labels_and_masks_where_nothing_is_shown_of_the_robot_are_refused(waving: str, tmp_path: Path) -> None:
    masks = write_masks(tmp_path / "labels", rendered(waving))
    for step, mask in enumerate(masks):
        Image.fromarray(mask.astype(np.uint8)).save(tmp_path / "labels" / "episode_0" / f"{step}.png")
    with pytest.raises(BadInput, match="masks must be black and white"):
        list(open_source(waving, cameras=[CAMERA], masks=[str(tmp_path / "labels")]).frames.read(0))
    with pytest.raises(BadInput, match="--masks is for frames that show a robot"):
        open_source(waving, look_at="object0", masks=[str(tmp_path / "labels")])
