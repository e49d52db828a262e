"""The README is short, everything that a page links to exists, and what CONTRIBUTING.md shows fits the code."""

from __future__ import annotations

import re
import runpy
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted({*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("*/README.md")})
README = (ROOT / "README.md").read_text(encoding="utf-8")
CODE = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\(([^)\s]+)\)")


def links(text: str) -> list[str]:
    return [link for link in LINK.findall(CODE.sub("", text)) if "://" not in link]


def anchors(text: str) -> list[str]:
    """The names that GitHub gives to headings."""
    headings = re.findall(r"^#+ (.+)$", CODE.sub("", text), re.MULTILINE)
    return [re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_files_and_headings_that_a_page_links_to_exist(page: Path) -> None:
    for link in links(page.read_text(encoding="utf-8")):
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target.read_text(encoding="utf-8")), link


def test_the_site_leads_to_every_page_of_the_docs() -> None:
    listed = set(re.findall(r": (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE))
    assert {page.name for page in PAGES if page.parent.name == "docs"} <= listed


def test_the_algorithm_embedder_and_source_of_the_contributing_page_fit_the_code(tmp_path: Path) -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    shutil.copytree(ROOT / "zest_rl", tmp_path / "zest_rl")
    (copied,) = re.findall(r"^```sh\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    subprocess.run(copied, shell=True, cwd=tmp_path, check=True)
    diffs = re.findall(r"^```diff\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    assert len(diffs) == 3
    for diff in diffs:
        done = subprocess.run(["git", "apply"], cwd=tmp_path, input=diff, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    for path in tmp_path.rglob("*.py"):
        compile(path.read_text(encoding="utf-8"), path, "exec")


def test_the_readme_has_120_lines_and_80_words_before_the_first_command() -> None:
    assert len(README.splitlines()) <= 120
    words = re.findall(r"\w+", re.sub(r"!\[.*?\]\(.*?\)", "", README.partition("```")[0]))
    assert len(words) <= 80


def test_the_picture_of_the_tasks_is_what_its_script_makes(tmp_path: Path) -> None:
    runpy.run_path(str(ROOT / "docs" / "task_sheet.py"))["main"](tmp_path / "tasks.webp")
    with Image.open(tmp_path / "tasks.webp") as made, Image.open(ROOT / "docs" / "images" / "tasks.webp") as kept:
        assert made.size == kept.size
        differences = np.abs(np.asarray(made.convert("RGB"), int) - np.asarray(kept.convert("RGB"), int))
    assert differences.mean() < 2, "drivers of GL draw edges differently"
