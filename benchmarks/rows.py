"""What every benchmark gives: lines of one table, and the clock they were taken with."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

__all__ = ["Row", "medians", "seconds"]

ROUNDS = 7


@dataclass(frozen=True)
class Row:
    """One line of the table; a goal is met from above where `more_is_better`."""

    what: str
    value: float
    unit: str
    goal: float | None = None
    more_is_better: bool = True
    note: str = ""

    def verdict(self) -> str:
        if self.goal is None:
            return ""
        met = self.value >= self.goal if self.more_is_better else self.value <= self.goal
        return f"goal {self.goal:g}: {'met' if met else 'MISSED'}"

    def __str__(self) -> str:
        note = "   ".join(part for part in (self.verdict(), self.note) if part)
        return f"{self.what:48s} {self.value:10.4g} {self.unit:13s} {note}".rstrip()


def seconds(job: Callable[[], object]) -> float:
    start = time.perf_counter()
    job()
    return time.perf_counter() - start


def medians(*jobs: Callable[[], object], rounds: int = ROUNDS) -> list[float]:
    """Median seconds of each job; the jobs take turns."""
    for job in jobs:
        job()
    times = [[seconds(job) for job in jobs] for _ in range(rounds)]
    return [statistics.median(column) for column in zip(*times, strict=True)]
