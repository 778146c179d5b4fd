"""Looks at an NI device on USB while nobody reads.

A USB device that is asked too rarely stops sending, though no buffer has overflowed
(nidaqmx-python, issue 931). Whether `OVERWRITE_UNREAD_SAMPLES` alone prevents that is not
documented, so a thread asks for the count of samples. It only asks: it reads nothing, moves no
position and touches no output, and NI-DAQmx allows calls from several threads.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from haselab.rig.drivers import quietly

__all__ = ["IdlePoll"]

_PERIOD_S = 0.02
_LEAVE_S = 0.1  # that closing waits for a question under way


class IdlePoll:
    """Asks in a thread of its own, where nobody else has asked for a while.

    It ends with the first question that fails: the next read raises the reason.

    Args:
        ask: the question.
        period_s: longest time without one, in s.
    """

    def __init__(self, ask: Callable[[], object], period_s: float = _PERIOD_S) -> None:
        self._ask, self._period_s = ask, period_s
        self._asked_s = time.monotonic()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="nidaq idle poll", daemon=True)
        self._thread.start()

    def asked(self) -> None:
        """Somebody else has just asked the device."""
        self._asked_s = time.monotonic()

    def _run(self) -> None:
        while not self._ended.wait(self._period_s):
            if time.monotonic() - self._asked_s < self._period_s:
                continue
            if quietly(self._ask) is not None:
                return

    def close(self) -> None:
        """No more questions. Never raises."""
        self._ended.set()
        self._thread.join(_LEAVE_S)
