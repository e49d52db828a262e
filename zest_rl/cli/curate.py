"""``zest curate``: a relabeled dataset → which of its episodes to drop, why, and a dataset without them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from zest_rl.cli.ui import Ui

N_SHOWN = 30
"""Dropped episodes that are printed; the table has all."""


@dataclass(frozen=True)
class Config:
    """Rank the episodes of a relabeled dataset by their scores, and write a dataset without the worst ones; the source
    stays as it is. Where success is recorded, it is told how many of the failures are found.
    """

    dataset: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATASET")]
    """A relabeled Minari dataset."""
    keep: float = 0.8
    """Share of the episodes to keep."""
    dry_run: bool = False
    """Rank and judge, write nothing."""
    source: Path | None = None
    """The robomimic file or LeRobot folder that it was relabeled from: also write robomimic's masks, or print LeRobot's
    command that deletes the episodes."""
    output: Path | None = None
    """The table, with a weight per episode; default DATASET.curated.csv here."""


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Rank, judge, write."""
    from zest_rl.analysis.curated import curate

    made = curate(config.dataset, config.keep, source=config.source, output=config.output, dry_run=config.dry_run)
    new, command = made.dataset_id, f"zest curate {config.dataset} --keep {config.keep}"
    if new is not None:
        command = f"zest train bc {new}" if made.suits_agents else f"zest export {new} --to npz"
    return {
        "source": made.source,
        "dataset": new,
        "n_kept": made.n_kept,
        "dropped": made.dropped,
        "quality": made.quality and made.quality.to_json(),
        "table": made.table and str(made.table),
        "masks": made.masks and str(made.masks),
        "command": made.command,
        "episodes": made.rows(),
        "next": command,
    }


def summary(result: Mapping[str, Any]) -> str:
    """The dropped episodes with the reasons, and how good the proposal is."""
    rows = result["episodes"][: len(result["dropped"])]
    lines = [f"{'episode':>8}  {'worth':>6}  why it is dropped"]
    lines += [f"{row['name']:>8}  {row['worth']:6.3f}  {row['words']}" for row in rows[:N_SHOWN]]
    if len(rows) > N_SHOWN:
        lines.append(f"and {len(rows) - N_SHOWN} more")
    lines.append(f"kept: {result['n_kept']} of {len(result['episodes'])} episodes")
    if quality := result["quality"]:
        found, right, chance = (
            100 * share for share in (quality["recall"], quality["precision"]["value"], quality["at_random"])
        )
        auprc = quality["auprc"]
        lines += [
            f"of {quality['bad']} ({quality['n_bad']}), {found:.0f} % are dropped; of the dropped {right:.0f} % are "
            f"such, at random {chance:.0f} %",
            f"AUPRC {auprc['value']:.2f} [{auprc['ci95'][0]:.2f}, {auprc['ci95'][1]:.2f}], "
            f"by length {quality['auprc_by_length']['value']:.2f}, at random {quality['at_random']:.2f}",
        ]
    lines += [f"{name}: {result[name]}" for name in ("dataset", "table", "masks", "command") if result[name]]
    return "\n".join(lines)
