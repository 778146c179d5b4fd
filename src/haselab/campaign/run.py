"""Run a campaign: the cases that are not finished, in chunks, until all of them are.

The shards in the folder are the only record. The queue is all cases minus the finished ones, so a
program that starts again, or while another one is running, continues from the folder.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from haselab.base import DeviceError, Progress
from haselab.campaign.executors.executor import Chunk, Executor, Outcome
from haselab.campaign.plan import Job, Plan, Problem
from haselab.store.campaign.claims import Claims
from haselab.store.campaign.shards import CaseRow, Shards

__all__ = ["Progressed", "run_cases"]

# Computing time of a chunk, so that the time between two is small against it; and so much of it for
# each worker, because this program takes about 10 ms for each chunk of any worker.
_CHUNK_S, _CHUNK_S_FOR_EACH = 2.0, 0.02
_LAST_CHUNK_S = 0.1  # least computing time of a chunk at the end
_MOST_IN_CHUNK = 2000
_AHEAD = 2  # chunks for each worker: one in work and one that waits
_BLOCKS = 1000  # into which the cases are divided for claims
_MOST_DEATHS = 4  # of workers that computed the same case
_WAIT_S = 1.0
# A stop names a case that has been running for longer than both this time and this multiple of the
# mean time of a case.
_LONG_S, _LONG_MULTIPLE = 30.0, 10.0


@dataclass(frozen=True)
class Progressed:
    """What one program has done for a campaign.

    Args:
        cases: of the campaign.
        done: finished cases with a result, by this program or before.
        failed: finished cases without one.
        elsewhere: cases that another program computes.
        computed: by this program.
        workers: that it used.
        wall_s: time that it took.
        compute_s: sum over the cases that it computed.
        outdated: finished cases in the folder that this campaign does not have: of another version.
    """

    cases: int
    done: int
    failed: int
    elsewhere: int
    computed: int
    workers: int
    wall_s: float
    compute_s: float
    outdated: int

    @property
    def is_complete(self) -> bool:
        """Whether all cases are finished."""
        return self.done + self.failed == self.cases

    @property
    def efficiency(self) -> float | None:
        """Share of the workers' time that cases took; None: nothing was computed."""
        return self.compute_s / (self.workers * self.wall_s) if self.computed else None


def run_cases(
    plan: Plan,
    folder: Path,
    executor: Callable[[Problem, int], Executor],
    progress: Progress,
    *,
    retry_failed: bool = False,
) -> Progressed:
    """Compute the cases of a campaign that are not finished.

    Args:
        plan: of the campaign.
        folder: with the shards.
        executor: makes the executor, for a number of waiting cases.
        progress: of the cases.
        retry_failed: compute failed cases again.
    Returns:
        What was done.
    Raises:
        DeviceError: the disk is full, or the executor failed; finished cases are kept.
    """
    begun = time.monotonic()
    with Claims(folder) as claims:
        shards = Shards(folder, claims.writer)
        return _Run(plan, shards, claims, progress, retry_failed).finish(executor, begun)


