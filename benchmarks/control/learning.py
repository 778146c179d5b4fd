"""Steps per second of the learning environments, and the trained network on unseen devices.

python -m benchmarks.control.learning
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator

import numpy as np

from benchmarks.rows import Row
from haselab.base import SilentProgress
from haselab.learning import StrainVectorEnv
from haselab.scoreboard import Plan, board_rows, play_board

ENVIRONMENTS = 1024
STEPS = 100
STEPS_PER_S = 500_000.0
CLASSES = ("host-100hz", "chip-1khz")
# less is better
COMPARED = (
    ("T1", "rise_s"),
    ("T1", "iae"),
    ("T3", "sine_1hz"),
    ("T3", "sine_3hz"),
    ("T3", "gait_1hz"),
)


def steps_per_s() -> float:
    """Of one core, by processor time."""
    envs = StrainVectorEnv(ENVIRONMENTS, "track", devices=16)
    envs.reset(seed=1)
    actions = np.random.default_rng(1).uniform(-1.0, 0.5, (ENVIRONMENTS, 1)).astype(np.float32)
    envs.step(actions)
    start_s = time.process_time()
    for _ in range(STEPS):
        envs.step(actions)
    return ENVIRONMENTS * STEPS / (time.process_time() - start_s)


def rows(seeds: int = 1) -> Iterator[Row]:
    """Measure the speed, and play the network against the paper's PI.

    Args:
        seeds: of each task.
    """
    yield Row("steps of a vector environment, one core",
              float(np.median([steps_per_s() for _ in range(3)])), "1/s", STEPS_PER_S)  # fmt: skip
    tasks = tuple(dict.fromkeys(task for task, _ in COMPARED))
    plan = Plan(("pi", "network"), tasks, CLASSES, seed=1, seeds=seeds, workers=2)
    found = {(row.controller, row.loop, row.task, row.metric): row
             for row in board_rows(play_board(plan, SilentProgress()))}  # fmt: skip
    for loop, (task, metric) in itertools.product(CLASSES, COMPARED):
        paper, network = (found[name, loop, task, metric].median for name in ("pi", "network"))
        if paper is None and metric == "rise_s":  # the PI does not reach 90 % of each step
            paper = math.inf
        ratio = math.nan if network is None or paper is None else network / paper
        yield Row(f"{task} {metric}, {loop}, network over the paper's PI", ratio, "", 1.0,
                  more_is_better=False)  # fmt: skip
    for loop in CLASSES:
        paper, network = (found[name, loop, "T1", "overshoot"].median for name in ("pi", "network"))
        yield Row(f"T1 overshoot, {loop}, network", math.nan if network is None else network, "",
                  note=f"PI: {paper}")  # fmt: skip


def main() -> None:
    for row in rows():
        print(row, flush=True)


if __name__ == "__main__":
    main()
