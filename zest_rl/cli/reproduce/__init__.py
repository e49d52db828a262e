"""``zest reproduce``: a recipe → collected and relabeled datasets, trained and evaluated methods, tables and reports.

What a recipe may hold is drawn in `comparison`, in `study` for what trains nothing, and in `reward_study`; with a key
``verb = "follow …"`` or ``"select …"`` it holds the arguments of that verb. Cells run side by side, one core each; a
finished cell is run again only if that is asked, because different code made it (`code`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro

from zest_rl.cli import follow, inspect, select
from zest_rl.cli.config import load_config, read_recipe, recipe_path
from zest_rl.cli.reproduce import reward_study, study_tables, tables
from zest_rl.cli.reproduce.comparison import read_comparison
from zest_rl.cli.reproduce.pipeline import run_comparison
from zest_rl.cli.reproduce.reward_study import read_reward_study, run_reward_study
from zest_rl.cli.reproduce.study import read_study, run_study
from zest_rl.cli.ui import SilentUi, Ui
from zest_rl.errors import BadInput

VERBS = {
    f"{verb} {what}": (module, config)
    for verb, module in (("follow", follow), ("select", select))
    for what, config in module.CONFIGS.items()
}
"""Verbs that a recipe may be of: their module and arguments."""


@dataclass(frozen=True)
class Config:
    """Reproduce a whole comparison from a recipe; rerun the same command to go on or to find everything done."""

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RECIPE")]
    """A recipe that comes with the package, by its name (demo), or a file (eval/demo.toml)."""
    output: Path | None = None
    """Folder of runs, result.json, table.md and report.html; default runs/RECIPE."""
    n_workers: int | None = None
    """Cells side by side; default one per core."""
    rerun_outdated: bool = False
    """Delete the cells that different code has made, and run them again."""


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Run all stages that are not done yet."""
    started = time.monotonic()
    result = reproduce(
        config.file, config.output, n_workers=config.n_workers, rerun_outdated=config.rerun_outdated, ui=ui
    )
    return {**result, "seconds": round(time.monotonic() - started, 1)}


def reproduce(
    file: Path,
    output: Path | None = None,
    *,
    n_workers: int | None = None,
    rerun_outdated: bool = False,
    ui: Ui | None = None,
) -> dict[str, Any]:
    """Reproduce a comparison, a study or what a verb does from a recipe; what is done already is not done again.

    Args:
        file: the recipe; ``eval/demo.toml`` and its like come with the package, and ``demo`` alone will do.
        output: folder of runs, result.json, table.md and report.html; default runs/RECIPE.
        n_workers: cells side by side, default one per core.
        rerun_outdated: delete the cells of a comparison that different code has made, and run them again.
        ui: told what happens; default nobody.

    Returns:
        What result.json holds, and where the files are.

    Raises:
        BadInput: the recipe is wrong; nothing has run then.
        ZestError: a stage failed; what was finished is kept.
    """
    from zest_rl.runtime import artifacts

    ui = SilentUi() if ui is None else ui
    file = recipe_path(file, "reproduce")
    output = output or Path("runs") / file.stem
    recipe = read_recipe(file)
    if rerun_outdated and "methods" not in recipe:
        raise BadInput(
            f"--rerun-outdated is for recipes that compare methods, got {file}, which trains nothing; leave it out"
        )
    work: Callable[[], dict[str, Any]]
    if recipe.get("verb") in VERBS:
        work = _verb(recipe, f"recipe {file}", output, ui, n_workers)
    elif recipe.get("study") == "trex":
        work = partial(run_reward_study, read_reward_study(file), output, ui, n_workers=n_workers)
    elif "study" in recipe:
        work = partial(run_study, read_study(file), output, ui, n_workers=n_workers)
    else:
        work = partial(
            run_comparison,
            read_comparison(file),
            file.name,
            output,
            ui,
            n_workers=n_workers,
            rerun_outdated=rerun_outdated,
        )
    with artifacts.lock(output):
        return work()


def _verb(
    recipe: dict[str, Any], source: str, output: Path, ui: Ui, n_workers: int | None
) -> Callable[[], dict[str, Any]]:
    """Read the arguments of the verb that the recipe is of; return what runs it."""
    module, config_class = VERBS[recipe.pop("verb")]
    given = {"output": str(output / "report.html"), "n_workers": n_workers}
    flags = {field.name for field in fields(config_class)}
    recipe |= {key: value for key, value in given.items() if key in flags and value is not None}
    return partial(_run_verb, module, load_config(config_class, recipe, source), output, ui)


def _run_verb(module: Any, config: Any, output: Path, ui: Ui) -> dict[str, Any]:
    """Run a verb; write result.json and, where the verb has a page, report.html."""
    from zest_rl.runtime import artifacts

    result = module.run(config, ui)
    kept = {key: value for key, value in result.items() if key not in ("report", "next")}
    artifacts.write_json(output / "result.json", {**kept, "provenance": artifacts.provenance()})
    return {**result, "result": str(output / "result.json")}


def summary(result: Mapping[str, Any]) -> str:
    """The tables as text."""
    if result.get("study") == "trex":
        return reward_study.as_text(result)
    if "study" in result:
        return study_tables.as_text(result)
    for key, verb in (("goals_against_tasks", inspect), ("follow", follow), ("select", select)):
        if key in result:
            return str(verb.summary(result))
    return tables.as_text(result)
