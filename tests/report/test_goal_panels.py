"""The goal of a relabeled dataset as the report shows it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from zest_rl.data.provenance import RelabelRecord, ScorerRecord
from zest_rl.errors import BadInput
from zest_rl.report.goals import goal_panel


def record(goal: str) -> RelabelRecord:
    scorer = ScorerRecord(goal, "efficientnet-lite0", "delta", "cos", "0" * 64, "0" * 64)
    return RelabelRecord("a/b-v0", "0" * 64, "level", scorer, frames={"views": ["top"]})


def test_a_dataset_cannot_name_a_folder_whose_pictures_the_report_shows(tmp_path: Path) -> None:
    for part in ("init", "goal"):
        (tmp_path / "private" / part).mkdir(parents=True)
        Image.new("RGB", (8, 8)).save(tmp_path / "private" / part / "a.png")
    panel = goal_panel("it", record(str(tmp_path / "private")), tmp_path / "data")
    assert panel.start == panel.goal == ("pictures that did not come with the dataset",)


def test_sentences_are_shown_as_far_as_they_were_used(tmp_path: Path) -> None:
    made = record("text:closed | shut -> open | ajar")
    assert goal_panel("it", made, tmp_path).goal == ("open", "ajar")
    assert goal_panel("it", replace(made, kept_goals=(1,)), tmp_path).goal == ("ajar",)
    with pytest.raises(BadInput, match=r"kept_goals .* must be of the 2 goals"):
        goal_panel("it", replace(made, kept_goals=(7,)), tmp_path)
