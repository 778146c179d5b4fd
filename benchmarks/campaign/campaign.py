"""Campaigns: efficiency of two processes and two Dask workers, time to continue, and overheads.

    python -m benchmarks.campaign.campaign [--cases 10000] [--repeats 1]

A case identifies a virtual device: parameters drawn, its record simulated in C and fitted. T1 is
the time of one process. All times include the start of the workers, except for a running scheduler,
whose two workers wait for the command, as on a cluster. The speed of a shared computer changes
within minutes: T1 is measured before and after each campaign of two workers and its mean counts.
With --repeats, the median of the ratios counts.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import pickle
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import astuple, dataclass
from pathlib import Path

from distributed import Client

from benchmarks.rows import Row
from haselab.base import SilentProgress
from haselab.campaign.definition import load_campaign
from haselab.campaign.executors.dask import LOCAL, DaskExecutor
from haselab.campaign.executors.executor import Executor
from haselab.campaign.executors.processes import ProcessExecutor
from haselab.campaign.folder import finished_rows, open_folder
from haselab.campaign.plan import Plan, Problem
from haselab.campaign.run import run_cases
from haselab.store.campaign.shards import CaseRow, Shards

CASES = 10_000
FINISHED = 100_000
_GOAL = 0.9  # of T1 / (N TN), for all CASES
_WORKERS = {
    "running": "2 workers of a running Dask scheduler",
    "two": "2 processes",
    "dask": "2 Dask workers",
}
CAMPAIGN = """
name = "quick virtual devices"
kind = "transfer"
seed = 1
[parameters]
case.gain = {{ uniform = [0.3, 0.7] }}
case.natural_frequency_rad_s = {{ log-uniform = [10.0, 60.0] }}
case.damping_ratio = {{ log-uniform = [0.05, 0.4] }}
case.delay_s = {{ uniform = [0.0, 0.03] }}
[design]
kind = "latin-hypercube"
samples = {cases}
"""
# Those that docs/study/campaign.md, "On a cluster", recommends.
SETTINGS = {
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "DASK_DISTRIBUTED__WORKER__MEMORY__MONITOR_INTERVAL": "2s",
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "1s",
    "DASK_DISTRIBUTED__ADMIN__SYSTEM_MONITOR__INTERVAL": "5s",
    "MALLOC_TRIM_THRESHOLD_": "268435456",
}
# prints the time from the start of the process to the first case that would be computed
RESUME = """
import sys, time
from pathlib import Path
import psutil
from haselab.base import SilentProgress
from haselab.cli.campaign import command
from haselab.campaign.run import run_cases

class Started(Exception):
    pass

def started(problem, waiting):
    raise Started

plan = command.plan_of(command.load_campaign(Path(sys.argv[1])), Path(sys.argv[2]))
command.open_folder(plan, Path(sys.argv[2]))
try:
    run_cases(plan, Path(sys.argv[2]), started, SilentProgress())
except Started:
    print(time.time() - psutil.Process().create_time())
