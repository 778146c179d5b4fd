"""Whether a counter in shared memory still goes on, judged fairly on a busy computer."""

from __future__ import annotations

__all__ = ["SILENT_S", "Heartbeat"]

SILENT_S = 0.25  # a guardian that has not counted for so long is lost
_LONGEST_S = 0.04  # that one look may add: where the whole computer paused, nobody was silent


class Heartbeat:
    """Adds up the time in which a counter stood still.

    Only time in which the observer itself looked often counts, so a pause of the whole computer is
    not taken for the silence of one process.
    """

    def __init__(self) -> None:
        self._last = -1
        self._look_s = 0.0
        self._silent_s = 0.0

    def silent_s(self, count: int, now_s: float) -> float:
        """How long the counter has stood still.

        Args:
            count: its value now.
            now_s: monotonic clock, in s.
        Returns:
            Time in s, 0 where it has changed since the last look.
        """
        step_s, self._look_s = min(now_s - self._look_s, _LONGEST_S), now_s
        self._silent_s = 0.0 if count != self._last else self._silent_s + step_s
        self._last = count
        return self._silent_s
