"""docs/your_own_robot.md, followed by somebody who types what stands there, from an empty folder."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

PAGE = Path(__file__).resolve().parents[1] / "docs" / "your_own_robot.md"
FILE = re.compile(r"in `(\w+\.py)`.*?^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
COMMANDS = re.compile(r"^```sh\n(.*?)^```", re.DOTALL | re.MULTILINE)


@pytest.mark.slow
def test_the_tutorial_leads_from_an_empty_folder_to_a_report(tmp_path: Path) -> None:
    text = PAGE.read_text(encoding="utf-8")
    files = dict(FILE.findall(text))
    assert files.keys() == {"my_robot.py", "record.py"}
    for name, code in files.items():
        (tmp_path / name).write_text(code, encoding="utf-8")
    root = tmp_path / "minari"
    places = {"MINARI_DATASETS_PATH": str(root), "ZEST_CACHE": str(tmp_path / "cache"), "OMP_NUM_THREADS": "1"}
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    commands = [line for block in COMMANDS.findall(text) for line in block.splitlines()]
    assert [line.split()[1] for line in commands if line.startswith("zest ")] == [
        "goal", "relabel", "relabel", "inspect", "train", "train", "evaluate", "evaluate", "report",
    ]  # fmt: skip
    for command in commands:
        scored = next((folder.name for folder in root.glob("my/push-zest-*-v0")), "")
        typed = command.replace("my/push-zest-…-v0", f"my/{scored}")
        done = subprocess.run(
            typed, shell=True, cwd=tmp_path, env=os.environ | places | {"PATH": path}, capture_output=True, text=True
        )
        assert done.returncode == 0, f"{typed}: {done.stderr[-2000:]}"
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count("<video") == 9, "three of each policy, and three pairs"
    assert "RVS on goal" in page
