"""Ctrl-C, SIGTERM and a closed terminal end a run once, and are not lost."""

from __future__ import annotations

import os
import signal
import stat
import sys
from types import FrameType

from haselab.base import Progress

__all__ = ["Interruptible"]


def _leave_terminal() -> None:
    """A closed terminal takes no words: writing to it would be an error in mid-clean-up."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        # A terminal that is gone is no terminal either; a file or a pipe still takes words.
        if stat.S_ISCHR(os.fstat(stream).st_mode):
            os.dup2(nowhere, stream)
    os.close(nowhere)


class Interruptible:
    """A progress listener that ends the job when a signal has asked for it.

    The first signal raises `KeyboardInterrupt` where the program stands. Python drops an exception
    that comes up inside a finaliser and tells of it on stderr, so the wish is also kept and raised
    again at the next step, and not told; later signals leave the clean-up alone.

    Args:
        progress: who is told.
    """

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._asked = False
        self._ended = False
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)  # Windows has no SIGHUP
            if number is not None and signal.getsignal(number) is not signal.SIG_IGN:  # nohup
                signal.signal(number, self._ask)
        self._unraisable = sys.unraisablehook
        sys.unraisablehook = self._dropped

    def _dropped(self, what: sys.UnraisableHookArgs) -> None:
        if not (self._asked and issubclass(what.exc_type, KeyboardInterrupt)):
            self._unraisable(what)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        first, self._asked = not self._asked, True
        if number == getattr(signal, "SIGHUP", None):
            _leave_terminal()
        if first:
            raise KeyboardInterrupt

    def start(self, total: float) -> None:
        """A job of `total` units of work begins."""
        self._progress.start(total)

    def advance(self, amount: float, what: str) -> None:
        """Tell it on, or end here when a signal has asked for it."""
        if self._asked and not self._ended:
            raise KeyboardInterrupt
        self._progress.advance(amount, what)

    def stop(self) -> None:
        """The job is over, done or not."""
        self._ended = True
        self._progress.stop()