"""


def _plan(folder: Path, cases: int) -> Plan:
    path = folder / f"{cases}.toml"
    path.write_text(CAMPAIGN.format(cases=cases))
    return Plan(load_campaign(path))


@dataclass(frozen=True)
class _Times:
    """Of a whole campaign: wall time, processor time of this program and of its child processes."""

    wall_s: float
    own_s: float
    workers_s: float

    def mean(self, other: _Times) -> _Times:
        """Return the mean of two campaigns."""
        pairs = zip(astuple(self), astuple(other), strict=True)
        return _Times(*(0.5 * (a + b) for a, b in pairs))


@contextlib.contextmanager
def _running_cluster(folder: Path) -> Iterator[str]:
    """Address of a scheduler with two workers, started as docs/study/campaign.md says."""
    file = str(folder / "scheduler.json")
    environment = {**os.environ, **SETTINGS}
    workers = ["--scheduler-file", file, "--nworkers", "2", "--nthreads", "1", "--no-dashboard"]
    lines = (
        ["scheduler", "--scheduler-file", file, "--port", "0", "--no-dashboard"],
        ["worker", *workers],
    )
    running = [
        subprocess.Popen(
            [sys.executable, "-m", "dask", *line], env=environment, cwd=folder,
            stderr=subprocess.DEVNULL,
        )
        for line in lines
    ]  # fmt: skip
    try:
        with Client(scheduler_file=file, set_as_default=False) as client:
            client.wait_for_workers(2)
            address = str(client.scheduler.address)
        yield address
    finally:
        for one in reversed(running):
            one.terminate()
            one.wait()


def _timed(plan: Plan, out: Path, make: Callable[[Problem], Executor]) -> _Times:
    open_folder(plan, out)
    wall_s, own_s, before = time.perf_counter(), time.process_time(), _children_s()
    found = run_cases(plan, out, lambda problem, waiting: make(problem), SilentProgress())
    assert found.done == plan.count, found
    workers_s = _children_s() - before
    return _Times(time.perf_counter() - wall_s, time.process_time() - own_s, workers_s)


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _measured(plan: Plan, folder: Path) -> dict[str, tuple[_Times, _Times]]:
    """Campaigns by two processes, a local and a running cluster, each with one by one process."""
    ones: list[_Times] = []

    def one_process() -> None:
        out = folder / f"one-{len(ones)}"
        ones.append(_timed(plan, out, lambda problem: ProcessExecutor(problem, 1)))

    one_process()
    two = _timed(plan, folder / "two", lambda problem: ProcessExecutor(problem, 2))
    one_process()
    dask = _timed(plan, folder / "dask", lambda problem: DaskExecutor(problem, LOCAL, 2))
    one_process()
    with _running_cluster(folder) as address:
        running = _timed(
            plan, folder / "running", lambda problem: DaskExecutor(problem, address, 2)
        )
    one_process()
    found = {"two": two, "dask": dask, "running": running}
    around = [before.mean(after) for before, after in itertools.pairwise(ones)]
    return {name: (one, times) for one, (name, times) in zip(around, found.items(), strict=True)}


def rows(cases: int = CASES, finished: int = FINISHED, repeats: int = 1) -> Iterator[Row]:
    """Measure.

    Args:
        cases: of the campaigns whose time is measured.
        finished: cases in the folder that is continued.
        repeats: of each campaign.
    """
    with tempfile.TemporaryDirectory() as name:
        plan = _plan(Path(name), cases)
        goal = _GOAL if cases >= CASES else None  # with fewer, the start of the workers counts more
        rounds = []
        for number in range(repeats):
            folder = Path(name) / f"round-{number}"
            folder.mkdir()
            rounds.append(_measured(plan, folder))
        one, two = rounds[0]["two"]
        about = f"{cases:,} devices, {1e3 * one.wall_s / cases:.2g} ms each"
        load = f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
        for name, what in _WORKERS.items():
            pairs = [found[name] for found in rounds]
            share = statistics.median(one.wall_s / (2.0 * both.wall_s) for one, both in pairs)
            yield Row(f"T1 / (2 T2), {what}", share, "", goal, note=f"{about}, {load}")
            own_s = statistics.median(1e3 * both.own_s / cases for _, both in pairs)
            yield Row(f" of this program, {what}", own_s, "ms/case")
        # The time of all processes together does not depend on other programs on the computer.
        share = one.workers_s / (two.own_s + two.workers_s)
        yield Row("T1 / (2 T2) by processor time, 2 processes", share, "", goal)
        finished_by = {name: finished_rows(plan, folder / name) for name in ("two", "dask")}
        same = [(row.case, row.results) for row in finished_by["two"]] == [
            (row.case, row.results) for row in finished_by["dask"]
        ]
        yield Row("campaigns with other bits by Dask", float(not same), "", 0.0, False)
        sent = len(pickle.dumps(finished_by["two"]))
        yield Row("result of a case on its way", sent / cases, "byte")
        stored = sum(path.stat().st_size for path in (folder / "two" / "shards").iterdir())
        yield Row("result of a case on the disk", stored / cases, "byte")
        yield _resume(folder, finished, finished_by["two"][0])


def _resume(folder: Path, finished: int, like: CaseRow) -> Row:
    """Time to continue a campaign of which all cases but one are finished."""
    plan, out = _plan(folder, finished), folder / "resume"
    open_folder(plan, out)
    shards = Shards(out, "earlier")
    hashes = plan.hashes()
    for first in range(0, finished - 1, 500):
        shards.write([
            CaseRow(hashes[k], k, plan.values(k), like.results)
            for k in range(first, min(first + 500, finished - 1))
        ])  # fmt: skip
    line = [sys.executable, "-c", RESUME, str(folder / f"{finished}.toml"), str(out)]
    times_s = [float(subprocess.check_output(line, text=True)) for _ in range(3)]
    return Row(
        f"time to continue, {finished:,} finished", min(times_s), "s", 2.0, False,
        f"{len(list((out / 'shards').iterdir()))} files; from the start of the process",
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=CASES)
    parser.add_argument("--repeats", type=int, default=1)
    given = parser.parse_args()
    for row in rows(given.cases, repeats=given.repeats):
        print(row, flush=True)


if __name__ == "__main__":
    main()
