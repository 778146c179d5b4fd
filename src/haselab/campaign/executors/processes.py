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
from multiprocessing.connection import Connection, wait

from haselab.base import DeviceError, HaselabError
from haselab.campaign.executors.executor import Chunk, Outcome
from haselab.campaign.plan import Problem
from haselab.runtime.scheduling import one_thread

__all__ = ["ProcessExecutor"]

_MOST_STARTS = 5  # in a row without one that became ready
_END_S = 2.0


class _Worker:
    """One process, and what it was given."""

    def __init__(self, problem: Problem) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self.process = context.Process(target=_serve, args=(other, problem), daemon=True)
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
    """

    def __init__(self, problem: Problem, workers: int) -> None:
        self._problem, self._count = problem, workers
        self._workers = [_Worker(problem) for _ in range(workers)]
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
        """Wait for outcomes, and replace processes that have ended.

        Raises:
            DeviceError: the processes end at their start, or one cannot compute any case.
        """
        ready = wait([worker.pipe for worker in self._workers], longest_s)
        found: list[Outcome] = []
        for place, worker in enumerate(self._workers):
            if worker.pipe in ready:
                outcomes = self._received(worker)
                if outcomes is None:
                    found += self._replaced(place)
                else:
                    found += outcomes
        return found

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
        self._workers[place] = _Worker(self._problem)
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


# ---- in the process ----------------------------------------------------------------------------


def _serve(pipe: Connection, problem: Problem) -> None:
    """Compute what comes through the pipe until its other end closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the program that started this one
    os.dup2(2, 1)  # a case must not print between the program's answers
    from haselab.campaign.work import compute_cases

    coming: queue.SimpleQueue[tuple[int, tuple[object, ...]]] = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(pipe, coming), daemon=True).start()
    pipe.send((None, None))
    while True:
        number, jobs = coming.get()
        try:
            rows: object = compute_cases(problem, jobs)  # type: ignore[arg-type]
        except HaselabError as error:
            rows = error
        try:
            pipe.send((number, rows))
        except OSError:
            os._exit(0)


def _receive(pipe: Connection, coming: queue.SimpleQueue[tuple[int, tuple[object, ...]]]) -> None:
    """Take chunks at once, so that their sender never waits; end with the program that sends."""
    while True:
        try:
            coming.put(pipe.recv())
        except (EOFError, OSError):
            os._exit(0)
