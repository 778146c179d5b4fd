"""Interrupt a call into code of another package that does not return."""

from __future__ import annotations

import signal
import sys
import threading
from types import FrameType, TracebackType
from typing import Any, Self

from haselab.base.exits import TooLongError

__all__ = ["CallLimit"]


class CallLimit:
    """A context in which one call may take a limited time; then it raises `TooLongError` there.

    A timer's signal interrupts waits and loops in Python. If the code catches the error and goes
    on, the timer interrupts it again, each time after `limit_s`. Compiled code that never returns
    to Python cannot be interrupted. There is no limit in threads other than the main one, which
    alone gets signals, on Windows, which has no such timer, and in a program that uses the timer
    itself.

    Args:
        limit_s: longest time, in s; None: there is no limit.
    """

    def __init__(self, limit_s: float | None) -> None:
        self._limit_s = limit_s
        self._previous: Any = None
        self._running = False
        self._caller: FrameType | None = None

    def __enter__(self) -> Self:
        if self._limit_s is not None and _is_free():
            self._caller = sys._getframe(1)
            self._previous = signal.signal(signal.SIGALRM, self._expired)
            self._running = True
            signal.setitimer(signal.ITIMER_REAL, self._limit_s, self._limit_s)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._running:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            self._running, self._caller = False, None
            signal.signal(signal.SIGALRM, self._previous)

    def _expired(self, number: int, frame: FrameType | None) -> None:
        if frame is not None and frame.f_code in _OWN:  # raised there, the timer would stay on
            return
        while frame is not None and frame is not self._caller:
            frame = frame.f_back
        if frame is None:  # another signal has ended the context before its exit
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            return
        raise TooLongError(f"it took longer than {self._limit_s:g} s")


_OWN = {CallLimit.__enter__.__code__, CallLimit.__exit__.__code__}


def _is_free() -> bool:
    """Whether the timer can be used here, and nothing else uses it."""
    return (
        hasattr(signal, "setitimer")
        and threading.current_thread() is threading.main_thread()
        and signal.getsignal(signal.SIGALRM) is signal.SIG_DFL
        and signal.getitimer(signal.ITIMER_REAL)[0] == 0.0
    )
