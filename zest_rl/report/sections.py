"""The sections of a report: what each kind is headed, what a reader must know to read it, which template draws it.

A new kind of section is an entry here and a file in ``templates/``, which finds the section as ``section``.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from zest_rl.analysis.verdict import Verdict
from zest_rl.report.content import (
    EpisodePanel,
    Film,
    GoalPanel,
    MethodRow,
    QualityTable,
    Scatter,
    ScoreMatrix,
    Series,
    Strip,
    TaskTable,
)

Item = TypeVar("Item")


@dataclass(frozen=True)
class SectionKind(Generic[Item]):
    """A kind of section; called with items, it makes a section of them."""

    heading: str
    template: str
    """File in ``templates/``."""
    intro: str = ""
    x_name: str = "Step"
    """What the x axis of curves is called."""
    first_alone: bool = False
    """Whether all but the first curve of a chart are faint and alike."""

    @property
    def anchor(self) -> str:
        """Name to which links of the page point."""
        return self.heading.lower().replace(" ", "-")

    def __call__(self, items: Iterable[Item]) -> Section[Item]:
        """Return the section that shows `items`."""
        return Section(self, tuple(items))


@dataclass(frozen=True)
class Section(Generic[Item]):
    """A heading, an introduction, and what the template draws below them; without items it is not shown."""

    kind: SectionKind[Item]
    items: tuple[Item, ...]


@dataclass(frozen=True)
class Report:
    """Everything one HTML file shows."""

    title: str
    summary: str
    """One sentence below the title; may be empty."""
    sections: tuple[Section[Any], ...] = ()
    """In the order in which they are shown."""

    def items(self, kind: SectionKind[Item]) -> tuple[Item, ...]:
        """Return what the section of this kind shows; nothing where the report has none."""
        return tuple(item for section in self.sections if section.kind == kind for item in section.items)


RESULTS = SectionKind[MethodRow](
    "Results",
    "results.html",
    "Lines are 95 % bootstrap intervals.",
)
TASK_TABLES = SectionKind[TaskTable](
    "Tasks",
    "tasks.html",
    "Each task on its own; its page has the goals, the episodes' videos and all settings.",
)
CAVEATS = SectionKind[str]("Caveats", "sentences.html")
VERDICT = SectionKind[tuple[str, Verdict]]("Verdict", "verdicts.html")
"""A dataset and what to do with it."""
WARNINGS = SectionKind[str]("Warnings", "sentences.html", "What speaks against training on these rewards.")
REWARD_QUALITY = SectionKind[QualityTable](
    "Reward quality",
    "quality.html",
    "Small figures are 95 % bootstrap intervals over episodes. Ground truth judges a reward, it makes none.",
)
TASKS_AGAINST_GOALS = SectionKind[ScoreMatrix](
    "Tasks against goals",
    "matrix.html",
    "Mean score of where episodes end; a goal should score those of its own task highest (bold: highest).",
)
GOALS = SectionKind[GoalPanel](
    "Goals",
    "goals.html",
    "What the reward was given: the state at the start and the state wanted. ρ is the Spearman correlation.",
)
RANKING = SectionKind[Scatter](
    "Ranking",
    "scatters.html",
    "One dot is one episode. A reward worth training on ranks episodes as ground truth does.",
)
FRAMES = SectionKind[Strip](
    "Frames",
    "frames.html",
    "Frames of one episode; below, their score between the lowest (0) and the highest (1).",
)
VIEWS = SectionKind[Series](
    "Views",
    "curves.html",
    "The same episode by all views together, which is the reward, and by each view alone.",
    first_alone=True,
)
PIXELS = SectionKind[Scatter](
    "Pixels",
    "scatters.html",
    "One dot is one step of that episode: a score worth training on is not the amount of change.",
)
SCORES_OVER_TIME = SectionKind[Series](
    "Scores over time",
    "curves.html",
    "Mean score at each step: a reward worth training on parts successes from failures.",
)
SUB_GOALS = SectionKind[Series](
    "Sub-goals",
    "curves.html",
    "Each frame against each sub-goal: the lines should rise one after another.",
)
EPISODES = SectionKind[EpisodePanel](
    "Episodes",
    "episodes.html",
    "Drag in a chart, or focus it and press the arrow keys, to move through the video; space plays.",
)
FILMS = SectionKind[Film](
    "Videos",
    "films.html",
    "The best and the worst episode by return. Drag in a chart, or focus it and press the arrow keys; space plays.",
)
NOT_SHOWN = SectionKind[str]("Not shown", "sentences.html")
LEARNING_CURVES = SectionKind[Series](
    "Learning curves",
    "curves.html",
    "Lines are means over seeds; a band, where there is one, is their spread.",
    x_name="Gradient step",
)
ONLINE_CURVES = SectionKind[Series](
    "Learning in the environment",
    "curves.html",
    "Mean return of the newest 20 episodes of the training, which also explores. Lines are means over seeds; a band, "
    "where there is one, is their spread.",
    x_name="Step in the environment",
)
DETAILS = SectionKind[tuple[str, object]]("Details", "details.html", "Everything needed to make these figures again.")
"""Configs, versions, provenance: a name and anything that reads as JSON; each is a collapsed block."""
