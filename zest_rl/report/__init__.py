"""Results → one self-contained HTML file, for people who choose a reward by looking.

`data` holds what a report says, `charts` draws it as SVG, `page` puts both into `template.html`.
"""

from zest_rl.report.content import (
    Curve,
    EpisodePanel,
    GoalPanel,
    Matrix,
    MethodRow,
    QualityRow,
    QualityTable,
    Report,
    Scatter,
    Section,
    Strip,
)
from zest_rl.report.html import render_html, write_report

__all__ = [
    "Curve", "EpisodePanel", "GoalPanel", "Matrix", "MethodRow", "QualityRow", "QualityTable", "Report", "Scatter",
    "Section", "Strip", "render_html", "write_report",
]  # fmt: skip
