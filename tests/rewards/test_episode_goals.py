"""Goals out of a dataset's own episodes, and the picture of what the scorer will see; on the kitchen."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest
from PIL import Image

from zest_rl.cli import main
from zest_rl.data.images import read_image
from zest_rl.errors import BadInput
from zest_rl.rewards.episode_goals import episode_goal, read_source_goal, write_goal
from zest_rl.rewards.preview import write_preview
from zest_rl.simulation.videos import write_mp4
from zest_rl.sources import open_source


def test_a_goal_is_the_first_and_the_last_frame_of_an_episode_in_every_view(collected: str) -> None:
    source = open_source(collected, n_views=1)
    goal = episode_goal(source, 1)
    steps = list(source.frames.read(1))
    np.testing.assert_array_equal(goal.starts, steps[0])
    np.testing.assert_array_equal(goal.goals, steps[-1])
    assert goal.per_view
    assert read_source_goal("episode:1", source).fingerprint() == goal.fingerprint()


@pytest.mark.parametrize("number", ["4", "-1", "one", ""])
def test_an_episode_that_is_not_there_is_refused(collected: str, number: str) -> None:
    with pytest.raises(BadInput, match=rf"needs the number of an episode in 0 … 3, got '{number}'"):
        read_source_goal(f"episode:{number}", open_source(collected, n_views=1))


def test_a_goal_folder_holds_one_pair_of_pictures_per_view_and_nothing_is_overwritten(
    collected: str, tmp_path: Path
) -> None:
    folder, goal = write_goal(collected, 0, tmp_path / "goal", n_views=2)
    assert sorted(str(path.relative_to(folder)) for path in folder.rglob("*.png")) == [
        "goal/0.png", "goal/1.png", "init/0.png", "init/1.png",
    ]  # fmt: skip
    np.testing.assert_array_equal(read_image(folder / "goal" / "1.png"), goal.goals[1])
    with pytest.raises(BadInput, match="goal pictures go to an empty folder"):
        write_goal(collected, 0, folder)


def test_a_goal_out_of_a_video_is_its_first_and_last_frame(tmp_path: Path) -> None:
    frames = [np.full((32, 32, 3), grey, np.uint8) for grey in (20, 100, 200)]
    write_mp4(tmp_path / "film.mp4", frames, fps=10)
    folder, _ = write_goal(str(tmp_path / "film.mp4"), 0, tmp_path / "goal")
    for part, grey in (("init", 20), ("goal", 200)):
        assert abs(int(read_image(folder / part / "0.png").mean()) - grey) < 5
    with pytest.raises(BadInput, match="is a video, which has one episode and one view"):
        write_goal(str(tmp_path / "film.mp4"), 1, tmp_path / "other")


def test_a_preview_shows_all_views_at_both_ends_and_the_goal_beside_them(collected: str, tmp_path: Path) -> None:
    source = open_source(collected, n_views=3)
    goal = read_source_goal("episode:1", source)
    assert write_preview(tmp_path / "preview.png", source, goal) == 0
    with Image.open(tmp_path / "preview.png") as image:
        assert image.size == (4 * 164, 2 * 16 + 3 * 164)
        cells = np.asarray(image)[32:].reshape(3, 164, 4, 164, 3)
    for part in np.moveaxis(cells, 2, 1).reshape(12, 164, 164, 3):
        assert part[:160, :160].std() > 5, "no cell is empty"


def test_the_command_writes_goals_and_previews_before_anything_is_embedded(
    collected: str, zest: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    made = zest("goal", collected, "--episode", "1", "--output", tmp_path / "goal")
    assert made["n_views"] == 8
    shown = zest("relabel", collected, "--goal", tmp_path / "goal", "--preview", tmp_path / "look.png")
    assert imageio.imread(shown["preview"]).ndim == 3
    assert not (tmp_path / "cache" / "embeddings").exists()


def test_a_goal_that_the_episodes_lead_away_from_is_warned_of(
    collected: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    folder, _ = write_goal(collected, 1, tmp_path / "goal")
    words = ["relabel", collected, "--views", "1", "--tolerance", "0.05", "--n-workers", "1", "--goal"]
    assert main([*words, str(folder)]) == 0
    assert "end with a lower score" not in capsys.readouterr().err
    (folder / "init").rename(folder / "was")
    (folder / "goal").rename(folder / "init")
    (folder / "was").rename(folder / "goal")
    assert main([*words, str(folder)]) == 0
    assert "75% of the episodes end with a lower score than they began with" in capsys.readouterr().err
