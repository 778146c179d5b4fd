"""Numbers from traces: steps, tracking, and the rejection of loads."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.scoreboard.play import TRACE_S, Trace

__all__ = [
    "StepScore",
    "load_response",
    "smoothed",
    "step_response",
    "tracking_error",
    "variation_v_per_s",
]

Floats = NDArray[np.float64]
_BEFORE_S = 0.3  # of the mean before an event
_FINAL = 0.2  # of a record, whose mean is its final value
_SMOOTH_S = 0.02  # noise moves the actuator by a quarter of 2 % of a step of 0.04
_SETTLED = 0.02
_RESTLESS = 0.2  # of a step: standard deviation of what has not settled at all
_FAR = 0.5  # of a step, from which on it has not happened
_BACK = 1e-3  # strain


@dataclass(frozen=True)
class StepScore:
    """One step response; NaN where it ended far from the desired strain, or still swings.

    Args:
        rise_s: 10 to 90 % of the way to the desired strain; NaN where it does not come so far.
        overshoot: largest excess over the desired strain, relative to the step.
        settling_s: after which the mean of 20 ms stays within 2 % of the step around the desired
            strain; NaN where it does not.
        error: final value less the desired one, in strain.
    """

    rise_s: float
    overshoot: float
    settling_s: float
    error: float


def smoothed(values: Floats, window_s: float = _SMOOTH_S) -> Floats:
    """Centred moving mean, of fewer values at the ends.

    Args:
        values: every 1 ms. Shape `(N,)`.
        window_s: width of the window.
    Returns:
        Means. Shape `(N,)`.
    """
    half = max(round(0.5 * window_s / TRACE_S), 0)
    sums = np.concatenate([[0.0], np.cumsum(values)])
    index = np.arange(values.size)
    first, last = np.maximum(index - half, 0), np.minimum(index + half + 1, values.size)
    return np.asarray((sums[last] - sums[first]) / (last - first))


def step_response(
    trace: Trace, at_s: float, last_s: float, before: float, after: float
) -> StepScore:
    """Score a step of the reference.

    All numbers are relative to the desired strain, not to the one that was reached: a controller
    that stops half-way is not faster than one that goes the whole way.

    Args:
        trace: with the step.
        at_s: when the reference changes.
        last_s: duration of the record from then on.
        before: desired strain before the step.
        after: the one after it.
    Returns:
        The numbers.
    """
    nothing = StepScore(math.nan, math.nan, math.nan, math.nan)
    _, earlier = trace.between(at_s - _BEFORE_S, at_s)
    time_s, strain = trace.between(at_s, at_s + last_s)
    if earlier.size == 0 or time_s.size < round(0.9 * last_s / TRACE_S):
        return nothing
    size = after - before
    left = (after - strain) / size  # of the step; below 0: beyond the desired strain
    last = left[-round(_FINAL * left.size) :]
    if abs(float(last.mean())) > _FAR or float(last.std()) > _RESTLESS:
        return nothing
    outside = np.flatnonzero(np.abs(smoothed(left)) > _SETTLED)
    settled = int(outside[-1]) + 1 if outside.size else 0
    start = (after - float(earlier.mean())) / size
    return StepScore(
        rise_s=(_crossing(1.0 - left / start, 0.9) - _crossing(1.0 - left / start, 0.1)) * TRACE_S
        if start > _FAR else math.nan,
        overshoot=max(-float(left.min()), 0.0),
        settling_s=settled * TRACE_S if settled < 0.9 * left.size else math.nan,
        error=-float(last.mean()) * size,
    )  # fmt: skip


def _crossing(moved: Floats, level: float) -> float:
    """Index of the first crossing, by linear interpolation; NaN without one."""
    above = int(np.argmax(moved >= level))
    if above == 0:
        return 0.0 if moved[0] >= level else math.nan
    low, high = moved[above - 1], moved[above]
    return float(above - 1 + (level - low) / (high - low))


def tracking_error(trace: Trace, wanted: Floats, from_s: float, to_s: float) -> float:
    """Rms error over the peak-to-peak value of the reference.

    Args:
        trace: of the whole task.
        wanted: reference at the times of the trace. Shape `(N,)`.
        from_s: beginning of the part.
        to_s: end of it.
    """
    first, last = np.searchsorted(trace.time_s, [from_s, to_s])
    if last - first < round(0.9 * (to_s - from_s) / TRACE_S):
        return math.nan
    part = slice(int(first), int(last))
    error = trace.strain[part] - wanted[part]
    return float(np.sqrt(np.mean(error**2)) / np.ptp(wanted[part]))


def load_response(trace: Trace, at_s: float, last_s: float) -> tuple[float, float]:
    """Peak of the strain after a change of load, and time until its mean is back.

    Args:
        trace: with the event; the reference is constant.
        at_s: when the load changes.
        last_s: duration of the record from then on.
    Returns:
        Largest deviation from the mean before, in strain, and time after which the mean of 20 ms
        stays within 0.1 % strain of it, in s; NaN if it does not.
    """
    _, before = trace.between(at_s - _BEFORE_S, at_s)
    _, strain = trace.between(at_s, at_s + last_s)
    if before.size == 0 or strain.size < round(0.9 * last_s / TRACE_S):
        return math.nan, math.nan
    away = strain - float(before.mean())
    outside = np.flatnonzero(np.abs(smoothed(away)) > _BACK)
    back = int(outside[-1]) + 1 if outside.size else 0
    return float(np.abs(away).max()), back * TRACE_S if back < 0.9 * away.size else math.nan


def variation_v_per_s(trace: Trace) -> float:
    """Sum of all changes of the drive, per second.

    Args:
        trace: whose drive counts.
    """
    values = trace.drive_v
    if values.size < 2:
        return math.nan
    return float(np.abs(np.diff(values)).sum() / (trace.update_s[-1] - trace.update_s[0]))
