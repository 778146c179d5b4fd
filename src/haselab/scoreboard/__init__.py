"""Controllers against tasks on simulated devices, scored against what is physically possible."""

from haselab.scoreboard.board import Entry, Game, Plan, Played, play_board
from haselab.scoreboard.entrants import entering_kinds
from haselab.scoreboard.loop_class import CLASSES, LoopClass
from haselab.scoreboard.rows import Row, board_rows, limits_of
from haselab.scoreboard.tasks import TASKS, Metric, Task

__all__ = [
    "CLASSES",
    "TASKS",
    "Entry",
    "Game",
    "LoopClass",
    "Metric",
    "Plan",
    "Played",
    "Row",
    "Task",
    "board_rows",
    "entering_kinds",
    "limits_of",
    "play_board",
]
