"""The tasks of the scoreboard, one file for each kind."""

from haselab.scoreboard.tasks.lasting import LASTING_TASKS
from haselab.scoreboard.tasks.loads import LOAD_TASKS
from haselab.scoreboard.tasks.steps import STEP_TASKS
from haselab.scoreboard.tasks.task import Metric, Task, staircase
from haselab.scoreboard.tasks.tracking import TRACKING_TASKS

__all__ = ["TASKS", "Metric", "Task", "staircase"]

_ALL = (*STEP_TASKS, *TRACKING_TASKS, *LOAD_TASKS, *LASTING_TASKS)
TASKS = {
    task.name: task
    for task in sorted(
        (*STEP_TASKS, *TRACKING_TASKS, *LOAD_TASKS, *LASTING_TASKS), key=lambda task: task.name
    )
}
