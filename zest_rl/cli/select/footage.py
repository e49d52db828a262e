"""``zest select footage``: goal and action selection on real video."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import tyro

from zest_rl.cli.config import expand_variables
from zest_rl.cli.ui import Ui
from zest_rl.errors import BadInput
from zest_rl.rewards.scores import Features, Similarity, check_names

if TYPE_CHECKING:
    from zest_rl.analysis.clip_selection import Frames
    from zest_rl.types import FloatArray


@dataclass(frozen=True, kw_only=True)
class FootageArguments:
    """Selection on real video (Cui et al. §5.2): one clip specifies the goal by its first and last frame; do the frames
    of other clips that score highest come from the end of a clip?
    """

    what: ClassVar[str] = "footage"
    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER")]
    """Clips of one action by object, FOLDER/OBJECT/CLIP.mp4 or FOLDER/OBJECT/CLIP/ with pictures, or laid out as
    Something-Something V2. In a recipe, $NAME stands for an environment variable."""
    goals: Path | None = None
    """Folder of other clips, which specify the goals, for instance of rendered objects (the paper's sim2real); default
    FOLDER's own clips in turn."""
    ask: Literal["goals", "actions"] = "goals"
    """goals: is the clip of the goal's object? actions: of any, as all do the same; takes --pool all."""
    template: str = "Opening [something]"
    """With Something-Something V2: the action."""
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

    def __post_init__(self) -> None:
        check_names(self.features, self.similarity)
        if min(self.top, self.n_repeats) < 1 or (self.max_clips is not None and self.max_clips < 3):
            raise BadInput("--top and --n-repeats must be at least 1, and --max-clips at least 3")
        if self.ask == "actions" and (self.pool, self.context) != ("all", "same"):
            raise BadInput("actions are sought among all objects, each clip against its own start; give --pool all")
        for folder in (self.folder, self.goals):
            if folder is not None:
                expand_variables(folder)


def run(config: FootageArguments, ui: Ui) -> dict[str, Any]:
    """Embed all clips, let clip after clip specify the goal, judge the highest scores."""
    import numpy as np

    from zest_rl.analysis import clip_selection
    from zest_rl.embedders import load_embedder

    folder, goal_folder = expand_variables(config.folder), expand_variables(config.goals or config.folder)
    within = goal_folder.resolve() == folder.resolve()
    found = clip_selection.find_clips(folder, config.template)
    goal_clips = found if within else clip_selection.find_clips(goal_folder, config.template)
    specified = {clip.thing for clip in goal_clips}
    things = [thing for thing in clip_selection.enough(found, 3 if within else 2) if thing in specified]
    for thing in dict.fromkeys(clip.thing for clip in (*found, *goal_clips) if clip.thing not in things):
        ui.warn(f"{thing!r} is left out: it needs 2 clips to choose from and 1 other that specifies the goal")
    if not things:
        raise BadInput(f"no object has 2 clips in {folder} to choose from and 1 other in {goal_folder} for the goal")

    def chosen(clips: list[clip_selection.Clip]) -> list[clip_selection.Clip]:
        return [clip for thing in things for clip in [c for c in clips if c.thing == thing][: config.max_clips]]

    clips = chosen(found)
    goal_clips = clips if within else chosen(goal_clips)
    embedder = load_embedder(config.embedder, device=config.device, precision=config.precision)
    with ui.progress("embedding clips", len(clips) if within else len(clips) + len(goal_clips)) as advance:
        embeddings = clip_selection.embed_clips(clips, embedder, config.n_frames, on_done=advance)
        goals = (
            embeddings if within else clip_selection.embed_clips(goal_clips, embedder, config.n_frames, on_done=advance)
        )
    rows: dict[str, dict[str, Any]] = {}
    for thing in things:
        own = [i for i, clip in enumerate(goal_clips) if clip.thing == thing]
        drawn = np.random.default_rng(0).permutation(own)[: config.n_repeats].tolist()
        pools = (
            (
                clip_selection.candidates(
                    clips,
                    embeddings,
                    thing,
                    diverse=config.pool == "all",
                    any_thing=config.ask == "actions",
                    same_context=config.context == "same",
                    left_out=goal if within else None,
                    seed=repeat,
                ),
                goals[goal],
            )
            for repeat, goal in enumerate(drawn)
        )
        judged = _judge(config, pools)
        rows[thing] = {**judged, "n_clips": sum(clip.thing == thing for clip in clips)}
        if rows[thing]["top"] < config.top:
            n = rows[thing]["top"]
            ui.warn(f"{thing!r}: only {n} frames reach the goal, so the highest {n} are judged")
    mean = float(np.mean([row["top_n_success"]["value"] for row in rows.values()]))
    chance = float(np.mean([row["goal_frame_ratio"] for row in rows.values()]))
    paths = {"folder": str(folder), "goals": str(goal_folder)}
    return {
        "select": config.what,
        "settings": {**asdict(config), **paths, "embedder_sha256": embedder.fingerprint},
        "objects": rows,
        "mean": {"top_n_success": mean, "goal_frame_ratio": chance, "times_random": mean / chance},
        "n_clips": len(clips),
        "next": f"zest select footage {shlex.quote(str(folder))} --pool all",
    }


def _judge(config: FootageArguments, pools: Iterable[tuple[Frames, FloatArray]]) -> dict[str, Any]:
    """Score each pool of candidates by the first and last of its goal's (n, D) embeddings; average the measures."""
    import numpy as np

    from zest_rl.metrics import selection
    from zest_rl.metrics.statistics import bootstrap

    tops, variations, ratios, picked = [], [], [], []
    for pool, goal in pools:
        scores = pool.scores(goal[:1], goal[-1:], config.features, config.similarity)
        tops.append(selection.top_up_to(scores, pool.satisfies, config.top))
        variations.append(selection.relative_variation(scores, pool.satisfies))
        ratios.append(selection.goal_frame_ratio(pool.satisfies))
        picked.append(min(config.top, int(pool.satisfies.sum())))
    return {
        "top_n_success": bootstrap([np.array(tops)]).as_json(),
        "relative_variation": bootstrap([np.array(variations)]).as_json(),
        "goal_frame_ratio": float(np.mean(ratios)),
        "top": min(picked),
        "n_goals": len(tops),
    }


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
