"""Count late and missed ticks of a loop on a real-time rig."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

__all__ = ["Deadlines", "Ticks"]

_WINDOW = 100  # ticks over which late ones are counted
_SOONEST = 16  # blocks among which the earliest gives the offset of the two clocks


@dataclass(frozen=True)
class Ticks:
    """How well a loop met its deadlines.

    Args:
        count: ticks in all.
        late: outputs given after more than half of the available time.
        missed: outputs given so late that they took effect too late.
        worst_s: longest time from the end of a block to the next output, in s.
    """

    count: int
    late: int
    missed: int
    worst_s: float

    def __str__(self) -> str:
        return (
            f"{self.count} ticks, {self.late} late, {self.missed} missed, "
            f"worst {1e3 * self.worst_s:.1f} ms"
        )


class Deadlines:
    """Compares the wall clock with the rig's clock at each output.

    The block that arrived earliest among the last ones gives the offset of the two clocks. A rig
    whose clock pauses, as a served twin's may, is compensated after as many blocks.

    Args:
        deadline_s: from the end of a block to its output: one block, plus one per queued output.
        missed_limit: number of missed ticks in a row that is a fault.
        late_limit: number of late ticks in the last hundred that is a fault.
        clock: monotonic, in s.
    """

    def __init__(
        self, deadline_s: float, missed_limit: int, late_limit: int, clock: Callable[[], float]
    ) -> None:
        self._usual_s, self._clock = deadline_s, clock
        self._missed_limit, self._late_limit = missed_limit, late_limit
        self.start()

    def start(self, queued_s: float = 0.0) -> None:
        """Start counting.

        Args:
            queued_s: extra time for each output, because so many are queued in the device.
        """
        self._deadline_s = self._usual_s + queued_s
        self._count = self._late = self._missed = self._row = 0
        self._worst_s = 0.0
        self._ahead_s: deque[float] = deque(maxlen=_SOONEST)
        self._recent: deque[bool] = deque(maxlen=_WINDOW)
        self._pending_s: float | None = None
        self._spent = ("", 0.0)  # on the pending output
        self._slow = ("", 0.0)  # the longest of those that made an output late

    @property
    def now_s(self) -> float:
        """Wall clock, in s."""
        return self._clock()

    def arrived(self, rig_s: float) -> None:
        """Note that a block has arrived.

        Args:
            rig_s: the rig's clock at its last sample.
        """
        self._ahead_s.append(self._clock() - rig_s)
        self._pending_s = rig_s

    def spent(self, by: str, took_s: float) -> None:
        """Note which part of the program computed the next output, and how long it took.

        Args:
            by: its name, for the message.
            took_s: by the same clock.
        """
        self._spent = by, took_s

    def answered(self) -> str:
        """Note that the next output was given; return why the loop must stop, or an empty text."""
        if self._pending_s is None:
            return ""
        delay_s = self._clock() - self._pending_s - min(self._ahead_s)
        self._pending_s = None
        late, missed = delay_s > 0.5 * self._deadline_s, delay_s >= self._deadline_s
        self._count += 1
        self._late += late
        self._missed += missed
        self._row = self._row + 1 if missed else 0
        self._recent.append(late)
        self._worst_s = max(self._worst_s, delay_s)
        by, took_s = self._spent
        self._spent = "", 0.0
        if late and took_s > max(0.5 * delay_s, self._slow[1]):
            self._slow = by, took_s
        if self._row >= self._missed_limit:
            return self._fault(
                f"{self._row} deadlines missed in a row (missed_limit = {self._missed_limit})"
            )
        count = sum(self._recent)
        if count >= self._late_limit:
            return self._fault(
                f"{count} of the last {len(self._recent)} outputs late "
                f"(late_limit = {self._late_limit})"
            )
        return ""

    def _fault(self, what: str) -> str:
        return (
            f"Lost deadline: {what} (worst {1e3 * self._worst_s:.1f} ms, limit "
            f"{1e3 * self._deadline_s:g} ms). {self.advice}"
        )

    @property
    def advice(self) -> str:
        """What to do about late outputs, with the part of the program that made them late."""
        by, took_s = self._slow
        if by:
            return (
                f"{by} took up to {1e3 * took_s:.1f} ms of this delay. Make it faster, or raise "
                "daq.ahead_blocks or daq.block_samples."
            )
        return "Close other programs, or raise daq.ahead_blocks or daq.block_samples."

    @property
    def ticks(self) -> Ticks:
        """Ticks counted since `start`."""
        return Ticks(self._count, self._late, self._missed, self._worst_s)
