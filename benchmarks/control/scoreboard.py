"""Controllers on the scoreboard against the goals of the field, and how long a game takes.

    python -m benchmarks.control.scoreboard --seeds 5

At 100 Hz. Each controller is designed from a model that is identified from a simulated record.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator

from benchmarks.rows import Row
from haselab.base import SilentProgress
from haselab.scoreboard import Plan, board_rows, play_board

CONTROLLER = "observer"
OF_TASK = {"T5": "hybrid", "T7": "learning"}  # in place of it
HOST = "host-100hz"
# metric: goal; a step of 0.04, one of 0.14 from 0 V, sines of 3 %, and changes of the load by 10 %
GOALS = {
    ("T1", "rise_s"): 0.04,
    ("T1", "overshoot"): 0.05,
    ("T1", "settling_s"): 0.15,
    ("T1", "rise_from_zero_s"): 0.065,
    ("T2", "error_at_rest"): 5e-4,
    ("T2", "overshoot"): 0.05,
    ("T3", "sine_1hz"): 0.01,
    ("T3", "sine_3hz"): 0.02,
    ("T3", "sine_5hz"): 0.05,
    ("T4", "peak"): 0.01,
    ("T4", "recovery_s"): 0.15,
    ("T5", "change_error_0p2s_kg"): 2.5e-3,
    ("T5", "change_error_1s_kg"): 1e-3,
    ("T5", "mass_error"): 0.02,
    ("T5", "rise_s"): 0.047,  # 1.3 times that with the known load
    ("T5", "overshoot"): 0.05,
    ("T6", "error"): 2.4e-4,  # 0.1 % of the range from -3 to 21 % strain
    ("T6-retention", "error"): 7.2e-4,
    ("T7", "error_after_ten"): 3e-3,
    ("T8-rad", "rise_s"): 0.24,
}
QUICK = ("T1", "T2", "T3", "T4")


def rows(seeds: int = 1, whole: bool = False) -> Iterator[Row]:
    """Play and compare with the goals.

    Args:
        seeds: of each task.
        whole: play all tasks that have a goal, not T1 to T4 alone.
    """
    tasks = tuple(dict.fromkeys(task for task, _ in GOALS)) if whole else QUICK
    own = tuple(OF_TASK.values()) if whole else ()
    controllers = ("pid", "force", CONTROLLER, *own)
    plan = Plan(controllers, tasks, (HOST,), seed=1, seeds=seeds, workers=2)
    start_s = time.perf_counter()
    game = play_board(plan, SilentProgress())
    took_s = time.perf_counter() - start_s
    found = {(row.controller, row.task, row.metric): row for row in board_rows(game)}
    for (task, metric), goal in GOALS.items():
        if task in tasks:
            chosen = OF_TASK.get(task, CONTROLLER)
            row = found[chosen, task, metric]
            others = ", ".join(
                f"{name} {_text(found[name, task, metric].median)}"
                for name in controllers if name != chosen
            )  # fmt: skip
            value = math.inf if row.median is None else row.median
            yield Row(
                f"{task} {metric}, {chosen}",
                value,
                row.unit,
                goal,
                more_is_better=False,
                note=others,
            )
    yield Row("controllers, tasks and seeds together", took_s, "s")


def _text(value: float | None) -> str:
    return "not reached" if value is None else f"{value:.3g}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    for row in rows(parser.parse_args().seeds, whole=True):
        print(row, flush=True)


if __name__ == "__main__":
    main()
