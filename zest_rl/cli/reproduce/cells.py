"""Task × method × training seed: each cell is trained and evaluated once, side by side with others, one core each."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from zest_rl.cli.config import load_config
from zest_rl.cli.reproduce import code
from zest_rl.cli.reproduce.comparison import Comparison, MethodTable, run_config
from zest_rl.cli.ui import Ui
from zest_rl.errors import BadInput

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from zest_rl.evaluation.evaluate import EvaluationConfig

POLL_SECONDS = 2.0
"""Between two looks at the logs of the trainings."""


@dataclass(frozen=True)
class TaskDatasets:
    """The datasets of one task."""

    source: str
    """The collected one."""
    relabeled: Mapping[str, str]
    """Goal → the one relabeled by it."""
    collect_result: Mapping[str, Any] = field(default_factory=dict)
    """What `zest collect` tells of the source."""
    evaluate: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of `zest evaluate` for this task alone."""


@dataclass(frozen=True)
class Cell:
    """One method on one task with one training seed."""

    task: str
    method: str
    run: Path
    agent: str
    """Or ``foreign``."""
    train: Mapping[str, Any]
    """Arguments of `zest train AGENT`, or of `zest adopt`."""
    evaluate: Mapping[str, Any]
    """Arguments of `zest evaluate`."""
    evaluation: EvaluationConfig
    """What these arguments mean."""
    n_counted: int
    """Updates, or steps in the environment, of the training."""

    @property
    def name(self) -> str:
        """Name of the marker that says that it is done."""
        from zest_rl.runtime.artifacts import hash_json

        return f"{self.run.name}-{hash_json({**self.evaluate, 'run': '', 'n_workers': 1})[:8]}"

    @property
    def code_records(self) -> tuple[Path, Path]:
        """Which code trained the policy, which cells may share, and which evaluated it."""
        folder = self.run.parents[1] / "code"
        return folder / f"{self.run.name}.json", folder / f"{self.name}.json"


def make_cells(comparison: Comparison, datasets: Mapping[str, TaskDatasets], output: Path) -> list[Cell]:
    """Return one cell per task, method and seed; the run's folder is named by a hash of its data and all arguments.

    All cells of the first seed come first: of what was cut short, a recipe with fewer seeds finds its cells done.

    Raises:
        BadInput: policies that were trained elsewhere are not there; all of them are named.
    """
    from zest_rl.agents.foreign import identify
    from zest_rl.analysis.curated import curate
    from zest_rl.cli.evaluate import Config as EvaluateFlags
    from zest_rl.cli.evaluate import settings
    from zest_rl.data.reader import open_dataset
    from zest_rl.runtime import artifacts

    described = {}

    def chosen(method: MethodTable, of_task: TaskDatasets) -> str:
        """Return the dataset that a method is trained on, which `described` then holds."""
        dataset = of_task.source if method.goal is None else of_task.relabeled[method.goal]
        if method.keep is not None:
            table = output / "curated" / f"{dataset.split('/')[-1]}-{method.keep}.csv"
            dataset = str(curate(dataset, method.keep, output=table).dataset_id)
        if dataset not in described:
            with open_dataset(dataset) as ds:
                described[dataset] = ds.describe()
        return dataset

    cells, problems = [], []
    triples = product(comparison.tables.seeds, comparison.methods.items(), datasets.items())
    for seed, (name, method), (task, task_datasets) in triples:
        if seed not in method.seeds:
            continue
        goal, agent = method.table.goal, method.table.agent_or_foreign
        dataset = chosen(method.table, task_datasets)
        train = {**method.train, "dataset": dataset, "seed": seed}
        if method.table.policy is not None:
            policy = method.table.policy.replace("{task}", task).replace("{seed}", str(seed))
            train |= {"policy": policy, "name": name}
        arguments = asdict(load_config(run_config(agent), train, name))  # defaults are arguments, too
        if method.table.policy is not None:
            try:
                arguments |= {"policy": identify(arguments["policy"], arguments["python"]).to_json()}
            except BadInput as error:
                problems.append(f"{name!r}, trained on {dataset} with seed {seed}: {error}")
        n_counted = arguments.get("n_updates", arguments.get("n_steps", 0))
        digest = artifacts.hash_json([arguments, agent, described[dataset]])
        run = output / "cells" / f"{task}-{agent}-{goal or 'ground-truth'}-seed{seed}-{digest[:8]}"
        train |= {"run_dir": str(run)}
        how = {**method.evaluate, **task_datasets.evaluate, "run": str(run)}
        cells.append(
            Cell(task, name, run, agent, train, how, settings(load_config(EvaluateFlags, how, name)), n_counted)
        )
    if problems:
        raise BadInput("\n  ".join(["policies from elsewhere are missing; train them, then go on:", *problems]))
    return cells


