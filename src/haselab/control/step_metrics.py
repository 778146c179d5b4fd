"""Rise, overshoot, settling and error of measured or simulated steps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtrit

from haselab.base import Estimate, InputError
from haselab.control.ringing import Ringing, average_out, find_ringing, smooth_lightly

__all__ = ["StepMetrics", "StepNumbers", "over_trials", "step_metrics", "step_numbers"]

_BASELINE_S = 1.0  # the initial level is the mean of the last second before the step
_FINAL_PART = 0.1  # the final value is the mean of the record's last tenth
_SETTLED = 0.02
_SLOW = 2.0  # periods of the ringing: a slower rise is hardly changed by averaging it out
_RINGS = 0.1  # of the step: such ringing crosses 90 % of it again


@dataclass(frozen=True)
class StepNumbers:
    """Metrics of one step response.

    Args:
        rise_time_s: 10 to 90 % of the way to the final value, with ringing averaged out, in s.
        raw_rise_time_s: the same for the unprocessed response, including ringing, in s.
        overshoot: largest excess over the final value, relative to it, including ringing.
        ring_averaged_overshoot: the same with the ringing averaged out.
        settling_time_s: time from the step after which the response stays within 2 % of its final
            value, in s; NaN if it still leaves that band in the last tenth.
        steady_state_error: reference minus final value, relative to the reference's step.
        peak_excess: largest excess over the reference, relative to the reference's step, including
            ringing; 0 if the response stays below. It compares responses that end at different
            values, as in open loop, where the overshoot over a value raised by creep is small.
        ringing: largest value less that with the ringing averaged out, relative to the final value.
    """

    rise_time_s: float
    raw_rise_time_s: float
    overshoot: float
    ring_averaged_overshoot: float
    settling_time_s: float
    steady_state_error: float
    peak_excess: float
    ringing: float

    @property
    def remark(self) -> str:
        """Why the rise time is not well defined; empty if it is."""
        if not self.ringing > _RINGS:
            return ""
        return (
            f"the step response rings by {100.0 * self.ringing:.0f} % of the step, so its rise "
            "time with the ringing averaged out is not well defined"
        )


@dataclass(frozen=True)
class StepMetrics:
    """Metrics over the trials: mean, standard deviation of that mean, 95 % interval (Student).

    For a single trial standard deviation and interval are NaN. For the meaning of the
    fields see `StepNumbers`.

    Args:
        rise_time_s: in s; NaN if it is shorter than a raw one of less than two periods of the
            ringing, because averaging out the ringing removed the rise as well.
        raw_rise_time_s: in s.
        overshoot: relative to the step.
        ring_averaged_overshoot: relative to the step.
        settling_time_s: in s.
        steady_state_error: relative to the step.
        peak_excess: relative to the step.
        ringing: ringing that was averaged out, None without ringing.
        trials: metrics of each trial.
    """

    rise_time_s: Estimate
    raw_rise_time_s: Estimate
    overshoot: Estimate
    ring_averaged_overshoot: Estimate
    settling_time_s: Estimate
    steady_state_error: Estimate
    peak_excess: Estimate
    ringing: Ringing | None
    trials: tuple[StepNumbers, ...]


def step_metrics(
    time_s: ArrayLike,
    y: ArrayLike,
    reference: ArrayLike,
    *,
    ringing: Ringing | None = None,
    reaches: bool = False,
) -> StepMetrics:
    """Compute the metrics of repeated step experiments.

    The ringing is found in the mean of the trials (or given) and averaged out over one period
    by `average_out`; a trace without ringing is only smoothed over a tenth of its rise.

    Args:
        time_s: uniform time, in s. Shape `(N,)`.
        y: responses in strain, one row per trial. Shape `(trials, N)` or `(N,)`.
        reference: desired strain; it changes once. Shape `(N,)`.
        ringing: ringing to average out, found in the data if not given.
        reaches: whether the response is known to reach the reference in the end: overshoot and
            settling are then relative to it, not to the record's last tenth.
    Returns:
        Estimates over the trials.
    Raises:
        InputError: inconsistent shapes, a time that is not uniform, no step or more
            than one, or a response that does not follow it.
    Source: reference study, fig. 6 (rise times read from the averaged trace).
    Example:
        >>> t = np.arange(-100, 900) / 100.0
        >>> y = np.where(t < 0.0, 0.0, 0.04 * (1.0 - np.exp(-t)))
        >>> found = step_metrics(t, y, np.where(t < 0.0, 0.0, 0.04))
        >>> round(found.rise_time_s.value, 2), round(found.settling_time_s.value, 1)
        (2.2, 3.9)
    """
    time, trials, desired = _checked(time_s, y, reference)
    at = int(np.flatnonzero(np.diff(desired))[0]) + 1
    rate_hz = (time.size - 1) / (time[-1] - time[0])
    before = trials[:, max(0, at - max(1, round(_BASELINE_S * rate_hz))) : at]
    moved = trials[:, at:] - before.mean(axis=1, keepdims=True)
    found = ringing or find_ringing(time[at:], moved.mean(axis=0))
    wanted = desired[-1] - before.mean(axis=1)
    size = float(desired[-1] - desired[0])
    numbers = tuple(
        step_numbers(row * math.copysign(1.0, size), abs(size), goal * math.copysign(1.0, size),
                     rate_hz=rate_hz, ringing=found, reaches=reaches)
        for row, goal in zip(moved, wanted, strict=True)
    )  # fmt: skip

    def over(name: str, unit: str) -> Estimate:
        return over_trials(np.array([getattr(item, name) for item in numbers]), unit)

    rise_s, raw_s = over("rise_time_s", "s"), over("raw_rise_time_s", "s")
    if found is not None and rise_s.value < raw_s.value < _SLOW * 2.0 * math.pi / found.omega_rad_s:
        rise_s = Estimate(math.nan, math.nan, (math.nan, math.nan), "s")
    return StepMetrics(
        rise_time_s=rise_s,
        raw_rise_time_s=raw_s,
        overshoot=over("overshoot", ""),
        ring_averaged_overshoot=over("ring_averaged_overshoot", ""),
        settling_time_s=over("settling_time_s", "s"),
        steady_state_error=over("steady_state_error", ""),
        peak_excess=over("peak_excess", ""),
        ringing=found,
        trials=numbers,
    )


def step_numbers(
    moved: NDArray[np.float64],
    size: float,
    wanted: float,
    *,
    rate_hz: float,
    ringing: Ringing | None,
    reaches: bool = False,
) -> StepNumbers:
    """Compute the metrics of one response, given from the step on.

    Args:
        moved: response minus its level before the step, rising. Shape `(N,)`.
        size: step of the reference, above 0.
        wanted: reference minus the level before the step.
        rate_hz: sampling rate, in Hz.
        ringing: ringing to average out; None to smooth only.
        reaches: see `step_metrics`.
    Returns:
        The metrics.
    Raises:
        InputError: the response does not end above its start.
    """
    last = moved[-max(1, round(_FINAL_PART * moved.size)) :]
    final = float(last.mean())
    if not final > 0.0:
        raise InputError(
            f"response moves by {final:g} under a step of {size:g}; it must move in the step's "
            f"direction. Check the columns and the record's end."
        )
    rough_s = _rise_time(moved, final, rate_hz)
    window_s = 0.1 * rough_s
    if ringing is not None:
        window_s = 0.2 * 2.0 * math.pi / ringing.omega_rad_s
    clean = smooth_lightly(moved, window_s, rate_hz)
    averaged = clean if ringing is None else average_out(moved, ringing, rate_hz)
    goal = wanted if reaches else final
    outside = np.flatnonzero(np.abs(clean - goal) > _SETTLED * goal)
    settled = int(outside[-1]) + 1 if outside.size else 0
    return StepNumbers(
        rise_time_s=_rise_time(averaged, final, rate_hz),
        raw_rise_time_s=rough_s,
        overshoot=max(0.0, float(clean.max()) / goal - 1.0),
        ring_averaged_overshoot=max(0.0, float(averaged.max()) / goal - 1.0),
        settling_time_s=settled / rate_hz if settled < moved.size - last.size else math.nan,
        steady_state_error=(wanted - final) / size,
        peak_excess=max(0.0, (float(clean.max()) - wanted) / size),
        ringing=float(clean.max() - averaged.max()) / final,
    )


def _rise_time(moved: NDArray[np.float64], final: float, rate_hz: float) -> float:
    return _first(moved, 0.9 * final, rate_hz) - _first(moved, 0.1 * final, rate_hz)


def _first(moved: NDArray[np.float64], level: float, rate_hz: float) -> float:
    """Time of the first crossing of `level`, by linear interpolation."""
    index = int(np.argmax(moved >= level))
    if index == 0:
        return 0.0
    low, high = moved[index - 1], moved[index]
    return float((index - 1 + (level - low) / (high - low)) / rate_hz)


def over_trials(
    values: NDArray[np.float64], unit: str, like: NDArray[np.float64] | None = None
) -> Estimate:
    """Mean of repeated trials with Student's interval; NaN spread for a single trial.

    Args:
        values: one value per trial. Shape `(trials,)`.
        unit: SI unit.
        like: other trials with the same scatter, used to estimate it; None: these.
    Returns:
        The mean.
    """
    mean = float(values.mean())
    known = values if like is None else like
    if known.size < 2:
        return Estimate(mean, math.nan, (math.nan, math.nan), unit)
    std = float(known.std(ddof=1)) / math.sqrt(values.size)
    half = float(stdtrit(known.size - 1, 0.975)) * std
    return Estimate(mean, std, (mean - half, mean + half), unit)


def _checked(
    time_s: ArrayLike, y: ArrayLike, reference: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    time = np.asarray(time_s, dtype=float)
    trials = np.atleast_2d(np.asarray(y, dtype=float))
    desired = np.asarray(reference, dtype=float)
    if time.ndim != 1 or desired.shape != time.shape or trials.shape[1:] != time.shape:
        raise InputError(
            f"time, y and reference have shapes {time.shape}, {trials.shape}, {desired.shape}; "
            "they must be (N,), (trials, N) and (N,). Give one sample for each time."
        )
    if not all(np.isfinite(values).all() for values in (time, trials, desired)):
        raise InputError("time, y or reference contains NaN. Cut the record.")
    steps = np.diff(time)
    if time.size < 20 or not np.allclose(steps, steps.mean(), rtol=1e-3, atol=0.0):
        raise InputError(
            f"time has {time.size} samples, {steps.min() if steps.size else 0:g} to "
            f"{steps.max() if steps.size else 0:g} s apart; at least 20 uniform samples are "
            "required. Resample."
        )
    changes = np.flatnonzero(np.diff(desired)).size
    if changes != 1:
        raise InputError(
            f"reference changes {changes} times; it must change once, after the first sample. "
            f"Cut the record around one step."
        )
    return time, trials, desired
