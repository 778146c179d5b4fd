"""When an output took effect, as the voltage monitor saw it: the delay that a loop really has."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate, InputError

__all__ = ["latency", "step_latencies"]

_BLOCKS = 12  # after the one that a step was asked for, in which it is looked for
_REST_BLOCKS = 2  # of one output before a step
_CLEAR = 5.0  # times the spread at rest that a step has to have


def step_latencies(
    monitor: NDArray[np.float64] | NDArray[np.int16], drive_v: NDArray[np.float64], rate_hz: float
) -> NDArray[np.float64]:
    """Time of each step of the output from the start of the block that it was asked for.

    That start is the last sample of the block before, from which a loop computes the output. A step
    counts when the output stood for two blocks before it and for as long after it as it is looked
    for, and when it is clear of carrier and noise; its time is that of the middle between both.

    Args:
        monitor: voltage monitor in any unit, codes as well, shape `(B, N)`, in order and without a
            gap.
        drive_v: asked for in each block, shape `(B,)`, in V.
        rate_hz: samples per second.
    Returns:
        In s, one for each step that can be told; perhaps none.
    Raises:
        InputError: shapes that do not fit.
    Example:
        >>> monitor_v = np.zeros((20, 100))
        >>> monitor_v.reshape(-1)[1023:] = 1.0
        >>> drive_v = np.r_[np.zeros(10), np.ones(10)]
        >>> float(step_latencies(monitor_v, drive_v, 10e3)[0])
        0.00225
    """
    if monitor.ndim != 2 or drive_v.shape != monitor.shape[:1]:
        raise InputError(
            f"Monitor of shape {monitor.shape} and drive of shape {drive_v.shape}, allowed are "
            "(B, N) and (B,). Correct the call."
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
    """One latency from that of every step; None without one.

    Args:
        times_s: of `step_latencies`, all steps of a rig, shape `(n,)`, in s.
        rate_hz: samples per second.
    Returns:
        Median; its standard deviation from the steps' spread, and no less than a sample's.
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
