"""What every benchmark returns: the rows of one table, and the clock that times them."""

import math
import statistics
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

__all__ = ["CHECKOUT", "RUNNER", "Row", "goal_of", "medians", "seconds", "summary"]

CHECKOUT = Path(__file__).resolve().parents[1]
ROUNDS = 7

# Runs the command in its own process and prints its time and its largest memory.
RUNNER = """
import json, os, resource, subprocess, sys, time
start = time.perf_counter()
done = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL)
elapsed = time.perf_counter() - start
used = resource.getrusage(resource.RUSAGE_CHILDREN)
result = {"s": elapsed, "cpu_s": used.ru_utime + used.ru_stime, "code": done.returncode}
print(json.dumps(result | {"peak_mb": used.ru_maxrss * 1024 / 1e6}))
"""


@dataclass(frozen=True)
class Row:
    """One line of the table; with `more_is_better` the goal is a lower limit."""

    what: str
    value: float
    unit: str
    goal: float | None = None
    more_is_better: bool = True
    note: str = ""

    def outcome(self) -> str:
        """Whether the goal is "reached", "missed" or "not measured"; "" without a goal."""
        if self.goal is None:
            return ""
        if math.isnan(self.value):
            return "not measured"
        met = self.value >= self.goal if self.more_is_better else self.value <= self.goal
        return "reached" if met else "missed"

    def __str__(self) -> str:
        goal = "" if self.goal is None else f"goal {self.goal:g}: {self.outcome().upper()}"
        note = "   ".join(part for part in (goal, self.note) if part)
        return f"{self.what:48s} {self.value:10.4g} {self.unit:13s} {note}".rstrip()


def summary(sections: Iterable[tuple[str, Iterable[Row]]]) -> str:
    """Every claim with its goal, the missed ones last, and how many were reached.

    Args:
        sections: name and rows of each section. A row that begins with a space belongs to the
            last one before it that does not.
    Returns:
        The text of the table.
    """
    lines: dict[str, list[str]] = {"reached": [], "not measured": [], "missed": []}
    for section, rows in sections:
        head = ""
        for row in rows:
            name = row.what.strip()
            if row.what[:1].isspace():
                name = f"{head}: {name}"
            else:
                head = name
            if row.goal is not None:
                limit = f"{'>=' if row.more_is_better else '<='} {row.goal:g}"
                lines[row.outcome()].append(
                    f"{section:15s} {name:75s} {limit:>9s} {row.value:10.4g} {row.unit:13s} "
                    f"{row.outcome()}"
                )
    title = f"{'section':15s} {'claim':75s} {'goal':>9s} {'measured':>10s}"
    counts = ", ".join(f"{len(found)} {outcome}" for outcome, found in lines.items())
    total = sum(len(found) for found in lines.values())
    return "\n".join([title, *(line for found in lines.values() for line in found),
                      f"{total} goals: {counts}."])  # fmt: skip


def goal_of(goal: float, ideal: float, runs: int, stated: int = 1000) -> float:
    """A statistical goal for fewer runs than those for which it is stated.

    Args:
        goal: for `stated` runs.
        ideal: what the number would be in infinitely many.
        runs: that are made; chance moves the number away from the ideal with their root.
        stated: runs for which the goal is stated.
    Returns:
        The goal, further from the ideal with fewer runs.
    """
    return ideal + (goal - ideal) * math.sqrt(stated / min(runs, stated))


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
