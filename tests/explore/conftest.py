from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from few_states import OPTIONS
from tiny_dataset import COLLECTED

from zest_rl.explore.background import Choice


@pytest.fixture(scope="session")
def embedded(collected_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Minari root and a cache in which the tiny dataset is embedded. Read-only."""
    root = tmp_path_factory.mktemp("embedded")
    shutil.copytree(collected_root, root / "minari")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root / "minari"))
        patch.setenv("ZEST_CACHE", str(root / "cache"))
        Choice(COLLECTED, {**OPTIONS, "n_workers": 1}).find()[1].embed()
    return root
