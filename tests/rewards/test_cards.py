"""What the cards of datasets and policies say; tests/rewards/test_relabel.py has one that was written."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from zest_rl.data.provenance import RelabelRecord, ScorerRecord
from zest_rl.rewards.cards import dataset_card, licence, policy_card

PAGE = Path(__file__).parents[2] / "docs" / "embedders.md"
RECORD = RelabelRecord(
    source="a/b-v0",
    source_sha256="1" * 64,
    reward="level",
    scorer=ScorerRecord("/home/me/doors", "moco:/home/me/r.pth", "delta", "cos", "2" * 64, "3" * 64),
    n_still_frames=2,
    frames={"views": ["top", "side"]},
    frames_sha256="4" * 64,
)
SCORES = [np.array([0, 0.1, 0.2, 0.3], np.float32), np.array([0, 0.3, 0.2, 0.1], np.float32)]


def test_licences_are_those_of_the_table_of_embedders() -> None:
    rows = [line.split("|") for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
    told = {row[1].split("`")[1]: row[6].strip() for row in rows}
    assert {uri: licence(uri) for uri in told} == {
        uri: "see who published them" if name in ("", "the model's") else name for uri, name in told.items()
    }


def test_a_dataset_card_says_goal_embedder_licence_and_how_scores_go_with_time_and_names_no_folder() -> None:
    card = dataset_card("a/b-zest-1a2b3c4d-v0", RECORD, SCORES)
    assert "| episodes, steps | 2, 6 |" in card
    assert f"| goal | `…/doors`, sha256 `{'2' * 64}` |" in card
    assert "| licence of its weights | CC BY-NC 4.0 |" in card
    assert "| value-order correlation | 0.60 (" in card
    assert "| unchanged frames | 2 of 8 |" in card
    assert "/home" not in card


def test_the_card_of_a_null_control_says_so() -> None:
    record = RelabelRecord("a/b-v0", "1" * 64, "level", RECORD.scorer, shuffle=0, frames={"views": ["top"]})
    assert "A null control" in dataset_card("a/b-zest-1a2b3c4d-v0", record, SCORES)


def test_a_policy_card_says_what_it_was_trained_on_and_by_which_goal() -> None:
    dataset = {"id": "a/b-zest-1a2b3c4d-v0", "zest": {"relabel": RECORD.to_json()}}
    meta = {
        "agent": "rvs", "n_params": 561161, "n_updates": 1500, "seed": 0, "data_sha256": "5" * 64, "dataset": dataset,
        "model_sha256": "6" * 64, "obs_dim": 59, "act_dim": 9,
    }  # fmt: skip
    card = policy_card(meta)
    assert card.startswith("# rvs on a/b-zest-1a2b3c4d-v0\n")
    assert "| algorithm | rvs, 561161 parameters |" in card
    assert "| goal | `…/doors`, sha256" in card
    assert "/home" not in card
    on_truth = policy_card({**meta, "dataset": {"id": "a/b-v0"}})
    assert "| rewards | the dataset's own |" in on_truth
