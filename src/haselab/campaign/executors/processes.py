"""Compute cases in processes of this computer, each with one thread for linear algebra.

Each process has a pipe of its own, so if one is killed, only its own chunks are lost, and it is
known which one it was computing.
"""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import os
import queue
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait

from haselab.base import DeviceError, HaselabError
from haselab.campaign.executors.executor import Chunk, Outcome
from haselab.campaign.plan import Job, Problem
from haselab.runtime.scheduling import one_thread
from haselab.store.campaign.shards import CaseRow

__all__ = ["ProcessExecutor"]

_MOST_STARTS = 5  # in a row without one that became ready
_END_S = 2.0
_CHECKS = 8  # of the running cases, per time limit
_ORPHAN_S = 10.0  # beyond the time limit: then a process whose parent was killed ends by itself


@dataclass(frozen=True)
class _Running:
    """The case that a process computes.

    Args:
        chunk: number of the chunk that it belongs to.
        place: index of the case in the chunk.
        since_s: when it began, on the monotonic clock of the computer.
    """

    chunk: int
    place: int
    since_s: float


class _Stamp:
    """Memory that a process shares with its parent, in which it notes the case it computes."""

    def __init__(self) -> None:
        self._numbers = multiprocessing.get_context("spawn").RawArray("d", 3)

    def begin(self, chunk: int, place: int) -> None:
        """Note the case that begins now."""
        self._numbers[2] = 0.0  # so that no reader takes a mixture of the old and the new case
        self._numbers[0], self._numbers[1] = float(chunk), float(place)
        self._numbers[2] = time.monotonic()

    def end(self) -> None:
        """Note that nothing is computed."""
        self._numbers[2] = 0.0

    def read(self) -> _Running | None:
        """The running case; None: there is none, or it is just changing."""
        since_s = self._numbers[2]
        chunk, place = int(self._numbers[0]), int(self._numbers[1])
        return _Running(chunk, place, since_s) if since_s == self._numbers[2] != 0.0 else None


class _Worker:
    """One process, and what it was given."""

    def __init__(self, problem: Problem, limit_s: float | None) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self.stamp = _Stamp()
        self.process = context.Process(
            target=_serve, args=(other, problem, self.stamp, limit_s), daemon=True
        )
        with one_thread():
            self.process.start()
        other.close()
        self.is_ready = False
        self.given: dict[int, Chunk] = {}


