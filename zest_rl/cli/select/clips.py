"""``zest select footage``: does a goal find the clips of real video that reach it?"""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

from zest_rl.cli.config import expand_variables
from zest_rl.cli.select.clip_arguments import ClipArguments
from zest_rl.cli.ui import Ui, progress_in_parts


def run(config: ClipArguments, ui: Ui) -> dict[str, Any]:
    """Embed all clips, let clip after clip specify the goal, judge the highest scores."""
    from zest_rl.analysis.clip_selection import select_clips

    folders = {"folder": expand_variables(config.folder), "goals": expand_variables(config.goals or config.folder)}
    with progress_in_parts(ui, "embedding clips") as on_progress:
        selected = select_clips(**{**vars(config), **folders}, on_progress=on_progress)
    for thing in selected.left_out:
        ui.warn(f"{thing!r} is left out: it needs 2 clips to choose from and 1 other that specifies the goal")
    for thing, judged in selected.objects.items():
        if judged.top < config.top:
            ui.warn(f"{thing!r}: only {judged.top} frames reach the goal, so the highest {judged.top} are judged")
    paths = {name: str(folder) for name, folder in folders.items()}
    return {
        "select": config.what,
        "settings": {**vars(config), **paths, "embedder_sha256": selected.embedder_sha256},
        "objects": {thing: judged.as_json() for thing, judged in selected.objects.items()},
        "mean": selected.mean(),
        "n_clips": selected.n_clips,
        "next": f"zest select footage {shlex.quote(paths['folder'])} --pool all",
    }


def summary(result: Mapping[str, Any]) -> str:
    """One line per object, as text."""
    lines = [f"on {result['n_clips']} clips"]
    for thing, row in result["objects"].items():
        low, high = row["top_n_success"]["ci95"]
        lines.append(
            f"  {thing:<18}Top-{row['top']:<4}{row['top_n_success']['value']:>7.1%}  [{low:.1%}, {high:.1%}]"
            f"   at random {row['goal_frame_ratio']:.1%}"
        )
    mean = result["mean"]
    lines.append(f"  {'mean':<26}{mean['top_n_success']:>7.1%}  {mean['times_random']:.1f} times as good as random")
    return "\n".join(lines)
