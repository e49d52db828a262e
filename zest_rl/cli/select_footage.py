"""``zest select footage``: goal selection on real video."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import tyro

from zest_rl.cli.ui import Ui
from zest_rl.scores import Features, Similarity


@dataclass(frozen=True, kw_only=True)
class FootageArguments:
    """Goal selection on real video (Cui et al. §5.2): one clip specifies the goal by its first and last frame; do the
    frames of other clips that score highest come from the end of a clip of the same object?
    """

    what: ClassVar[str] = "footage"
    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER")]
    """Clips by object, FOLDER/OBJECT/CLIP.mp4 or FOLDER/OBJECT/CLIP/ with pictures; or Something-Something V2."""
    layout: Literal["by-object", "something-something"] = "by-object"
    """How FOLDER is laid out."""
    template: str = "Opening [something]"
    """With something-something: the action."""
    pool: Literal["single", "all"] = "single"
    """Candidates of the goal's object alone (narrow), or of all objects (diverse)."""
    context: Literal["same", "different"] = "same"
    """x_0 of a candidate: of its own clip, or of another one."""
    embedder: str = "efficientnet-lite0"
    """As in `zest relabel`."""
    features: Features = "delta"
    """As in `zest relabel`."""
    similarity: Similarity = "cos"
    """As in `zest relabel`."""
    top: int = 25
    """N of the Top-N success rate; fewer where fewer candidates reach the goal."""
    n_frames: int = 24
    """Frames of each clip, evenly spaced."""
    n_repeats: int = 10
    """Clips per object that specify the goal in turn."""
    max_clips: int | None = None
    """Clips per object to use; default all."""
    precision: Literal["auto", "fp32", "bf16"] = "auto"
    """Of the embedder."""
    device: str = "auto"
    """auto, cpu, cuda, cuda:1, …"""


def run(config: FootageArguments, ui: Ui) -> dict[str, Any]:
    """Embed all clips, let clip after clip specify the goal, judge the highest scores."""
    import numpy as np

    from zest_rl import footage, selection
    from zest_rl.embedders import load_embedder
    from zest_rl.errors import BadInput
    from zest_rl.metrics import bootstrap
    from zest_rl.scores import check_names, score_views

    check_names(config.features, config.similarity)
    if min(config.top, config.n_repeats, config.max_clips or 1) < 1:
        raise BadInput("--top, --n-repeats and --max-clips must be at least 1")
    if config.layout == "by-object":
        found = footage.folder_of_clips(config.folder)
    else:
        found = footage.something_something(config.folder, template=config.template)
    things = {thing: [clip for clip in found if clip.thing == thing][: config.max_clips] for thing in _things(found)}
    clips = [clip for of_thing in things.values() for clip in of_thing]
    embedder = load_embedder(config.embedder, device=config.device, precision=config.precision)
    with ui.progress("embedding clips", len(clips)) as advance:
        embeddings = footage.embed_clips(clips, embedder, config.n_frames, on_done=advance)
    rows: dict[str, dict[str, Any]] = {}
    for thing in things:
        own = [i for i, clip in enumerate(clips) if clip.thing == thing]
        tops, ratios = [], []
        for repeat, goal in enumerate(np.random.default_rng(0).permutation(own)[: config.n_repeats]):
            pool = footage.candidates(
                clips, embeddings, int(goal), diverse=config.pool == "all",
                same_context=config.context == "same", seed=repeat,
            )  # fmt: skip
            first, last = embeddings[goal][:1], embeddings[goal][-1:]
            scores = np.empty(len(pool.embeddings))
            for clip in np.unique(pool.clip):  # frames of one clip share x_0
                members = np.flatnonzero(pool.clip == clip)
                frames = np.concatenate([pool.starts[members[:1]], pool.embeddings[members]])[:, None]
                scores[members] = score_views(frames, first, last, config.features, config.similarity)[1:]
            tops.append(selection.top_up_to(scores, pool.satisfies, config.top))
            ratios.append(selection.goal_frame_ratio(pool.satisfies))
        estimate = bootstrap([np.array(tops)])
        rows[thing] = {
            "top_n_success": {"value": estimate.value, "ci95": [estimate.low, estimate.high]},
            "goal_frame_ratio": float(np.mean(ratios)),
            "n_clips": len(own),
            "n_goals": len(tops),
        }
    mean = float(np.mean([row["top_n_success"]["value"] for row in rows.values()]))
    chance = float(np.mean([row["goal_frame_ratio"] for row in rows.values()]))
    return {
        "select": config.what,
        "top": config.top,
        "objects": rows,
        "mean": {"top_n_success": mean, "goal_frame_ratio": chance, "times_random": mean / chance},
        "n_clips": len(clips),
    }


def _things(clips: list[Any]) -> list[str]:
    return list(dict.fromkeys(clip.thing for clip in clips))


def summary(result: dict[str, Any]) -> str:
    """One line per object, as text."""
    lines = [f"Top-{result['top']} success on {result['n_clips']} clips{'':<12}at random"]
    for thing, row in result["objects"].items():
        low, high = row["top_n_success"]["ci95"]
        lines.append(
            f"  {thing:<18}{row['top_n_success']['value']:>7.1%}  [{low:.1%}, {high:.1%}]"
            f"{row['goal_frame_ratio']:>12.1%}"
        )
    mean = result["mean"]
    lines.append(f"  {'mean':<18}{mean['top_n_success']:>7.1%}  {mean['times_random']:.1f} times as good as random")
    return "\n".join(lines)
