"""The sections of a report: what each kind is headed, what a reader must know to read it, which template draws it.

A new kind of section is a class here and a file in ``templates/``, which finds the section as ``section``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

from zest_rl.report.content import (
    Curve,
    EpisodePanel,
    GoalPanel,
    Matrix,
    MethodRow,
    QualityTable,
    Scatter,
    Strip,
    TaskTable,
)

Item = TypeVar("Item")


@dataclass(frozen=True)
class Section(Generic[Item]):
    """A heading, an introduction, and what the template draws below them; without items it is not shown."""

    items: tuple[Item, ...]
    heading: ClassVar[str]
    intro: ClassVar[str] = ""
    template: ClassVar[str]
    """File in ``templates/``."""

    @property
    def anchor(self) -> str:
        """Name to which links of the page point."""
        return self.heading.lower().replace(" ", "-")


@dataclass(frozen=True)
class Report:
    """Everything one HTML file shows."""

    title: str
    summary: str
    """One sentence below the title; may be empty."""
    sections: tuple[Section[Any], ...] = ()
    """In the order in which they are shown."""

    def items(self, kind: type[Section[Item]]) -> tuple[Item, ...]:
        """Return what the section of this kind shows; nothing where the report has none."""
        return tuple(item for section in self.sections if isinstance(section, kind) for item in section.items)


class Results(Section[MethodRow]):
    """The methods that were evaluated, in one table."""

    heading = "Results"
    intro = "100 % is the expert, 0 % is the robot that does nothing. Lines are 95 % bootstrap intervals."
    template = "results.html"


class Tasks(Section[TaskTable]):
    """The same table for each task alone, with a link to its page."""

    heading = "Tasks"
    intro = "Each task on its own; its page has the goals, the episodes' videos and all settings."
    template = "tasks.html"


class Caveats(Section[str]):
    """Sentences that limit what the results say."""

    heading = "Caveats"
    template = "sentences.html"


class Warnings(Section[str]):
    """Sentences about rewards."""

    heading = "Warnings"
    intro = "What speaks against training on these rewards."
    template = "sentences.html"


class RewardQuality(Section[QualityTable]):
    """Figures that judge rewards, one column per dataset."""

    heading = "Reward quality"
    intro = "Small figures are 95 % bootstrap intervals over episodes. Ground truth judges a reward, it makes none."
    template = "quality.html"


class TasksAgainstGoals(Section[Matrix]):
    """Which task's episodes each goal scores highest."""

    heading = "Tasks against goals"
    intro = "Mean score of where episodes end; a goal should score those of its own task highest (bold: highest)."
    template = "matrix.html"


class Goals(Section[GoalPanel]):
    """The pictures or sentences of each goal."""

    heading = "Goals"
    intro = "What the reward was told: the state at the start and the state wanted. ρ is the Spearman correlation."
    template = "goals.html"


class Ranking(Section[Scatter]):
    """Returns by rewards against true returns."""

    heading = "Ranking"
    intro = "One dot is one episode. A reward worth training on ranks episodes as ground truth does."
    template = "scatters.html"


class Frames(Section[Strip]):
    """What the score sees of single episodes."""

    heading = "Frames"
    intro = "Frames of one episode; below, their score between the lowest (0) and the highest (1)."
    template = "frames.html"


class Curves(Section[Curve]):
    """Lines, those of the same quantity in one chart."""

    template = "curves.html"
    x_name: ClassVar[str] = "Step"
    first_alone: ClassVar[bool] = False
    """Whether all but the first curve of a chart are faint and alike."""

    @property
    def by_quantity(self) -> dict[str, list[Curve]]:
        """The curves of each chart."""
        quantities = dict.fromkeys(curve.quantity for curve in self.items)
        return {quantity: [c for c in self.items if c.quantity == quantity] for quantity in quantities}


class Views(Curves):
    """Scores of one episode by each view."""

    heading = "Views"
    intro = "The same episode by all views together, which is the reward, and by each view alone."
    first_alone = True


class Pixels(Section[Scatter]):
    """Scores against how many pixels change."""

    heading = "Pixels"
    intro = "One dot is one step of that episode: a score worth training on is not the amount of change."
    template = "scatters.html"


class ScoresOverTime(Curves):
    """Mean scores of groups of episodes."""

    heading = "Scores over time"
    intro = "Mean score at each step: a reward worth training on parts successes from failures."


class SubGoals(Curves):
    """Scores of one episode by each of its sub-goals."""

    heading = "Sub-goals"
    intro = "Each frame against each sub-goal: the lines should rise one after another."


class Episodes(Section[EpisodePanel]):
    """Videos beside scores and progress."""

    heading = "Episodes"
    intro = "Drag in a chart, or focus it and press the arrow keys, to move through the video; space plays."
    template = "episodes.html"


class LearningCurves(Curves):
    """Losses and returns over training."""

    heading = "Learning curves"
    intro = "Lines are means over seeds; a band, where there is one, is their spread."
    x_name = "Gradient step"


class Details(Section[tuple[str, object]]):
    """Configs, versions, provenance: a name and anything that reads as JSON; each is a collapsed block."""

    heading = "Details"
    intro = "Everything needed to make these figures again."
    template = "details.html"
