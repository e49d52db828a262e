"""``zest select footage``: goal selection on real video."""

from __future__ import annotations

import os
import shlex
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import tyro

from zest_rl.cli.ui import Ui
from zest_rl.errors import BadInput
from zest_rl.scores import Features, Similarity

FOOTAGE_VARIABLE = "ZEST_FOOTAGE"


@dataclass(frozen=True, kw_only=True)
class FootageArguments:
    """Goal selection on real video (Cui et al. §5.2): one clip specifies the goal by its first and last frame; do the
    frames of other clips that score highest come from the end of a clip of the same object?
    """

    what: ClassVar[str] = "footage"
    folder: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="FOLDER")] = None
    """Clips by object, FOLDER/OBJECT/CLIP.mp4 or FOLDER/OBJECT/CLIP/ with pictures; or Something-Something V2. Default:
    the folder that the environment variable ZEST_FOOTAGE names."""
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
    """Clips per object to use, at least 3; default all."""
    precision: Literal["auto", "fp32", "bf16"] = "auto"
    """Of the embedder."""
    device: str = "auto"
    """auto, cpu, cuda, cuda:1, …"""


def run(config: FootageArguments, ui: Ui) -> dict[str, Any]:
    """Embed all clips, let clip after clip specify the goal, judge the highest scores."""
    import numpy as np

    from zest_rl import footage, selection
    from zest_rl.embedders import load_embedder
    from zest_rl.metrics import bootstrap
    from zest_rl.scores import check_names

    folder = config.folder or _named_folder()
    check_names(config.features, config.similarity)
    if min(config.top, config.n_repeats) < 1 or (config.max_clips is not None and config.max_clips < 3):
        raise BadInput("--top and --n-repeats must be at least 1, and --max-clips at least 3")
    if config.layout == "by-object":
        found = footage.folder_of_clips(folder)
    else:
        found = footage.something_something(folder, template=config.template)
    things = footage.enough(found)
    for thing in dict.fromkeys(clip.thing for clip in found if clip.thing not in things):
        ui.warn(f"{thing!r} is left out: it has fewer than 3 clips, one for the goal and two to choose from")
    if not things:
        raise BadInput(f"no object in {folder} has the 3 clips that a selection takes")
    by_thing = {thing: [clip for clip in found if clip.thing == thing][: config.max_clips] for thing in things}
    clips = [clip for of_thing in by_thing.values() for clip in of_thing]
    embedder = load_embedder(config.embedder, device=config.device, precision=config.precision)
    with ui.progress("embedding clips", len(clips)) as advance:
        embeddings = footage.embed_clips(clips, embedder, config.n_frames, on_done=advance)
    rows: dict[str, dict[str, Any]] = {}
    for thing in things:
        own = [i for i, clip in enumerate(clips) if clip.thing == thing]
        tops, ratios, picked = [], [], []
        for repeat, goal in enumerate(np.random.default_rng(0).permutation(own)[: config.n_repeats].tolist()):
            pool = footage.candidates(
                clips,
                embeddings,
                goal,
                diverse=config.pool == "all",
                same_context=config.context == "same",
                seed=repeat,
            )
            scores = pool.scores(embeddings[goal][:1], embeddings[goal][-1:], config.features, config.similarity)
            tops.append(selection.top_up_to(scores, pool.satisfies, config.top))
            ratios.append(selection.goal_frame_ratio(pool.satisfies))
            picked.append(min(config.top, int(pool.satisfies.sum())))
        rows[thing] = {
            "top_n_success": bootstrap([np.array(tops)]).as_json(),
            "goal_frame_ratio": float(np.mean(ratios)),
            "top": min(picked),
            "n_clips": len(own),
            "n_goals": len(tops),
        }
        if min(picked) < config.top:
            ui.warn(f"{thing!r}: only {min(picked)} frames reach the goal, so the highest {min(picked)} are judged")
    mean = float(np.mean([row["top_n_success"]["value"] for row in rows.values()]))
    chance = float(np.mean([row["goal_frame_ratio"] for row in rows.values()]))
    return {
        "select": config.what,
        "settings": {**asdict(config), "folder": str(folder), "embedder_sha256": embedder.fingerprint},
        "objects": rows,
        "mean": {"top_n_success": mean, "goal_frame_ratio": chance, "times_random": mean / chance},
        "n_clips": len(clips),
        "next": f"zest select footage {shlex.quote(str(folder))} --pool all",
    }


def _named_folder() -> Path:
    """Return the folder that the environment names; refuse when it names none."""
    folder = os.environ.get(FOOTAGE_VARIABLE)
    if not folder:
        raise BadInput(
            f"there is no folder of clips to select from: name it, zest select footage FOLDER, or set the environment "
            f"variable {FOOTAGE_VARIABLE} to it"
        )
    return Path(folder)


def summary(result: dict[str, Any]) -> str:
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
