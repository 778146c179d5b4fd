"""Check which pages are still connected, and which commands are too old to be carried out.

All times are those of `lease_clock_s`, which is the same in all processes of a computer and keeps
running while the computer sleeps. The bench process sends the time with its state, a page adds the
last time that it received to each command, and the web server adds the time to each sign of life.
So the age of a command is known wherever it waited: in a page, in a stopped process or in a socket.
"""

from __future__ import annotations

from collections.abc import Callable

from haselab.base import SafetyError
from haselab.safety.interlock import lease_clock_s

__all__ = ["PageLeases"]

_LATE_S = 27.0  # longest time to arm; after 30 s, the web server reports a failure


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
        """Start the lease of a page now."""
        self._heard_s[page] = self._clock()

    def renew(self, page: str, at_s: float | None) -> None:
        """Renew the lease of a page at a sign of life, unless the lease had ended before it.

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
            at_s: time of the last data that its page received; None: a call in this process.
        Raises:
            SafetyError: It is too old.
        """
        self._require(at_s, self.lease_s)

    def require_in_time(self, at_s: float | None) -> None:
        """Refuse to arm if arming took so long that the page reports a failure.

        Args:
            at_s: see `require_recent`.
        Raises:
            SafetyError: It took too long.
        """
        self._require(at_s, _LATE_S)

    def _require(self, at_s: float | None, most_s: float) -> None:
        age_s = 0.0 if at_s is None else self._clock() - at_s
        if not 0.0 <= age_s <= most_s:
            known = f"is {age_s:.3g} s old" if 0.0 <= age_s < 1e6 else "has no valid time"
            raise SafetyError(
                f"The command {known} (limit {most_s:.3g} s), so it was not carried out. Repeat it "
                "if the page shows live data."
            )
