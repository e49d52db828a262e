"""What is looked at: the frames, scores and pixels of one real episode."""

from __future__ import annotations

import numpy as np
import pytest
from read_dataset import read

from zest_rl.analysis.episode_view import N_FRAMES, KitchenView
from zest_rl.data.reader import Dataset
from zest_rl.kitchen.views import Views, canonical_states
from zest_rl.rewards.scorer import ScorerConfig
from zest_rl.rewards.scores import Features
from zest_rl.rewards.state_scorer import StateScorer

VIEWS = Views("micro", n_views=2, size=96, tolerance=0.05)


@pytest.mark.parametrize(("goal", "features"), [("same-scene", "delta"), ("drawings", "raw"), ("drawings", "progress")])
def test_an_episode_is_shown_with_its_scores_by_view_and_its_change_in_pixels(
    collected: str, goal: str, features: Features
) -> None:
    states = read(collected, Dataset.states)[0]
    scorer = StateScorer.build(ScorerConfig(goal, features=features), VIEWS, states[0], n_workers=1)
    view = KitchenView(scorer, states)
    np.testing.assert_allclose(view.scores, scorer.score_episode(states), atol=1e-6)
    assert view.by_view.shape == (2, len(states))
    assert not np.allclose(*view.by_view)
    if features != "progress":
        np.testing.assert_allclose(view.by_view.mean(axis=0), view.scores, atol=1e-5)
    assert len(view.frames) == len(view.steps) == N_FRAMES
    assert (view.steps[0], view.steps[-1]) == (0, len(states) - 1)
    with VIEWS.renderer() as renderer:
        rendered = np.stack([renderer.render(state) for state in canonical_states(states, VIEWS)])
    np.testing.assert_array_equal(view.frames, rendered[view.steps, 1])
    expected = np.abs(rendered.astype(float) - rendered[0]).mean(axis=(1, 2, 3, 4))
    np.testing.assert_allclose(view.pixel_difference, expected, atol=1e-3)
    assert view.pixel_difference[0] == 0
    assert view.pixel_difference[-1] > 1, "the door is open"
