"""Fixtures of the exports: the tiny dataset with scores."""

from __future__ import annotations

import pytest

from zest_rl.kitchen.views import Views
from zest_rl.rewards.relabel import relabel_source
from zest_rl.rewards.scorer import ScorerConfig
from zest_rl.sources.base import Source
from zest_rl.sources.kitchen import kitchen_source


@pytest.fixture
def source(collected: str) -> Source:
    """The tiny dataset, seen from one view."""
    return kitchen_source(collected, Views("micro", n_views=1, size=96, tolerance=0.05))


@pytest.fixture
def scored(source: Source) -> str:
    """The tiny dataset with same-scene scores."""
    return relabel_source(source, ScorerConfig("same-scene")).dataset_id
