"""End a run on Ctrl-C, SIGTERM or a closed terminal: once, and without losing the signal."""

from __future__ import annotations

import os
import signal
import stat
import sys
from types import FrameType

from haselab.base import Progress

__all__ = ["Interruptible"]


def _leave_terminal() -> None:
    """Discard output to a closed terminal: writing to it would fail during the clean-up."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        # isatty is false for a closed terminal; a file or a pipe can still be written to.
        if stat.S_ISCHR(os.fstat(stream).st_mode):
            os.dup2(nowhere, stream)
    os.close(nowhere)


class Interruptible:
    """A progress listener that ends the job after a signal.

    The first signal raises `KeyboardInterrupt` wherever the program is. Python drops an exception
    that is raised inside a finaliser and prints it on stderr. The signal is therefore also kept and
    raised again at the next step, and the print is suppressed. Later signals do not interrupt the
    clean-up.

    Args:
        progress: the listener to forward to.
    """

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._signalled = False
        self._ended = False
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)  # Windows has no SIGHUP
            if number is not None and signal.getsignal(number) is not signal.SIG_IGN:  # nohup
                signal.signal(number, self._ask)
        self._unraisable = sys.unraisablehook
        sys.unraisablehook = self._dropped

    def _dropped(self, what: sys.UnraisableHookArgs) -> None:
        if not (self._signalled and issubclass(what.exc_type, KeyboardInterrupt)):
            self._unraisable(what)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        first, self._signalled = not self._signalled, True
        if number == getattr(signal, "SIGHUP", None):
            _leave_terminal()
        if first:
            raise KeyboardInterrupt

    def start(self, total: float) -> None:
        """Start a job of `total` units of work."""
        self._progress.start(total)

    def advance(self, amount: float, what: str) -> None:
        """Forward the progress, or end the job after a signal."""
        if self._signalled and not self._ended:
            raise KeyboardInterrupt
        self._progress.advance(amount, what)

    def stop(self) -> None:
        """End the job, finished or not."""
        self._ended = True
        self._progress.stop()
