"""Jobs in processes of their own, so that code of another package cannot end the others.

A controller may end its process, start threads, change a module or print. A worker therefore plays
each job in a copy of itself (`fork`), which ends with the job. Where the system has no `fork`, the
worker does the job itself, and is replaced if it ends.
"""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import os
import pickle
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from haselab.base import DeviceError
from haselab.runtime.scheduling import one_thread

__all__ = ["Lost", "Workers", "announce_limit"]

Item = TypeVar("Item")
Result = TypeVar("Result")
Message = tuple[str, Any]  # "result", "error", "lost" or "limit", and what belongs to it
_POLL_S = 0.2  # to find that a copy has ended, whose threads or copies keep its pipe open
_EXIT_S = 0.01  # between the end of its pipe and that of a process
_END_S = 5.0
_TRIES = 2  # of a job whose process ends: memory may have been short, or a person may have ended it
_COPIES = sys.platform == "linux"
_TOO_LONG = "\0"  # before a reason: another try would take as long
_limits: list[Callable[[float, str], None]] = []  # where the process of a job announces its limit


@dataclass(frozen=True)
class Lost:
    """A job without a result.

    Args:
        reason: how its process ended.
    """

    reason: str


def announce_limit(longest_s: float, reason: str) -> None:
    """State how long this process may take from now on; after that it is killed.

    It stops code that catches every exception, or that keeps Python's interpreter lock. Without
    workers it has no effect.

    Args:
        longest_s: wall time.
        reason: of `Lost`.
    """
    for announce in _limits:
        announce(longest_s, reason)


class Workers:
    """Processes that do jobs until `close`.

    Args:
        count: number of processes.
    """

    def __init__(self, count: int) -> None:
        self._workers = [_Worker() for _ in range(count)]

    def each(
        self, job: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | Lost]]:
        """Do a job with each item.

        Args:
            job: of a module, not of a class or a function.
            items: that pickle supports.
        Returns:
            Places of the items and results, in the order in which they are done.
        Raises:
            DeviceError: The processes end at their start.
            Exception: Whatever the job raises.
        """
        waiting = [(place, 1) for place in range(len(items))][::-1]
        while True:
            for worker in self._workers:
                if waiting and worker.given is None:
                    worker.give(waiting.pop(), job, items)
            busy = {worker.pipe: worker for worker in self._workers if worker.given is not None}
            if not busy:
                return
            for pipe in wait(list(busy)):
                worker = busy[pipe]  # type: ignore[index]
                place, tries = worker.given or (0, 0)
                what, value = worker.answer()
                if what == "error":
                    raise value
                if what == "result":
                    yield place, value
                elif tries < _TRIES and not value.startswith(_TOO_LONG):
                    waiting.append((place, tries + 1))
                else:
                    yield place, Lost(value.removeprefix(_TOO_LONG))

    def close(self) -> None:
        """End the processes, and what they are doing."""
        for worker in self._workers:
            worker.pipe.close()
        for worker in self._workers:
            worker.end()


class _Worker:
    """One process, and the place and number of tries of its item."""

    def __init__(self) -> None:
        self.given: tuple[int, int] | None = None
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other,), daemon=True)
        with one_thread():
            self._process.start()
        other.close()
        try:
            self.pipe.recv()
        except EOFError:
            self._process.join()
            raise DeviceError(
                f"A process has ended at its start with exit code {self._process.exitcode}. Check "
                "the memory of the computer, or use fewer workers."
            ) from None

    def give(
        self, given: tuple[int, int], job: Callable[[Any], object], items: Sequence[object]
    ) -> None:
        """Give it an item."""
        self.given = given
        with contextlib.suppress(OSError):  # it has just ended, which `answer` finds
            self.pipe.send((job, items[given[0]]))

    def answer(self) -> Message:
        """What it has sent; a process that has ended is replaced."""
        self.given = None
        try:
            message: Message = self.pipe.recv()
        except (EOFError, OSError):
            self.end()
            reason = _ended(-(self._process.exitcode or 0))
            self._start()
            return "lost", reason
        return message

    def end(self) -> None:
        """Wait for its end."""
        self.pipe.close()
        self._process.join(_END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _ended(number: int) -> str:
    """How a process has ended, from minus its exit code or the number of a signal."""
    if number > 0:
        with contextlib.suppress(ValueError):
            return f"its process was ended by {signal.Signals(number).name}"
    return f"its process ended with exit code {-number}"


# ---- in the worker -------------------------------------------------------------------------------


def _serve(pipe: Connection) -> None:
    """Do the jobs that come through the pipe until its other end closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the program that started this one
    os.dup2(2, 1)  # a controller must not print between the program's answers
    pipe.send(None)
    while True:
        try:
            job, item = pipe.recv()
        except (EOFError, OSError):
            os._exit(0)  # without waiting for a controller's threads
        answer = _in_copy(pipe, job, item) if _COPIES else _done(job, item)
        try:
            pipe.send(answer)
        except OSError:
            os._exit(0)


def _done(job: Callable[[Any], object], item: object) -> Message:
    try:
        return "result", job(item)
    except Exception as error:
        error.add_note(traceback.format_exc())
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:  # an error of another package may not survive
            return "error", RuntimeError(traceback.format_exc())
        return "error", error


def _in_copy(pipe: Connection, job: Callable[[Any], object], item: object) -> Message:
    """Do a job in a copy of this process; nothing of it is left afterwards."""
    here, there = multiprocessing.Pipe(duplex=False)
    sys.stdout.flush()
    sys.stderr.flush()
    copy = os.fork()
    if copy == 0:
        here.close()
        pipe.close()  # so that the program notices when its worker ends
        _be_copy(there, job, item)
    there.close()
    with contextlib.suppress(OSError):
        os.setpgid(copy, copy)
    try:
        return _answer_of(copy, here, pipe)
    finally:
        _end_group(copy)
        here.close()


def _be_copy(there: Connection, job: Callable[[Any], object], item: object) -> None:
    """Do the job, send the answer, and end."""
    with contextlib.suppress(OSError):
        os.setpgid(0, 0)  # so that what a controller starts can be ended with it
    own = os.getpid()
    _limits.append(lambda longest_s, reason: there.send(("limit", (longest_s, reason))))
    try:
        answer = _done(job, item)
        if os.getpid() == own:  # a controller may have copied the process, too
            there.send(answer)
    finally:
        os._exit(0)


def _answer_of(copy: int, here: Connection, pipe: Connection) -> Message:
    """Wait for the answer, the end or the limit of a copy."""
    until_s, late = math.inf, ""
    while True:
        if pipe in wait([here, pipe], _POLL_S):  # during a job only the end of the program
            _end_group(copy)
            os._exit(0)
        ended, status = os.waitpid(copy, os.WNOHANG)
        while here.poll():
            try:
                message: Message = here.recv()
            except (EOFError, OSError, pickle.UnpicklingError):
                time.sleep(_EXIT_S)
                break
            if message[0] != "limit":
                return message
            until_s, late = time.monotonic() + message[1][0], message[1][1]
        if ended:
            return "lost", _ended(-os.waitstatus_to_exitcode(status))
        if time.monotonic() > until_s:
            return "lost", _TOO_LONG + late


def _end_group(copy: int) -> None:
    """End a copy and all that it has started."""
    with contextlib.suppress(OSError):
        os.killpg(copy, signal.SIGKILL)
    with contextlib.suppress(OSError):
        os.kill(copy, signal.SIGKILL)
    with contextlib.suppress(OSError):  # it may have been waited for
        os.waitpid(copy, 0)
