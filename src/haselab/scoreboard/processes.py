"""Jobs in processes of their own, so that the code of one package cannot end the jobs of others.

A controller may end its process, start threads, change a module or print. On Linux, a worker
therefore forks a child process for each job, which ends with the job. On other systems, the worker
does the job itself, and is replaced if it ends.
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

from haselab.base import DeviceError, described
from haselab.base.exits import no_exit
from haselab.runtime.scheduling import one_thread

__all__ = ["Lost", "Workers", "announce_limit"]

Item = TypeVar("Item")
Result = TypeVar("Result")
# What it is and its value: "result", "error", "limit", "lost" (another try may help), "failed".
Message = tuple[str, Any]
_POLL_S = 0.2  # between checks of a child that has ended while its own children keep its pipe open
_EXIT_S = 0.01  # a process may end a little later than its pipe
_END_S = 5.0  # for a worker to end by itself, before it is killed
_TRIES = 2  # of a job whose process ends: it may have been killed for another reason
_FORKS = sys.platform == "linux"
_limits: list[Callable[[float, str], None]] = []  # where the process of a job announces its limit


@dataclass(frozen=True)
class Lost:
    """A job without a result.

    Args:
        reason: how its process ended.
    """

    reason: str


def announce_limit(longest_s: float, reason: str) -> None:
    """State how long this process may take from now on; then its worker kills it.

    This also ends code that catches every exception or keeps Python's interpreter lock. It has no
    effect outside a forked child process.

    Args:
        longest_s: wall time, in s.
        reason: for `Lost`.
    """
    for announce in _limits:
        announce(longest_s, reason)


class Workers:
    """Processes that do jobs until `close`.

    Args:
        count: number of processes.
    """

    def __init__(self, count: int) -> None:
        self._workers: list[_Worker] = []
        try:
            for _ in range(count):
                self._workers.append(_Worker())
        except BaseException:  # also Ctrl-C
            self.close()
            raise

    def each(
        self, job: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | Lost]]:
        """Do a job with each item.

        Args:
            job: a function at the top level of a module, which pickle supports.
            items: arguments of the job, which pickle supports.
        Yields:
            The index of an item and its result, in the order in which the results arrive.
        Raises:
            DeviceError: The processes end at their start.
            Exception: Whatever the job raises.
        """
        waiting = [(index, 1) for index in range(len(items))][::-1]
        while True:
            for worker in self._workers:
                if waiting and worker.given is None:
                    worker.give(waiting.pop(), job, items)
            busy = {worker.pipe: worker for worker in self._workers if worker.given is not None}
            if not busy:
                return
            for pipe in wait(list(busy)):
                worker = busy[pipe]  # type: ignore[index]
                index, tries = worker.given or (0, 0)
                what, value = worker.answer()
                if what == "error":
                    raise value
                if what == "result":
                    yield index, value
                elif what == "lost" and tries < _TRIES:
                    waiting.append((index, tries + 1))
                else:
                    yield index, Lost(value)

    def close(self) -> None:
        """End the processes and their jobs."""
        for worker in self._workers:
            worker.pipe.close()
        for worker in self._workers:
            worker.end()


class _Worker:
    """One process, with the index of its item and the number of tries."""

    def __init__(self) -> None:
        self.given: tuple[int, int] | None = None
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        # A daemon could not have children, which a controller may start with multiprocessing.
        self._process = context.Process(target=_serve, args=(other,))
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
        """Send an item to the process."""
        self.given = given
        with contextlib.suppress(OSError):  # if it has just ended, `answer` reports it
            self.pipe.send((job, items[given[0]]))

    def answer(self) -> Message:
        """Receive the answer of the process; replace the process if it has ended."""
        self.given = None
        try:
            message: Message = self.pipe.recv()
        except (EOFError, OSError):
            self.end()
            reason = _exit_reason(self._process.exitcode or 0)
            self._start()
            return "lost", reason
        return message

    def end(self) -> None:
        """Wait for the end of the process; kill it if it does not end."""
        self.pipe.close()
        self._process.join(_END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _exit_reason(code: int) -> str:
    """Say how a process has ended; a negative exit code is the number of a signal."""
    if code < 0:
        with contextlib.suppress(ValueError):
            return f"its process was ended by {signal.Signals(-code).name}"
    return f"its process ended with exit code {code}"


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
        answer = _in_child(pipe, job, item) if _FORKS else _done(job, item)
        try:
            pipe.send(answer)
        except OSError:
            os._exit(0)


def _done(job: Callable[[Any], object], item: object) -> Message:
    """Do a job; return its result or its exception."""
    try:
        with no_exit():
            return "result", job(item)
    except Exception as error:
        error.add_note(traceback.format_exc())
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:  # pickle does not support every exception of other packages
            return "error", RuntimeError(traceback.format_exc())
        return "error", error


def _in_child(pipe: Connection, job: Callable[[Any], object], item: object) -> Message:
    """Do a job in a child process, and end it with all processes of its group."""
    receiver, sender = multiprocessing.Pipe(duplex=False)
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child == 0:
        receiver.close()
        pipe.close()  # so that the program notices when its worker ends
        _run_child(sender, job, item)
    sender.close()
    with contextlib.suppress(OSError):
        os.setpgid(child, child)
    try:
        return _answer_of(child, receiver, pipe)
    finally:
        _end_group(child)
        receiver.close()


def _run_child(sender: Connection, job: Callable[[Any], object], item: object) -> None:
    """Do the job, send the answer, and end this process."""
    with contextlib.suppress(OSError):
        os.setpgid(0, 0)  # so that what a controller starts can be ended with it
    own = os.getpid()
    _limits.append(lambda longest_s, reason: sender.send(("limit", (longest_s, reason))))
    try:
        answer = _done(job, item)
        if os.getpid() == own:  # a controller may have forked, too
            _send(sender, answer)
    finally:
        os._exit(0)


def _send(sender: Connection, answer: Message) -> None:
    """Send an answer; say so if pickle does not support the result."""
    try:
        sender.send(answer)
    except OSError:
        raise
    except Exception as error:
        sender.send(("failed", f"its result cannot be sent: {described(error)}"))


def _answer_of(child: int, receiver: Connection, pipe: Connection) -> Message:
    """Wait for the answer, the end or the limit of a child process."""
    until_s, late = math.inf, ""
    while True:
        if pipe in wait([receiver, pipe], _POLL_S):  # the program has ended: it sends nothing now
            _end_group(child)
            os._exit(0)
        # The child stays a zombie, so that its number is not used for another process.
        ended = os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT)
        while receiver.poll():
            try:
                message: Message = receiver.recv()
            except (EOFError, OSError, pickle.UnpicklingError):
                time.sleep(_EXIT_S)
                break
            if message[0] != "limit":
                return message
            until_s, late = time.monotonic() + message[1][0], message[1][1]
        if ended:
            exited = ended.si_code == os.CLD_EXITED
            return "lost", _exit_reason(ended.si_status if exited else -ended.si_status)
        if time.monotonic() > until_s:
            return "failed", late  # another try would take as long


def _end_group(child: int) -> None:
    """Kill a child process and the processes of its group, and wait for the child."""
    with contextlib.suppress(OSError):
        os.killpg(child, signal.SIGKILL)
    with contextlib.suppress(OSError):
        os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
