"""Query an idle NI device on USB, so that it keeps sending.

A USB device that is queried too rarely stops sending, though no buffer has overflowed
(nidaqmx-python, issue 931). Whether `OVERWRITE_UNREAD_SAMPLES` alone prevents that is not
documented, so a thread queries the number of samples. It reads no samples and does not change
position or output, and NI-DAQmx allows calls from several threads.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from haselab.rig.drivers import quietly

__all__ = ["IdlePoll"]

_PERIOD_S = 0.02
_LEAVE_S = 0.1  # longest wait for a running query when closing


class IdlePoll:
    """Queries the device in a thread if there was no other query for a while.

    It ends with the first query that fails: the next read raises the reason.

    Args:
        ask: the query.
        period_s: longest time without a query, in s.
    """

    def __init__(self, ask: Callable[[], object], period_s: float = _PERIOD_S) -> None:
        self._ask, self._period_s = ask, period_s
        self._asked_s = time.monotonic()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="nidaq idle poll", daemon=True)
        self._thread.start()

    def note_query(self) -> None:
        """Note that the device has just been queried elsewhere."""
        self._asked_s = time.monotonic()

    def _run(self) -> None:
        while not self._ended.wait(self._period_s):
            if time.monotonic() - self._asked_s < self._period_s:
                continue
            if quietly(self._ask) is not None:
                return

    def close(self) -> None:
        """Stop querying. Never raises."""
        self._ended.set()
        self._thread.join(_LEAVE_S)
