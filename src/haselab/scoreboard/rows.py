"""The results as rows: median and worst over the seeds, beside the physical limit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from haselab.scoreboard.board import Game, Played
from haselab.scoreboard.tasks import TASKS

__all__ = ["Row", "board_rows", "limits_of"]


@dataclass(frozen=True)
class Row:
    """One number of one controller in one task.

    Args:
        controller: kind.
        loop: name of the class.
        task: name.
        metric: name.
        unit: SI.
        median: over the seeds; None: half of them or more failed.
        worst: over the seeds; None: at least one failed.
        bound: median of the physical limits; None: there is none.
        ratio_to_bound: bound over median, 1 at the limit, 0 after a failure; None without a bound.
        seeds: how many were played.
        violations: in how many the task ended early or the field was too high.
    """

    controller: str
    loop: str
    task: str
    metric: str
    unit: str
    median: float | None
    worst: float | None
    bound: float | None
    ratio_to_bound: float | None
    seeds: int
    violations: int

    def answer(self) -> dict[str, str | float | int | None]:
        """Under the names of the contract."""
        found = dict(vars(self))
        loop = found.pop("loop")
        return {"controller": found.pop("controller"), "class": loop, **found}


def board_rows(game: Game) -> list[Row]:
    """Summarise a game.

    Args:
        game: played.
    Returns:
        A row for each controller, class, task and metric.
    """
    groups: dict[tuple[str, str, str], list[Played]] = {}
    for one in game.played:
        groups.setdefault((one.controller, one.loop, one.task), []).append(one)
    return [
        _row(group, metric.name, metric.unit)
        for (_, _, task), group in groups.items()
        for metric in TASKS[task].metrics
    ]


def limits_of(tasks: Sequence[str]) -> list[tuple[str, str, tuple[str, ...]]]:
    """What the physical limits of some tasks are and assume.

    Args:
        tasks: names.
    Returns:
        Task, limit, and the names of the metrics that have it.
    """
    found: dict[tuple[str, str], list[str]] = {}
    for name in tasks:
        for metric in TASKS[name].metrics:
            if metric.limit:
                found.setdefault((name, metric.limit), []).append(metric.name)
    return [(task, limit, tuple(names)) for (task, limit), names in found.items()]


def _row(group: Sequence[Played], metric: str, unit: str) -> Row:
    first = group[0]
    values = [one.numbers[metric] for one in group]
    limits = [one.bounds[metric] for one in group if metric in one.bounds]
    # what was not done is worse than any number
    done = np.array([math.inf if math.isnan(value) else value for value in values])
    median, worst = _finite(float(np.sort(done)[done.size // 2])), _finite(float(done.max()))
    if median is not None and done.size % 2 == 0:
        median = _finite(float(np.median(done)))
    bound = float(np.median(limits)) if limits else None
    ratio = None
    if bound is not None:
        ratio = 0.0 if median is None else 1.0 if median <= bound else bound / median
    return Row(
        first.controller, first.loop, first.task, metric, unit, median, worst, bound, ratio,
        len(group), sum(one.violates for one in group),
    )  # fmt: skip


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
