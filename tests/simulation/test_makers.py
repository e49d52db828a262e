"""Functions that make environments: what of their code is hashed, without running any."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from zest_rl.simulation.makers import source_sha256

FILES = {
    "alone": "import numpy, beside\ntry:\n    from . import nowhere\nexcept ImportError:\n    pass",
    "beside": "def late():\n    from folder.deep import thing",
    "folder/deep": "",
    "other": "import beside",
    "lab/__init__": "",
    "lab/envs/__init__": "from ..assets import door",
    "lab/envs/push": "import beside\nfrom . import base",
    "lab/envs/base": "",
    "lab/assets": "",
    "lab/other": "",
}
CODE = {
    "alone:make": {"alone", "beside", "folder/deep"},
    "lab.envs.push:make": {"lab/__init__", "lab/envs/__init__", "lab/envs/push", "lab/envs/base", "lab/assets"},
    "folder.deep:make": {"folder/deep"},
}
"""Function → the files in which a change is one of its code."""


@pytest.mark.parametrize("maker", CODE)
def test_the_code_of_a_function_is_its_module_and_what_that_imports_from_its_own_package_or_folder(
    maker: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / f"{name}.py").write_text(f"{text}\nraise SystemExit('this was run')\n")
    importlib.invalidate_caches()
    before, noticed = source_sha256(maker), set()
    for name in FILES:
        file = tmp_path / f"{name}.py"
        text = file.read_text()
        file.write_text(f"{text}# changed")
        if source_sha256(maker) != before:
            noticed.add(name)
        file.write_text(text)
    assert noticed == CODE[maker]
