"""Detect a stopped counter in shared memory, without false alarms on a busy computer."""

from __future__ import annotations

__all__ = ["SILENT_S", "Heartbeat"]

SILENT_S = 0.25  # a guardian whose counter stopped for longer is lost
_LONGEST_S = 0.04  # most that one check may add: a pause of the whole computer must not count


class Heartbeat:
    """Adds up the time in which a counter did not change.

    Only time in which the observer itself checked often counts, so that a pause of the whole
    computer is not mistaken for the failure of one process.
    """

    def __init__(self) -> None:
        self._last = -1
        self._look_s = 0.0
        self._silent_s = 0.0

    def silent_s(self, count: int, now_s: float) -> float:
        """Return how long the counter has not changed.

        Args:
            count: its value now.
            now_s: monotonic clock, in s.
        Returns:
            Time in s; 0 if it has changed since the last check.
        """
        step_s, self._look_s = min(now_s - self._look_s, _LONGEST_S), now_s
        self._silent_s = 0.0 if count != self._last else self._silent_s + step_s
        self._last = count
        return self._silent_s
