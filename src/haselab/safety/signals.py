"""SIGTERM, SIGHUP and Ctrl-C end an armed bench in order: at 0 V, and read back."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any

__all__ = ["OrderlyEnd"]

_NAMES = ("SIGTERM", "SIGHUP", "SIGINT")  # Windows has no SIGHUP
_DEFAULT = (signal.SIG_DFL, signal.default_int_handler)
_waiting: list[int] = []  # signals that arrived while the end of a block ran


class OrderlyEnd:
    """While it is entered, a signal that would kill the program ends the `with` block instead.

    SIGTERM and SIGHUP raise `SystemExit` with 128 plus their number where the program stands,
    Ctrl-C raises `KeyboardInterrupt` as usual. A signal that arrives once `__exit__` has been
    called is raised at its end, so that nothing interrupts or leaves out the way to 0 V. Only
    signals whose action is the default one are taken, and the former action is restored: a program
    with handlers of its own keeps them, one that ignores a signal (nohup) goes on ignoring it. In a
    thread other than the main one nothing is taken, since signals do not arrive there.

    Args:
        end: called once at the end of the block with its error, None without one.
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
        if isinstance(left, OrderlyEnd) and left._over:  # it was interrupted while it restored
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

    The frames say it from the first instruction of `__exit__` on. A flag would be set too late for
    a signal that arrives just then: the way to 0 V would be left out.
    """
    while frame is not None:
        if frame.f_code is OrderlyEnd.__exit__.__code__:
            return True
        frame = frame.f_back
    return False


def _stop(number: int) -> BaseException:
    return KeyboardInterrupt() if number == signal.SIGINT else SystemExit(128 + number)
