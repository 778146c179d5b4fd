"""The rate at which frames really come, from their time stamps."""

from __future__ import annotations

from collections import deque

import numpy as np

__all__ = ["FrameRateMeter"]

_WINDOW = 129  # times kept: 128 intervals
_FEW = 32  # intervals before a rate means something


class FrameRateMeter:
    r"""Measures a frame rate from times; lost frames do not lower it.

    The median interval $m$ says how many periods lie between two neighbours, and the rate is all
    periods over all time, $\sum_k \mathrm{round}(\Delta t_k / m) / \sum_k \Delta t_k$: half of the
    frames may be missing, and the scatter of the times counts at the two ends only.

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
        """Enough frames have come."""
        return len(self._times_s) > _FEW

    @property
    def rate_hz(self) -> float:
        """Frames a second of the last 128; 0 before there are enough."""
        if not self.known:
            return 0.0
        steps_s = np.diff(np.array(self._times_s))
        median_s = float(np.median(steps_s))
        if median_s <= 0.0:
            return 0.0
        return float(np.round(steps_s / median_s).sum() / steps_s.sum())

    @property
    def scatter_s(self) -> float:
        """Median deviation of the intervals from their median, in s; 0 before there are enough."""
        if not self.known:
            return 0.0
        steps_s = np.diff(np.array(self._times_s))
        return float(np.median(np.abs(steps_s - np.median(steps_s))))
