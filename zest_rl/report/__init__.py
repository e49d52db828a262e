"""Results → one self-contained HTML file, for people who choose a reward by looking.

`sections` lists what a page may hold and `content` what that is made of; `charts` draws it as SVG, and `html` puts it
into the templates. One module per kind of result builds its page: `comparison_page`, `inspection_page`,
`sub_goal_page`.
"""

from zest_rl.report.content import (
    Curve,
    EpisodePanel,
    GoalPanel,
    Matrix,
    MethodRow,
    QualityRow,
    QualityTable,
    Scatter,
    Strip,
    TaskTable,
)
from zest_rl.report.html import render_html, write_report
from zest_rl.report.sections import (
    Caveats,
    Details,
    Episodes,
    Frames,
    Goals,
    LearningCurves,
    Pixels,
    Ranking,
    Report,
    Results,
    RewardQuality,
    ScoresOverTime,
    Section,
    SubGoals,
    Tasks,
    TasksAgainstGoals,
    Views,
    Warnings,
)

__all__ = [
    "Caveats", "Curve", "Details", "EpisodePanel", "Episodes", "Frames", "GoalPanel", "Goals", "LearningCurves",
    "Matrix", "MethodRow", "Pixels", "QualityRow", "QualityTable", "Ranking", "Report", "Results", "RewardQuality",
    "Scatter", "ScoresOverTime", "Section", "Strip", "SubGoals", "TaskTable", "Tasks", "TasksAgainstGoals", "Views",
    "Warnings", "render_html", "write_report",
]  # fmt: skip
