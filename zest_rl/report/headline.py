"""The sentence that a comparison opens with, computed from its rows: what learning from rewards gained over cloning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from zest_rl.data.provenance import DatasetRecord
from zest_rl.report.content import MethodRow
from zest_rl.rewards.goals import TASK_TEXT, TEXT


def headline(rows: Sequence[MethodRow], metas: Mapping[str, Mapping[str, Any]], n_datasets: int = 1) -> str:
    """Compare the best method that learned from ZeST rewards with behaviour cloning, and say so where it is no better.

    Where one of the two or the dataset is missing, tell what the best method reaches.

    Args:
        rows: of the results.
        metas: ``meta.json`` of a run, by the name of its method.
        n_datasets: over which the results are.
    """
    contenders = [row for row in rows if row.kind == "method"]
    if not all(row.is_normalized for row in rows):
        return _best_return(contenders)
    data = next((row for row in rows if row.kind == "dataset"), None)
    clone = next((row for row in contenders if _clones_all(metas[row.method])), None)
    givers = {row.method: _giver(metas[row.method]) for row in contenders}
    best = max((row for row in contenders if givers[row.method]), key=lambda row: row.mean, default=None)
    if data is None or clone is None or best is None:
        return _best_sentence(contenders, n_datasets)
    where = f" of {n_datasets} datasets" if n_datasets > 1 else ""
    episodes = f"{data.n_episodes} episodes{where}, which themselves reach {data.mean:.0f} % of the expert"
    trained = f"Trained on the same {episodes}, behaviour cloning reaches {clone.mean:.0f} %"
    intervals = f"(95 % intervals {_interval(clone)} and {_interval(best)})"
    rewards = f"learned from {givers[best.method]}'s rewards"
    if best.mean <= clone.mean:
        return (
            f"{trained}, and no method that {rewards} is above it: {best.method} reaches {best.mean:.0f} % {intervals}."
        )
    doubt = "" if best.ci_low > clone.ci_high else "; as these overlap, the difference may be chance"
    return f"{trained} and {best.method}, which {rewards}, {best.mean:.0f} % {intervals}{doubt}."


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
