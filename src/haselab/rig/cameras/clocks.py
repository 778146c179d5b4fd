"""Estimate the offset between two clocks if each reading of one is late by an unknown time."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

__all__ = ["ClockOffset", "SlowOffset"]

_SEGMENT_S = 0.25  # the earliest reading of each segment is kept
_SEGMENTS = 80  # twenty seconds
_FEW_SEGMENTS = 4
_SLOPE_FROM_S = 5.0  # a shorter record gives an offset but no drift
_MOST_DRIFT = 5e-4  # more than any quartz clock drifts: one of the clocks was set
_FASTEST = 0.1  # seconds of correction per second


class ClockOffset:
    r"""Offset to add to one clock to get another, from pairs whose second reading is late.

    A block or a frame is seen after it happened, never before: the readings are above the line

    $\mathrm{late} = \mathrm{early} + o + d\,\mathrm{early}$

    of offset $o$ and drift $d$. The line is the one closest below all readings of the last twenty
    seconds: the edge of their lower convex hull at their mean time. The smallest delay, which all
    readings share, remains in the offset.

    Source: S. B. Moon, P. Skelly, D. Towsley, Estimation and removal of clock skew from network
        delay measurements, INFOCOM 1999.

    Example:
        >>> offset = ClockOffset()
        >>> for k, late_s in enumerate((0.25, 0.0, 0.5, 0.125)):
        ...     offset.add(float(k), 4.0 + k + late_s)
        >>> offset.known, offset.at(3.0)
        (True, 4.0)
    """

    def __init__(self) -> None:
        self._early: deque[float] = deque(maxlen=_SEGMENTS)
        self._over: deque[float] = deque(maxlen=_SEGMENTS)
        self._late: deque[float] = deque(maxlen=_SEGMENTS)
        self._segment = 0
        self._origin_s = 0.0
        self._slope = 0.0
        self._base_s = 0.0

    @property
    def known(self) -> bool:
        """Whether there has been a reading."""
        return bool(self._early)

    @property
    def spread_s(self) -> float:
        """Median distance of the earliest reading of each segment from the line, in s.

        In the first second it is the median of all readings, which is larger.
        """
        if not self._early:
            return 0.0
        if len(self._early) < _FEW_SEGMENTS:
            return float(np.median(self._late))
        over = [o - self.at(e) for e, o in zip(self._early, self._over, strict=True)]
        return float(np.median(over))

    def at(self, early_s: float) -> float:
        """Offset, in s, at a time of the first clock, in s."""
        return self._base_s + self._slope * (early_s - self._origin_s)

    def add(self, early_s: float, late_s: float) -> None:
        """Add one pair of readings.

        Args:
            early_s: time of the event on the first clock, in s.
            late_s: time at which it was seen, on the second clock, in s.
        """
        if not self._early:
            self._origin_s = early_s
        over_s = late_s - early_s
        segment = int((early_s - self._origin_s) // _SEGMENT_S)
        if not self._early or segment != self._segment:
            self._segment = segment
            self._early.append(early_s)
            self._over.append(over_s)
            self._fit()
        elif over_s < self._over[-1]:
            self._early[-1], self._over[-1] = early_s, over_s
            if over_s < self.at(early_s):
                self._fit()
        self._late.append(over_s - self.at(early_s))

    def _fit(self) -> None:
        early = np.array(self._early) - self._origin_s
        over = np.array(self._over)
        self._slope = _slope_below(early, over) if np.ptp(early) >= _SLOPE_FROM_S else 0.0
        self._base_s = float((over - self._slope * early).min())


def _slope_below(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Slope of the lower convex hull at the mean of x; 0 if it exceeds any quartz clock's drift."""
    hull: list[tuple[float, float]] = []
    for point in zip(x.tolist(), y.tolist(), strict=True):
        while len(hull) > 1 and not _turns_up(hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    mean = float(x.mean())
    at = next(k for k in range(1, len(hull)) if hull[k][0] >= mean)
    (low_x, low_y), (high_x, high_y) = hull[at - 1], hull[at]
    slope = (high_y - low_y) / (high_x - low_x)
    return slope if abs(slope) < _MOST_DRIFT else 0.0


def _turns_up(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) > (b[1] - a[1]) * (c[0] - a[0])


class SlowOffset:
    """An offset that changes by at most a tenth of the elapsed time, so that the sum rises.

    Example:
        >>> slow = SlowOffset()
        >>> [round(slow.step(0.5 * k, wanted_s), 3) for k, wanted_s in enumerate((1.0, 0.0, 0.97))]
        [1.0, 0.95, 0.97]
    """

    def __init__(self) -> None:
        self._at_s: float | None = None
        self._offset_s = 0.0

    def step(self, at_s: float, wanted_s: float) -> float:
        """Return the offset at the next time.

        Args:
            at_s: the time, later than the last one, in s.
            wanted_s: the best known offset, in s.
        Returns:
            The offset to use, in s.
        """
        if self._at_s is None:
            self._offset_s = wanted_s
        else:
            most_s = _FASTEST * max(at_s - self._at_s, 0.0)
            self._offset_s += max(-most_s, min(most_s, wanted_s - self._offset_s))
        self._at_s = at_s
        return self._offset_s