class ProcessExecutor:
    """An executor of processes.

    Args:
        problem: what all cases share.
        workers: number of processes.
        limit_s: time of a case, after which its process is killed; None: no limit.
    """

    def __init__(self, problem: Problem, workers: int, limit_s: float | None = None) -> None:
        self._problem, self._count, self._limit_s = problem, workers, limit_s
        self._workers = [_Worker(problem, limit_s) for _ in range(workers)]
        self._vain = 0

    @property
    def workers(self) -> int:
        """Number of processes."""
        return self._count

    def submit(self, chunk: Chunk) -> None:
        """Queue a chunk at the process that has the fewest."""
        worker = min(self._workers, key=lambda one: len(one.given))
        worker.given[chunk.number] = chunk
        with contextlib.suppress(OSError):  # it has just ended, which `wait` finds
            worker.pipe.send((chunk.number, chunk.jobs))

    def wait(self, longest_s: float) -> list[Outcome]:
        """Wait for outcomes, and replace processes that have ended or whose case takes too long.

        Raises:
            DeviceError: the processes end at their start, or one cannot compute any case.
        """
        if self._limit_s is not None:
            longest_s = min(longest_s, self._limit_s / _CHECKS)
        ready = wait([worker.pipe for worker in self._workers], longest_s)
        found: list[Outcome] = []
        for place, worker in enumerate(self._workers):
            if worker.pipe in ready:
                outcomes = self._received(worker)
                if outcomes is None:
                    found += self._replaced(place)
                else:
                    found += outcomes
            elif running := self._late_case(worker):
                found += self._ended_late(place, running)
        return found

    def longest(self) -> tuple[Job, float] | None:
        """The case that has been running for the longest time, and this time in s; None: none."""
        found = [
            (chunk.jobs[running.place], time.monotonic() - running.since_s)
            for worker in self._workers
            if (running := worker.stamp.read()) and (chunk := worker.given.get(running.chunk))
        ]
        return max(found, key=lambda each: each[1], default=None)

    def _late_case(self, worker: _Worker) -> _Running | None:
        """The running case of a process if it has exceeded the time limit."""
        running = worker.stamp.read()
        if running is None or self._limit_s is None:
            return None
        return running if time.monotonic() - running.since_s > self._limit_s else None

    def _ended_late(self, place: int, running: _Running) -> list[Outcome]:
        """Kill a process and start another; the case that it was computing fails."""
        worker = self._workers[place]
        spent_s = time.monotonic() - running.since_s
        worker.process.kill()
        worker.process.join()
        found = self._received(worker) or []  # chunks that ended before the kill
        # A case that ended just before the kill has not failed: its chunk is computed again.
        still_ran = worker.stamp.read() == running
        if still_ran and (chunk := worker.given.pop(running.chunk, None)):
            found.append(Outcome(chunk, [_late(chunk.jobs[running.place], self._limit_s, spent_s)]))
        waiting = [Outcome(chunk, []) for chunk in worker.given.values()]
        worker.pipe.close()
        self._workers[place] = _Worker(self._problem, self._limit_s)
        return [*found, *waiting]

    def _received(self, worker: _Worker) -> list[Outcome] | None:
        """What a process has sent; None: it has ended."""
        found, refusal = [], None
        try:
            while refusal is None and worker.pipe.poll():
                number, message = worker.pipe.recv()
                if isinstance(message, HaselabError):
                    refusal = message
                elif number is None:
                    worker.is_ready, self._vain = True, 0
                else:
                    found.append(Outcome(worker.given.pop(number), message))
        except (EOFError, OSError):
            return found or None  # what it sent before it ended; its end is found again
        if refusal is not None:
            raise refusal
        return found

    def _replaced(self, place: int) -> list[Outcome]:
        """Start a process in place of one that has ended; its chunks are lost."""
        worker = self._workers[place]
        worker.process.join()
        worker.pipe.close()
        if not worker.is_ready:
            self._vain += 1
            if self._vain >= _MOST_STARTS:
                raise DeviceError(
                    f"{_MOST_STARTS} processes have ended at their start, the last one with exit "
                    f"code {worker.process.exitcode}. Check the memory of the computer, or use "
                    "fewer workers."
                )
        self._workers[place] = _Worker(self._problem, self._limit_s)
        first = itertools.chain([worker.is_ready], itertools.repeat(False))
        return [
            Outcome(chunk, None, blamed)
            for chunk, blamed in zip(worker.given.values(), first, strict=False)
        ]

    def close(self) -> None:
        """End all processes."""
        for worker in self._workers:
            worker.process.kill()
        for worker in self._workers:
            worker.process.join(_END_S)
            worker.pipe.close()


def _late(job: Job, limit_s: float | None, spent_s: float) -> CaseRow:
    error = (
        f"The case was stopped because it took longer than time_limit_s = {limit_s:g}. Raise the "
        "limit in the campaign file and add --retry-failed, or find out why the case takes so long."
    )
    return CaseRow(job.case, job.index, dict(job.values), {}, error, error, job.attempt, spent_s)


# ---- in the process ----------------------------------------------------------------------------


def _serve(pipe: Connection, problem: Problem, stamp: _Stamp, limit_s: float | None) -> None:
    """Compute what comes through the pipe until its other end closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the program that started this one
    os.dup2(2, 1)  # a case must not print between the program's answers
    from haselab.campaign.work import compute_cases

    coming: queue.SimpleQueue[tuple[int, tuple[Job, ...]]] = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(pipe, coming), daemon=True).start()
    pipe.send((None, None))
    while True:
        number, jobs = coming.get()
        try:
            rows: object = compute_cases(problem, _stamped(number, jobs, stamp, limit_s))
        except HaselabError as error:
            rows = error
        stamp.end()
        try:
            pipe.send((number, rows))
        except OSError:
            os._exit(0)


def _stamped(
    number: int, jobs: Sequence[Job], stamp: _Stamp, limit_s: float | None
) -> Iterator[Job]:
    """The cases of a chunk one by one, each with a stamp when it begins."""
    for place, job in enumerate(jobs):
        stamp.begin(number, place)
        if limit_s is not None and hasattr(signal, "setitimer"):
            # The parent kills a case that takes too long. If the parent was killed itself, a case
            # that hangs in compiled code may keep `_receive` from ending this process.
            signal.setitimer(signal.ITIMER_REAL, limit_s + _ORPHAN_S)
        yield job
    if limit_s is not None and hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def _receive(pipe: Connection, coming: queue.SimpleQueue[tuple[int, tuple[Job, ...]]]) -> None:
    """Take chunks at once, so that their sender never waits; end with the program that sends."""
    while True:
        try:
            coming.put(pipe.recv())
        except (EOFError, OSError):
            os._exit(0)
