"""The tables of README.md, docs/results.md and eval/README.md, and figures of the site, say what the results say."""

from __future__ import annotations

import json
import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TABLES = runpy.run_path(str(ROOT / "docs" / "tables.py"))
FIGURES = runpy.run_path(str(ROOT / "docs" / "figures.py"))
RESULTS = {
    path.stem: json.loads(path.read_text(encoding="utf-8"))
    for path in sorted((ROOT / "eval" / "results").glob("*.json"))
}
RECIPES = {path.stem: path.read_text(encoding="utf-8") for path in sorted((ROOT / "eval").glob("*.toml"))}
COMPARISONS = [name for name, result in RESULTS.items() if "seeds" in result]


@pytest.mark.parametrize("page", TABLES["PAGES"])
def test_a_page_has_the_tables_that_the_committed_results_make(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    assert text == TABLES["rendered"](text), "run `make tables`"


def test_a_figure_that_was_edited_by_hand_is_written_anew() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    edited = re.sub(r"(\| Demo \| )\d+", r"\g<1>99", text)
    assert edited != text
    assert TABLES["rendered"](edited) == text


def test_every_table_of_the_results_page_is_made_and_every_comparison_has_one() -> None:
    text = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    assert "\n|" not in TABLES["BLOCK"].sub("", text)
    assert {block[2] for block in TABLES["BLOCK"].finditer(text)} == set(COMPARISONS)


@pytest.mark.parametrize("name", sorted(FIGURES["FIGURES"].keys() & RESULTS.keys()))
def test_a_figure_is_drawn_from_committed_results(name: str) -> None:
    picture = (ROOT / "docs" / "images" / f"{name}.svg").read_text(encoding="utf-8")
    assert picture == FIGURES["drawn"](name), "run `make tables`"
    assert len(picture) < 200_000


def test_learning_curves_are_drawn_over_the_level_of_cloning_and_their_time_is_told() -> None:
    curve = {
        "quantity": "return",
        "steps": [1000, 2000],
        "mean": [60.0, 70.0],
        "low": [50.0, 65.0],
        "high": [70.0, 75.0],
    }
    task = {
        "rows": {"TRPO": {"kind": "method", "normalized_return": 80.0}},
        "learning_curves": {"TRPO": curve},
        "train_seconds": {"TRPO": [60.0, 120.0]},
    }
    result = {"tasks": {"micro": task, "sdoor": task}}
    panels = FIGURES["learning_curves"](result).axes
    assert [axes.get_title() for axes in panels] == ["micro", "sdoor"]
    cloned = RESULTS["table1"]["tasks"]["sdoor"]["rows"]["BC"]["normalized_return"]
    assert [[*line.get_ydata()] for line in panels[1].lines] == [[cloned, cloned], [60, 70], [80]]
    assert len(panels[1].collections) == 1, "the range of the seeds"
    text = TABLES["_curves"]("rl", result)
    assert "(images/rl.svg)" in text
    assert "TRPO 1.5 min" in text
    assert TABLES["_curves"]("table1", {"tasks": {"micro": {"rows": {}}}}) == ""


@pytest.mark.parametrize("name", RESULTS)
def test_committed_results_say_by_which_command_and_revision_and_how_long(name: str) -> None:
    result = RESULTS[name]
    assert re.search(rf"zest reproduce (eval/{name}\.toml|{name})\b", result["provenance"]["command"])
    assert result["provenance"]["git_revision"]
    assert TABLES["wall_time"](result), "measured by stage, or noted by hand under `wall_time`"


def test_the_wall_time_is_that_of_the_stages_and_what_was_noted() -> None:
    measured = {"seconds_by_stage": {"collect": 90.0, "train and evaluate": 5400.0}}
    assert TABLES["wall_time"](measured) == "collect 1.5 min, train and evaluate 90.0 min"
    assert TABLES["wall_time"]({**measured, "wall_time": "2 cores"}).endswith("90.0 min, 2 cores")


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_has_committed_results_or_says_what_it_needs_that_cannot_be_had_here(name: str) -> None:
    is_not_run = f"\n{TABLES['NOT_RUN']}needs " in RECIPES[name]
    assert (name in RESULTS) != is_not_run


def test_all_committed_results_are_of_a_recipe() -> None:
    assert set(RESULTS) <= set(RECIPES)


def test_all_cells_of_committed_results_are_of_one_code() -> None:
    for code in (RESULTS[name]["code"] for name in COMPARISONS if "code" in RESULTS[name]):  # earlier ones have none
        assert [made["source_sha256"] for made in code["made_by"]] == [code["source_sha256"]]
        assert code["outdated_cells"] == []