class _Run:
    """One program at work on a campaign."""

    def __init__(
        self, plan: Plan, shards: Shards, claims: Claims, progress: Progress, retry: bool
    ) -> None:
        self._plan, self._shards, self._claims = plan, shards, claims
        self._progress = progress
        self._hashes = plan.hashes()
        states = shards.states()
        self._states = [states.get(case) for case in self._hashes]
        self._outdated = len(states) - sum(one is not None for one in self._states)
        self._retry = retry
        self._size = -(-plan.count // _BLOCKS)
        self._left = {block: jobs for block in range(-(-plan.count // self._size))
                      if (jobs := self._waiting(block))}  # fmt: skip
        self._blocks = deque(self._left)
        self._queue: deque[Job] = deque()
        self._alone: deque[Job] = deque()  # cases in whose computation a worker has ended
        self._open: Counter[int] = Counter()  # cases of each claimed block that are not written
        self._deaths: Counter[int] = Counter()
        self._numbers = iter(range(10**9))
        self._each_s = 0.0
        self._rows = 0
        self._compute_s = 0.0

    def _waiting(self, block: int) -> list[int]:
        """Indices of a block that have to be computed."""
        first = block * self._size
        return [
            index for index in range(first, min(first + self._size, self._plan.count))
            if (state := self._states[index]) is None or (self._retry and state.failed)
        ]  # fmt: skip

    def finish(self, make: Callable[[Problem, int], Executor], begun: float) -> Progressed:
        waiting = sum(map(len, self._left.values()))
        self._progress.start(float(waiting))
        workers = 1
        running: tuple[Job, float] | None = None
        try:
            if waiting:
                executor = make(self._plan.problem, waiting)
                try:
                    self._work(executor)
                finally:
                    running = executor.longest()
                    workers = executor.workers
                    executor.close()
        except (DeviceError, KeyboardInterrupt) as stop:
            raise self._explained(stop, running) from None
        finally:
            self._progress.stop()
        return self._result(workers, time.monotonic() - begun)

    def _explained(
        self, stop: DeviceError | KeyboardInterrupt, running: tuple[Job, float] | None
    ) -> BaseException:
        """The error with a note of what is kept, and of a case that may never end."""
        done = f"{self._finished():,} of {self._plan.count:,} cases are finished and kept"
        note = f"{done}; the same command continues."
        if running is not None and running[1] > max(_LONG_S, _LONG_MULTIPLE * self._each_s):
            note += (
                f" Case {running[0].index} had been running for {running[1]:.0f} s; if cases may "
                "never end, set time_limit_s in the campaign file."
            )
        if isinstance(stop, KeyboardInterrupt):
            stop.add_note(note)
            return stop
        return type(stop)(f"{stop} {note}")

    def _finished(self) -> int:
        """Finished cases in the folder; a signal may come between writing and counting."""
        states = self._shards.states()
        return sum(case in states for case in self._hashes)

    def _result(self, workers: int, wall_s: float) -> Progressed:
        states = self._shards.states()
        found = [states.get(case) for case in self._hashes]
        done = sum(one is not None and not one.failed for one in found)
        failed = sum(one is not None and one.failed for one in found)
        return Progressed(
            len(found), done, failed, len(found) - done - failed, self._rows, workers, wall_s,
            self._compute_s, self._outdated,
        )  # fmt: skip

    def _work(self, executor: Executor) -> None:
        in_work = 0
        while True:
            while in_work < _AHEAD * executor.workers:
                jobs = self._next(executor.workers)
                if not jobs:
                    break
                executor.submit(Chunk(next(self._numbers), jobs))
                in_work += 1
            if not in_work:
                return
            for outcome in executor.wait(_WAIT_S):
                in_work -= 1
                self._take(outcome)

    def _next(self, workers: int) -> tuple[Job, ...]:
        """Cases of the next chunk; none: all are finished, in work, or another program's."""
        if self._alone:
            return (self._alone.popleft(),)
        wanted = self._chunk_size(workers)
        while len(self._queue) < wanted and self._blocks:
            block = self._blocks.popleft()
            if not self._claims.take(block):
                continue
            indices = self._still_waiting(block)
            if not indices:
                self._claims.release(block)
                continue
            self._open[block] = len(indices)
            self._queue.extend(map(self._job, indices))
        return tuple(self._queue.popleft() for _ in range(min(wanted, len(self._queue))))

    def _still_waiting(self, block: int) -> list[int]:
        """Indices of a block that no other program has finished since this one looked."""
        if news := self._shards.news():
            for index, case in enumerate(self._hashes):
                self._states[index] = news.get(case, self._states[index])
        return self._waiting(block)

    def _chunk_size(self, workers: int) -> int:
        """Cases that take 2 s or more; at the end less, so that all workers end together."""
        if self._each_s == 0.0:
            return 1
        left = len(self._queue) + sum(len(self._left[block]) for block in self._blocks)
        share = max(round(_LAST_CHUNK_S / self._each_s), left // (2 * _AHEAD * workers))
        wanted_s = max(_CHUNK_S, _CHUNK_S_FOR_EACH * workers)
        return max(1, min(round(wanted_s / self._each_s), share, _MOST_IN_CHUNK))

    def _job(self, index: int) -> Job:
        state = self._states[index]
        attempt = 1 if state is None else state.attempt + 1
        return self._plan.job(index, self._hashes[index], attempt)

    def _take(self, outcome: Outcome) -> None:
        """Write the rows of a chunk, and queue the cases without one again."""
        if outcome.rows is None:
            self._again(outcome)
            return
        computed = {row.index for row in outcome.rows}
        self._queue.extendleft(
            job for job in reversed(outcome.chunk.jobs) if job.index not in computed
        )
        if not outcome.rows:
            return
        self._write(outcome.rows)
        mean_s = sum(row.compute_s for row in outcome.rows) / len(outcome.rows)
        self._each_s = 0.7 * self._each_s + 0.3 * mean_s if self._each_s else mean_s
        self._each_s = max(self._each_s, 1e-6)

    def _again(self, outcome: Outcome) -> None:
        """Queue lost cases one by one, except those in whose computation workers always end."""
        if not outcome.blamed:
            self._queue.extendleft(reversed(outcome.chunk.jobs))
            return
        alone = len(outcome.chunk.jobs) == 1
        for job in outcome.chunk.jobs:
            self._deaths[job.index] += alone
            if self._deaths[job.index] < _MOST_DEATHS:
                self._alone.append(job)
                continue
            error = f"The worker ended {_MOST_DEATHS} times while it computed this case."
            self._write([CaseRow(job.case, job.index, dict(job.values), {}, error, error,
                                 job.attempt)])  # fmt: skip

    def _write(self, rows: Sequence[CaseRow]) -> None:
        self._shards.write(rows)
        self._rows += len(rows)
        self._compute_s += sum(row.compute_s for row in rows)
        for row in rows:
            block = row.index // self._size
            self._open[block] -= 1
            if self._open[block] == 0:
                self._claims.release(block)
        self._progress.advance(float(len(rows)), "cases")
