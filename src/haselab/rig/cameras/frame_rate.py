"""Measure the actual frame rate from time stamps."""

from __future__ import annotations

from collections import deque

import numpy as np

__all__ = ["FrameRateMeter"]

_WINDOW = 129  # number of times kept: 128 intervals
_FEW = 32  # intervals needed for a meaningful rate


class FrameRateMeter:
    r"""Measures a frame rate from times; lost frames do not lower it.

    The median interval $m$ gives the number of periods between two frames, and the rate is all
    periods divided by the total time, $\sum_k \mathrm{round}(\Delta t_k / m) / \sum_k \Delta t_k$.
    Half of the frames may be missing, and the scatter of the times matters only at the two ends.

    Example:
        >>> meter = FrameRateMeter()
        >>> for k in range(80):
        ...     if k % 5:  # every fifth one is lost
        ...         meter.add(0.01 * k)
        >>> round(meter.rate_hz, 6)
        100.0
    """

    def __init__(self) -> None:
        self._times_s: deque[float] = deque(maxlen=_WINDOW)

    def add(self, time_s: float) -> None:
        """Take one frame's time, in s; rising."""
        self._times_s.append(time_s)

    @property
    def known(self) -> bool:
        """Whether enough frames have arrived."""
        return len(self._times_s) > _FEW

    @property
    def rate_hz(self) -> float:
        """Frames per second over the last 128 frames; 0 before there are enough."""
        if not self.known:
            return 0.0
        steps_s = np.diff(np.array(self._times_s))
        median_s = float(np.median(steps_s))
        if median_s <= 0.0:
            return 0.0
        return float(np.round(steps_s / median_s).sum() / steps_s.sum())

    @property
    def scatter_s(self) -> float:
        """Median absolute deviation of the intervals, in s; 0 before there are enough."""
        if not self.known:
            return 0.0
        steps_s = np.diff(np.array(self._times_s))
        return float(np.median(np.abs(steps_s - np.median(steps_s))))
