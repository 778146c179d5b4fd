"""Which pages are still there, and which commands are too old to be carried out.

All times are those of `lease_clock_s`, which the processes of a computer share and which counts
while the computer sleeps. The bench process sends the time with its state, a page returns the last
one that it has seen with each command, and the web server adds the time to each sign of life. So
a command that waited anywhere (in a page, in a stopped process, in a socket) is known to be old.
"""

from __future__ import annotations

from collections.abc import Callable

from haselab.base import SafetyError
from haselab.safety.interlock import lease_clock_s

__all__ = ["PageLeases"]

_LATE_S = 27.0  # longest time to arm, which the web server reports as failed after 30 s


class PageLeases:
    """Signs of life of pages, and the age of their commands.

    Args:
        lease_s: longest time without a sign of life; also the largest age of a command.
        clock: in s.
    """

    def __init__(self, lease_s: float, clock: Callable[[], float] = lease_clock_s) -> None:
        self.lease_s, self._clock = lease_s, clock
        self._heard_s: dict[str, float] = {}

    def begin(self, page: str) -> None:
        """Begin the lease of a page now."""
        self._heard_s[page] = self._clock()

    def renew(self, page: str, at_s: float | None) -> None:
        """Renew the lease of a page by a sign of life; a lease that had ended then stays ended.

        Args:
            page: whose lease it is.
            at_s: time of the sign; None: now.
        """
        heard_s = self._heard_s.get(page)
        at_s = self._clock() if at_s is None else min(at_s, self._clock())
        if heard_s is not None and heard_s <= at_s <= heard_s + self.lease_s:
            self._heard_s[page] = at_s

    def end(self, page: str) -> None:
        """End the lease of a page."""
        self._heard_s.pop(page, None)

    def is_lost(self, page: str) -> bool:
        """Whether a page has no valid lease."""
        return not self._clock() <= self._heard_s.get(page, -float("inf")) + self.lease_s

    def require_recent(self, at_s: float | None) -> None:
        """Refuse a command that is older than the lease.

        Args:
            at_s: time of the data that its page has seen; None: a call in this process.
        Raises:
            SafetyError: it is too old.
        """
        self._require(at_s, self.lease_s)

    def require_in_time(self, at_s: float | None) -> None:
        """Refuse to arm if that took so long that the page is told that it failed.

        Args:
            at_s: as above.
        Raises:
            SafetyError: it took too long.
        """
        self._require(at_s, _LATE_S)

    def _require(self, at_s: float | None, most_s: float) -> None:
        age_s = 0.0 if at_s is None else self._clock() - at_s
        if not 0.0 <= age_s <= most_s:
            known = f"is {age_s:.3g} s old" if 0.0 <= age_s < 1e6 else "does not say how old it is"
            raise SafetyError(
                f"The command {known} (limit {most_s:.3g} s), so it was not carried out. If the "
                "page shows live data, repeat it."
            )
