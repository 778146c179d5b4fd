"""Deadlines of a loop on a rig that runs by the wall clock: late and missed ticks, counted."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

__all__ = ["Deadlines", "Ticks"]

_WINDOW = 100  # ticks over which late ones are limited
_SOONEST = 16  # blocks among which the soonest gives the offset of the two clocks


@dataclass(frozen=True)
class Ticks:
    """What a loop has made of its deadlines.

    Args:
        count: ticks in all.
        late: outputs given when more than half of the time for it was gone.
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

    The end of a block on the rig's clock is known on the wall clock from the block that arrived
    soonest among the last ones, whatever the clocks' zero is. A rig whose clock stands still for
    a moment, as a served twin's may, is forgiven after as many blocks.

    Args:
        deadline_s: from the end of a block to its output: a block, and one for each output queued.
        missed_limit: as many missed ticks in a row are one too many.
        late_limit: as many late ticks in the last hundred are one too many.
        clock: monotonic, in s.
    """

    def __init__(
        self, deadline_s: float, missed_limit: int, late_limit: int, clock: Callable[[], float]
    ) -> None:
        self._usual_s, self._clock = deadline_s, clock
        self._missed_limit, self._late_limit = missed_limit, late_limit
        self.start()

    def start(self, foreseen_s: float = 0.0) -> None:
        """Count from here.

        Args:
            foreseen_s: so much later an output may be given, since it waits in the device already.
        """
        self._deadline_s = self._usual_s + foreseen_s
        self._count = self._late = self._missed = self._row = 0
        self._worst_s = 0.0
        self._ahead_s: deque[float] = deque(maxlen=_SOONEST)
        self._recent: deque[bool] = deque(maxlen=_WINDOW)
        self._pending_s: float | None = None

    def arrived(self, rig_s: float) -> None:
        """A block has arrived.

        Args:
            rig_s: the rig's clock at its last sample.
        """
        self._ahead_s.append(self._clock() - rig_s)
        self._pending_s = rig_s

    def answered(self) -> str:
        """The next output has been given; why the loop has to stop, empty if it need not."""
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
            f"{1e3 * self._deadline_s:g} ms). Close other programs, or set a longer block_samples."
        )

    @property
    def ticks(self) -> Ticks:
        """Counted since `start`."""
        return Ticks(self._count, self._late, self._missed, self._worst_s)
