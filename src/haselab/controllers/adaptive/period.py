"""Finds the period of a reference while it is played."""

from __future__ import annotations

import numpy as np

__all__ = ["PeriodFinder"]

_SAME = 1e-5  # strain: desired strains that differ by less are the same


class PeriodFinder:
    """The number of updates after which a reference repeats, seen twice in a row.

    A period that is no whole number of updates is found as its smallest multiple that is one.

    Args:
        shortest: lowest number of updates; a shorter period is found as a multiple.
        longest: highest number of updates.
    Example:
        >>> finder = PeriodFinder(3, 10)
        >>> [finder.next(value) for value in (0.0, 0.1, 0.2, 0.0, 0.0, 0.1, 0.2, 0.0, 0.0)]
        [0, 0, 0, 0, 0, 0, 0, 4, 4]
        >>> finder.next(0.3)
        0
    """

    def __init__(self, shortest: int, longest: int) -> None:
        self._shortest, self._longest = shortest, longest
        self._past = np.full(longest, np.nan)  # the latest first
        self._same = np.zeros(longest, dtype=np.int64)  # repeats in a row, by the lag less 1
        self._lags = np.arange(1, longest + 1)
        self._found = 0

    def next(self, value: float) -> int:
        """Take the desired strain of an update; return the period, 0 while there is none."""
        repeats = np.abs(self._past - value) < _SAME
        self._same = np.where(repeats, self._same + 1, 0)
        self._past[1:] = self._past[:-1]
        self._past[0] = value
        if self._found and self._same[self._found - 1] > 0:
            return self._found
        # a constant reference has no period: the last one must contain a change
        lags = self._lags
        seen = (self._same >= lags) & (lags > self._same[0]) & (lags >= self._shortest)
        self._found = int(lags[np.argmax(seen)]) if seen.any() else 0
        return self._found
