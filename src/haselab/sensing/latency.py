"""Latency of the output, measured by the voltage monitor: the real delay of a loop."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate, InputError

__all__ = ["latency", "step_latencies"]

_BLOCKS = 12  # blocks after a requested step in which it is searched for
_REST_BLOCKS = 2  # blocks of constant output before a step
_CLEAR = 5.0  # smallest step relative to the spread of a constant output


def step_latencies(
    monitor: NDArray[np.float64] | NDArray[np.int16], drive_v: NDArray[np.float64], rate_hz: float
) -> NDArray[np.float64]:
    """Measure the time of each output step from the start of the block that requested it.

    That start is the last sample of the block before, from which a loop computes the output. A step
    counts when the output was constant for two blocks before it and during the whole search
    after it, and when it is above carrier and noise; its time is that of the midpoint.

    Args:
        monitor: voltage monitor in any unit, codes as well, shape `(B, N)`, in order and without a
            gap.
        drive_v: requested output in each block, shape `(B,)`, in V.
        rate_hz: samples per second.
    Returns:
        Times in s, one for each detectable step; possibly none.
    Raises:
        InputError: wrong shapes.
    Example:
        >>> monitor_v = np.zeros((20, 100))
        >>> monitor_v.reshape(-1)[1023:] = 1.0
        >>> drive_v = np.r_[np.zeros(10), np.ones(10)]
        >>> float(step_latencies(monitor_v, drive_v, 10e3)[0])
        0.00225
    """
    if monitor.ndim != 2 or drive_v.shape != monitor.shape[:1]:
        raise InputError(
            f"Monitor of shape {monitor.shape} and drive of shape {drive_v.shape}; they must be "
            "(B, N) and (B,)."
        )
    samples = monitor.shape[1]
    found: list[float] = []
    steps = (np.flatnonzero(np.diff(drive_v)) + 1).tolist()
    for last, k, following in zip([0, *steps], steps, [*steps[1:], len(drive_v)], strict=False):
        end = min(k + _BLOCKS, len(drive_v))
        if k - last < _REST_BLOCKS or following < end or end - k < 2:
            continue
        before = np.asarray(monitor[k - _REST_BLOCKS : k], dtype=np.float64).reshape(-1)
        after = np.asarray(monitor[end - 1], dtype=np.float64)
        low, high = float(before.mean()), float(after.mean())
        spread = max(float(before.std()), float(after.std()))
        if not abs(high - low) > _CLEAR * spread:
            continue
        rise = (monitor[k:end].reshape(-1) - low) / (high - low) - 0.5
        first = int(np.argmax(rise > 0.0))
        if rise[first] <= 0.0 or first >= (end - 1 - k) * samples:
            continue
        part = rise[first] / (rise[first] - rise[first - 1]) if first else 0.0
        found.append(float(first - part) / rate_hz)
    return np.array(found)


def latency(times_s: NDArray[np.float64], rate_hz: float) -> Estimate | None:
    """Combine the latencies of all steps; None without one.

    Args:
        times_s: from `step_latencies`, all steps of a rig, shape `(n,)`, in s.
        rate_hz: samples per second.
    Returns:
        Median; its standard deviation is from the spread, but at least that of one sample.
    Example:
        >>> latency(np.array([0.00225, 0.00225]), 10e3).value
        0.00225
    """
    if not times_s.size:
        return None
    sample_s = 1.0 / rate_hz / np.sqrt(12.0)
    # 1.25: the median's standard error over the mean's, for normal errors.
    spread_s = 1.25 * float(np.std(times_s)) / np.sqrt(times_s.size)
    return Estimate.normal(float(np.median(times_s)), float(np.hypot(sample_s, spread_s)), "s")
