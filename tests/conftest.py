from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def visual_tasks() -> Path:
    """Folder of the Visual Tasks Dataset, which the project may not redistribute."""
    beside = Path(__file__).resolve().parent.parent.parent / "shared" / "visual_tasks_dataset"
    folder = Path(os.environ.get("ZEST_VISUAL_TASKS") or beside)
    if not folder.is_dir():
        pytest.skip("no Visual Tasks Dataset: set ZEST_VISUAL_TASKS to its folder")
    return folder
