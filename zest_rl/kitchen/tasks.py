"""The six kitchen tasks of the paper as a table: everything that differs between tasks, and no code.

Joint limits and goals are FrankaKitchen-v1's; two goals differ from that environment's own tasks (`knob2`, `knob3`
are burners that it names differently), so progress is always read from the joint itself.
"""

from __future__ import annotations

from dataclasses import dataclass

from zest_rl.errors import BadInput, nearest

RING = (60.0, 120.0)
"""Azimuths in degrees between which views are spread; 90 looks from the robot's side straight at the kitchen."""


@dataclass(frozen=True)
class Task:
    """One manipulation: its joint and goal, cameras, and names."""

    name: str
    joint: str
    """Name of the MuJoCo joint; it starts at 0."""
    goal: float
    """Joint position of the goal, in rad (m for `sdoor`)."""
    lookat: tuple[float, float, float]
    """World point that cameras look at, in metres: in or before the middle of the moving part, closed and open; of a
    knob, before the burner that it lights up, which is the larger part of what moves."""
    elevations: tuple[float, ...]
    """Camera elevations of the ring of views, in degrees; negative looks down."""
    goal_folder: str
    """Folder of this task in the Visual Tasks Dataset."""
    action: str
    """The verb, whatever the object: for action selection, tasks with the same action are equal."""
    start_text: str
    goal_text: str
    seen_from: tuple[float, float] = RING
    """Azimuths in degrees from which the scene does not hide the moving part; views from elsewhere are left out. A view
    must see half of what the best view sees of it, as in any scene (`zest_rl.simulation.framing.hidden_views`)."""


TASKS: dict[str, Task] = {
    task.name: task
    for task in (
        Task("knob2", "knob_Joint_2", -0.88, (-0.22, 0.34, 1.65), (-20, -35), "turn_on_stove",
             "turn on", "stove turned off", "stove turned on", seen_from=(92.0, 120.0)),  # past the kettle on it
        Task("knob3", "knob_Joint_3", -0.90, (0.2, 0.75, 1.65), (-25, -40), "turn_on_stove",
             "turn on", "stove turned off", "stove turned on"),
        Task("ldoor", "left_hinge_cabinet", -1.25, (-0.82, 0.45, 2.6), (-10, -30), "open_cabinet",
             "open", "closed cabinet", "open cabinet"),
        Task("rdoor", "right_hinge_cabinet", 1.45, (-0.36, 0.45, 2.6), (-10, -30), "open_cabinet",
             "open", "closed cabinet", "open cabinet"),
        Task("sdoor", "slide_cabinet", 0.37, (0.12, 0.45, 2.6), (-10, -30), "open_sliding_door",
             "open", "closed sliding door", "open sliding door"),
        Task("micro", "microwave", -0.75, (-0.87, 0.33, 1.8), (-10, -30), "open_microwave",
             "open", "closed microwave", "open microwave"),
    )
}  # fmt: skip

SUCCESS_PROGRESS = 0.999
"""A step is a success when clipped progress reaches this; progress = joint position / goal."""


def get_task(name: str) -> Task:
    """Return the task called `name`.

    Raises:
        BadInput: there is no such task; the message names the nearest ones.
    """
    if name not in TASKS:
        raise BadInput(f"unknown task {name!r}; {nearest(name, TASKS)}")
    return TASKS[name]
