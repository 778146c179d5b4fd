"""What every benchmark gives: lines of one table, and the clock they were taken with."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

__all__ = ["RUNNER", "Row", "medians", "seconds"]

ROUNDS = 7

# Runs the command in a process of its own and tells how long it took and its largest memory.
RUNNER = """
import json, os, resource, subprocess, sys, time
start = time.perf_counter()
done = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL)
spent = time.perf_counter() - start
used = resource.getrusage(resource.RUSAGE_CHILDREN)
told = {"s": spent, "cpu_s": used.ru_utime + used.ru_stime, "code": done.returncode}
print(json.dumps(told | {"peak_mb": used.ru_maxrss * 1024 / 1e6}))
"""


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