def run_cells(
    cells: list[Cell], output: Path, ui: Ui, *, n_workers: int | None = None, rerun_outdated: bool = False
) -> int:
    """Train and evaluate all cells that are not done, or that different code made if that is asked; return how many."""
    from zest_rl.runtime.parallel import cached_jobs

    done_folder = output / "done"
    for cell in cells if rerun_outdated else ():
        if cell.run.exists() and code.is_outdated(cell):
            gone = cell.run.with_name(f".{cell.run.name}.outdated")  # at once: half a run might pass for a whole one
            shutil.rmtree(gone, ignore_errors=True)
            cell.run.rename(gone)
            shutil.rmtree(gone)
    open_cells = {cell.name: cell for cell in cells if not _is_done(cell, done_folder)}
    n_counted = {cell.run: cell.n_counted for cell in open_cells.values()}
    with (
        ui.progress("updates of all cells (evaluation follows)", sum(n_counted.values())) as advance,
        _followed(n_counted.keys(), advance),
    ):
        for name in cached_jobs(_train_and_evaluate, open_cells, done_folder, n_workers=n_workers, stage="a cell"):
            ui.say(f"done: {name}")
    return len(open_cells)


def _is_done(cell: Cell, folder: Path) -> bool:
    """Whether a cell's results are there; a marker without them is removed, so that the cell is run again."""
    from zest_rl.evaluation.evaluate import evaluation_folder
    from zest_rl.training.request import snapshots

    marker = folder / f"{cell.name}.npz"
    policies = (cell.run, *snapshots(cell.run))
    results = [evaluation_folder(policy, cell.evaluation) / "result.json" for policy in policies]
    if not all(path.exists() for path in (cell.run / "meta.json", *results)):
        marker.unlink(missing_ok=True)
    return marker.exists()


def _train_and_evaluate(cell: Cell) -> dict[str, NDArray[np.float64]]:
    import numpy as np

    from zest_rl.agents.configs import FOREIGN
    from zest_rl.api import trainer
    from zest_rl.cli.evaluate import Config as EvaluateFlags
    from zest_rl.cli.train import split_config
    from zest_rl.evaluation.evaluate import evaluate, evaluation_folder
    from zest_rl.training.adoption import adopt
    from zest_rl.training.request import snapshots

    training_code, evaluation_code = cell.code_records
    if not (cell.run / "meta.json").exists():
        code.record(training_code, cell.run)
    code.record(evaluation_code, evaluation_folder(cell.run, cell.evaluation))
    flags = load_config(run_config(cell.agent), cell.train, cell.method)
    if cell.agent == FOREIGN:
        adopt(flags.policy, flags.dataset, name=flags.name, seed=flags.seed, python=flags.python, run_dir=flags.run_dir)
    else:
        trainer(cell.agent).train(cell.agent, flags.dataset, *split_config(flags), run_dir=flags.run_dir)
    trained = time.monotonic()
    how = load_config(EvaluateFlags, cell.evaluate, cell.method)
    for run in (cell.run, *snapshots(cell.run)):
        evaluate(run, cell.evaluation, score=how.score, videos=how.videos, device=how.device, n_workers=how.n_workers)
    return {"evaluate_seconds": np.array(time.monotonic() - trained)}


@contextmanager
def _followed(runs: Collection[Path], advance: Callable[[int], object]) -> Iterator[None]:
    """Show the updates that other processes log in `runs`, for as long as the context is open."""
    stop, shown = threading.Event(), 0

    def show() -> None:
        nonlocal shown
        n_done = sum(map(_n_counted, runs))
        if n_done > shown:
            advance(n_done - shown)
            shown = n_done

    def follow() -> None:
        while not stop.wait(POLL_SECONDS):
            show()

    thread = threading.Thread(target=follow, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        show()


def _n_counted(run: Path) -> int:
    try:
        return int((run / "metrics.csv").read_text(encoding="utf-8").splitlines()[-1].partition(",")[0])
    except (OSError, IndexError, ValueError):
        return 0


def seconds_of(cell: Cell, output: Path) -> dict[str, float]:
    """Return how long training and evaluating a finished cell took."""
    from zest_rl.runtime import artifacts
    from zest_rl.runtime.arrays import read_arrays

    meta = artifacts.read_json(cell.run / "meta.json")
    times = {"train_seconds": meta["train_seconds"]} if "train_seconds" in meta else {}
    times |= read_arrays(output / "done" / f"{cell.name}.npz", undigested=True) or {}
    return {name: round(float(value), 3) for name, value in times.items()}
