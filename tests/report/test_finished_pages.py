"""A page is found finished while everything that it was made from, and the page itself, is as it was."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from zest_rl.report.finished import PageRecord, runs_contents


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A page whose command printed ``{"figure": 0.1}``, made from ``[1, "a"]``."""
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "cache"))
    page = tmp_path / "page.html"
    page.write_text("<p>")
    PageRecord(page, [1, "a"]).keep({"figure": 0.1})
    return page


def test_what_its_command_printed_is_found(page: Path) -> None:
    assert PageRecord(page, [1, "a"]).result() == {"figure": 0.1}


def test_other_inputs_make_another_page(page: Path) -> None:
    assert PageRecord(page, [1, "b"]).result() is None


def test_another_version_of_a_package_makes_another_page(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zest_rl.runtime.artifacts.versions", lambda: {"scipy": "0.1"})
    assert PageRecord(page, [1, "a"]).result() is None


def test_a_page_that_was_changed_or_deleted_is_not_found(page: Path) -> None:
    page.write_text("<p>other")
    assert PageRecord(page, [1, "a"]).result() is None
    page.unlink()
    assert PageRecord(page, [1, "a"]).result() is None


@pytest.mark.parametrize("content", ["", "{", "[]", "{}"])
def test_a_damaged_record_is_as_none(page: Path, tmp_path: Path, content: str) -> None:
    (record,) = (tmp_path / "cache" / "pages").iterdir()
    record.write_text(content)
    assert PageRecord(page, [1, "a"]).result() is None


def test_a_cache_that_cannot_be_used_keeps_nothing(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZEST_CACHE", str(page))
    record = PageRecord(page, [1, "a"])
    record.keep({"figure": 0.1})
    assert record.result() is None


def test_a_newer_evaluation_changes_what_runs_hold(trained: Path) -> None:
    run = trained / "bc-0"
    results = [run / "evaluations" / name / "result.json" for name in ("first", "second")]
    for time, path in enumerate(results):
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps({}))
        os.utime(path, (time, time))
    before = runs_contents([run])
    assert runs_contents([run]) == before
    os.utime(results[0], (2, 2))
    assert runs_contents([run]) != before


def test_a_dataset_that_is_changed_changes_what_runs_hold(trained: Path) -> None:
    before = runs_contents([trained / "bc-0"])
    card = next((trained.parent / "minari").rglob("*zest*/README.md"))
    card.write_text("a reader's words")
    assert runs_contents([trained / "bc-0"]) == before
    (card.parent / "data" / "main_data.hdf5").write_bytes(b"")
    assert runs_contents([trained / "bc-0"]) != before
