"""What is looked at: the frames, scores and pixels of one real episode."""

from __future__ import annotations

import numpy as np
import pytest

from zest_rl.analysis.episode_view import N_FRAMES, Look
from zest_rl.data import reader
from zest_rl.kitchen.views import Views, canonical_states
from zest_rl.rewards.scorer import ScorerConfig
from zest_rl.rewards.scores import Features
from zest_rl.rewards.state_scorer import StateScorer

VIEWS = Views("micro", n_views=2, size=96, tolerance=0.05)


@pytest.mark.parametrize(("goal", "features"), [("same-scene", "delta"), ("drawings", "raw"), ("drawings", "progress")])
def test_an_episode_is_shown_with_its_scores_by_view_and_its_change_in_pixels(
    collected: str, goal: str, features: Features
) -> None:
    states = reader.read_states(collected)[0]
    scorer = StateScorer.build(ScorerConfig(goal, features=features), VIEWS, states[0], n_workers=1)
    look = Look(scorer, states)
    np.testing.assert_allclose(look.scores, scorer.score_episode(states), atol=1e-6)
    assert look.by_view.shape == (2, len(states))
    assert not np.allclose(*look.by_view)
    if features != "progress":
        np.testing.assert_allclose(look.by_view.mean(axis=0), look.scores, atol=1e-5)
    assert len(look.frames) == len(look.steps) == N_FRAMES
    assert (look.steps[0], look.steps[-1]) == (0, len(states) - 1)
    with VIEWS.renderer() as renderer:
        rendered = np.stack([renderer.render(state) for state in canonical_states(states, VIEWS)])
    np.testing.assert_array_equal(look.frames, rendered[look.steps, 1])
    expected = np.abs(rendered.astype(float) - rendered[0]).mean(axis=(1, 2, 3, 4))
    np.testing.assert_allclose(look.pixel_difference, expected, atol=1e-3)
    assert look.pixel_difference[0] == 0
    assert look.pixel_difference[-1] > 1, "the door is open"
