"""SIGTERM, SIGHUP and Ctrl-C end an armed bench in order: at 0 V, and read back."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any, Self

__all__ = ["OrderlyEnd"]

_NAMES = ("SIGTERM", "SIGHUP", "SIGINT")  # Windows has no SIGHUP


class OrderlyEnd:
    """While it is entered, a signal that would kill the program ends the `with` block instead.

    SIGTERM and SIGHUP raise `SystemExit` with 128 plus their number where the program stands,
    Ctrl-C raises `KeyboardInterrupt` as usual. A signal that comes during `finishing` is raised
    after it, so that nothing interrupts the way to 0 V. Only signals whose action is the default
    one are taken, and the former action is restored: a program with handlers of its own keeps
    them, one that ignores a signal (nohup) goes on ignoring it. In a thread other than the main
    one nothing is taken, since signals do not arrive there.
    """

    def __init__(self) -> None:
        self._former: dict[int, Any] = {}
        self._finishing = False
        self._kept: int | None = None

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in (getattr(signal, name, None) for name in _NAMES):
                if number is None:
                    continue
                former = signal.getsignal(number)
                if former in (signal.SIG_DFL, signal.default_int_handler):
                    self._former[number] = former
                    signal.signal(number, self._received)
        return self

    def __exit__(self, *_: object) -> None:
        for number, former in self._former.items():
            signal.signal(number, former)
        self._former.clear()

    def _received(self, number: int, frame: FrameType | None) -> None:
        if not self._finishing:
            raise self._stop(number)
        self._kept = number

    @staticmethod
    def _stop(number: int) -> BaseException:
        return KeyboardInterrupt() if number == signal.SIGINT else SystemExit(128 + number)

    @contextlib.contextmanager
    def finishing(self) -> Iterator[None]:
        """The way to 0 V: a signal that arrives on it is raised at its end."""
        self._finishing = True
        try:
            yield
        finally:
            self._finishing = False
        kept, self._kept = self._kept, None
        if kept is not None:
            raise self._stop(kept)
