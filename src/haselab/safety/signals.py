"""End an armed bench at 0 V, read back, after SIGTERM, SIGHUP or Ctrl-C."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any

from haselab.base.exits import SignalExit

__all__ = ["OrderlyEnd"]

_NAMES = ("SIGTERM", "SIGHUP", "SIGINT")  # Windows has no SIGHUP
_DEFAULT = (signal.SIG_DFL, signal.default_int_handler)
_waiting: list[int] = []  # signals that arrived while the end of a block ran


class OrderlyEnd:
    """A context in which a signal that would kill the program ends the `with` block instead.

    SIGTERM and SIGHUP raise `SignalExit` with 128 plus their number in the running code, Ctrl-C
    raises `KeyboardInterrupt` as usual. A signal that arrives after `__exit__` was called is raised
    at its end, so that nothing interrupts or skips the shutdown to 0 V. Only signals with their
    default action are handled, and that action is restored: a program with its own handlers keeps
    them, and one that ignores a signal (nohup) continues to ignore it. In a thread other than the
    main one nothing is handled, since signals do not arrive there.

    Args:
        end: called once at the end of the block with its error, or None.
    """

    def __init__(self, end: Callable[[BaseException | None], None]) -> None:
        self._end = end
        self._former: dict[int, Any] = {}
        self._over = True

    def __enter__(self) -> Any:
        try:
            if threading.current_thread() is threading.main_thread():
                for number in (getattr(signal, name, None) for name in _NAMES):
                    if number is not None:
                        self._take(number)
            self._over = False
        except BaseException:
            self._restore()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self._end(error)
        finally:
            self._restore()
        if _waiting and not _is_ending(sys._getframe(1)):
            number = _waiting[0]
            _waiting.clear()
            raise _stop(number)

    def _take(self, number: int) -> None:
        former = signal.getsignal(number)
        left = getattr(former, "__self__", None)
        if isinstance(left, OrderlyEnd) and left._over:  # interrupted while restoring the handlers
            former = left._former[number]
        if former in _DEFAULT:
            self._former[number] = former
            signal.signal(number, self._received)

    def _restore(self) -> None:
        self._over = True
        for number, former in self._former.items():
            if signal.getsignal(number) == self._received:
                signal.signal(number, former)

    def _received(self, number: int, frame: FrameType | None) -> None:
        if self._over or not _is_ending(frame):
            raise _stop(number)
        _waiting.append(number)


def _is_ending(frame: FrameType | None) -> bool:
    """Whether the end of a block runs in this frame or one of its callers.

    The frames show it from the first instruction of `__exit__` on. A flag would be set too late for
    a signal that arrives at that moment, and the shutdown to 0 V would be skipped.
    """
    while frame is not None:
        if frame.f_code is OrderlyEnd.__exit__.__code__:
            return True
        frame = frame.f_back
    return False


def _stop(number: int) -> BaseException:
    return KeyboardInterrupt() if number == signal.SIGINT else SignalExit(128 + number)
