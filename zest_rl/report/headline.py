"""The sentence that a comparison opens with: what learning from rewards gains over cloning, from the same starts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from zest_rl.data.provenance import DatasetRecord
from zest_rl.metrics.statistics import Estimate
from zest_rl.report.content import MethodRow
from zest_rl.rewards.goals import TASK_TEXT, TEXT

Gain = Callable[[str, str], Estimate | None]
"""What the second method returns more than the first from the same starts; None if these differ."""


def headline(rows: Sequence[MethodRow], metas: Mapping[str, Mapping[str, Any]], gain: Gain, n_datasets: int = 1) -> str:
    """Compare the method that is asked about with behaviour cloning: the first Decision Transformer on ZeST rewards.

    Where there is none, the first method on such rewards; where cloning or the dataset is missing, too, tell what the
    best method reaches.

    Args:
        rows: of the results.
        metas: ``meta.json`` of a run, by the name of its method.
        gain: see `Gain`.
        n_datasets: over which the results are.
    """
    contenders = [row for row in rows if row.kind == "method"]
    if not all(row.is_normalized for row in rows):
        return _best_return(contenders)
    data = next((row for row in rows if row.kind == "dataset"), None)
    clone = next((row for row in contenders if _clones_all(metas[row.method])), None)
    givers = {row.method: _giver(metas[row.method]) for row in contenders}
    learners = sorted((row for row in contenders if givers[row.method]), key=lambda r: metas[r.method]["agent"] != "dt")
    if data is None or clone is None or not learners:
        return _best_sentence(contenders, n_datasets)
    asked = learners[0]
    where = f" of {n_datasets} datasets" if n_datasets > 1 else ""
    episodes = f"{data.n_episodes} episodes{where}, which themselves reach {data.mean:.0f} % of the expert"
    reached = (
        f"Trained on the same {episodes}, {asked.method}, which learned from {givers[asked.method]}'s rewards, reaches "
        f"{asked.mean:.0f} % and behaviour cloning {clone.mean:.0f} %"
    )
    difference = gain(clone.method, asked.method)
    if difference is None:
        overlap = asked.ci_low <= clone.ci_high and clone.ci_low <= asked.ci_high
        doubt = "; as these overlap, the difference may be chance" if overlap else ""
        return f"{reached}, from other starts (95 % intervals {_interval(asked)} and {_interval(clone)}){doubt}."
    doubt = "; as 0 lies in it, the difference may be chance" if difference.low <= 0 <= difference.high else ""
    low, high = (f"{value:z.1f}".replace("-", "\u2212") for value in (difference.low, difference.high))
    return (
        f"{reached}: {abs(difference.value):.1f} points {'more' if difference.value >= 0 else 'less'} from the same "
        f"starts (95 % interval of the difference {low} to {high}){doubt}."
    )


def _best_return(contenders: Sequence[MethodRow]) -> str:
    best = max(contenders, key=lambda row: row.mean, default=None)
    if best is None:
        return ""
    return (
        f"{best.method} has the highest mean return, {best.mean:.2f} (95 % interval {best.ci_low:.2f} to "
        f"{best.ci_high:.2f}, {best.n_episodes} episodes); the dataset has no reference scores to normalize it by."
    )


def _interval(row: MethodRow) -> str:
    return f"{row.ci_low:.1f} to {row.ci_high:.1f}"


def _clones_all(meta: Mapping[str, Any]) -> bool:
    return bool(meta["agent"] == "bc" and meta["config"]["top_fraction"] == 1.0)


def _giver(meta: Mapping[str, Any]) -> str:
    """Say whose ZeST rewards a run learned from; empty for cloning, no return, the ground truth, shuffled scores."""
    relabel = DatasetRecord.of_run(meta).relabel
    uses_return = meta["agent"] != "bc" and meta.get("config", {}).get("condition_on_return", True)
    if not uses_return or relabel is None or relabel.shuffle is not None:
        return ""
    spec = relabel.scorer.goal
    return "a sentence" if spec == TASK_TEXT or spec.startswith(TEXT) else "a picture"


def _best_sentence(contenders: Sequence[MethodRow], n_datasets: int) -> str:
    best = max(contenders, key=lambda row: row.mean, default=None)
    if best is None:
        return ""
    where = f" over {n_datasets} datasets" if n_datasets > 1 else ""
    return (
        f"{best.method} reaches {best.mean:.1f} % of the expert's return{where} (95 % interval {best.ci_low:.1f} to "
        f"{best.ci_high:.1f}, {best.n_seeds} seed{'s' if best.n_seeds > 1 else ''}, {best.n_episodes} episodes)."
    )
