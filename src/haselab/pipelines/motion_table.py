"""A table of voltage and length, or capacitance, as one motion that a physical model predicts."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from haselab.actuators import GRAVITY_M_S2, Drive
from haselab.base import InputError
from haselab.identify.physical import MotionRecord
from haselab.identify.training_output import grid_step

__all__ = ["motion_of_table"]

Floats = NDArray[np.float64]
_GLIMPSE = 0.01  # of the time to the next row
_ORDERS = range(2, 9)  # of differences, which suppress the motion and leave the noise
_LEAST_VALUES = 20  # differences, whose median is then certain to a fifth


def motion_of_table(
    name: str,
    time_s: Floats,
    voltage_v: Floats,
    *,
    mass_kg: float,
    length_m: Floats | None = None,
    capacitance_f: Floats | None = None,
    length_std_m: float | None = None,
    capacitance_std_f: float | None = None,
) -> MotionRecord:
    """Make a motion of the samples of a table.

    Each voltage acts from its time to the next one, and what was measured belongs to the same time.
    Before the first row, the actuator has been at rest under the first voltage.

    Args:
        name: for messages; the one experiment is called so, too.
        time_s: of the rows, rising; the motion begins at 0 s. Shape `(N,)`.
        voltage_v: of the actuator. Shape `(N,)`.
        mass_kg: that hangs.
        length_m: measured, NaN where it was not; None: nowhere. Shape `(N,)`.
        capacitance_f: likewise. Shape `(N,)`.
        length_std_m: standard deviation of the lengths; None: estimated from neighbouring rows.
        capacitance_std_f: likewise.
    Returns:
        The motion.
    Raises:
        InputError: Fewer than 2 rows, times that do not rise, or nothing measured.
    """
    if time_s.size < 2 or not (np.diff(time_s) > 0.0).all():
        raise InputError(
            f"{name} has {time_s.size} rows. It needs at least 2 rows whose times rise. "
            "Sort the rows by time, and remove repeated times."
        )
    time_s = time_s - time_s[0]  # of Unix times, few digits would be left for the motion
    step_s = np.diff(time_s, append=2.0 * time_s[-1] - time_s[-2])
    no, none = np.zeros(0), np.zeros(0, dtype=np.int64)
    starts_s, volt, sensed, later_s, seen_s = time_s, voltage_v, none, no, no
    if length_m is not None:
        seen = np.isfinite(length_m)
        seen_s, length_m = time_s[seen], length_m[seen]
    if capacitance_f is not None:
        # a capacitance is the mean over an interval, so each row begins with a short one
        glimpse_s = _GLIMPSE * step_s
        starts_s = np.stack([time_s, time_s + glimpse_s], axis=1).ravel()
        volt, sensed = np.repeat(voltage_v, 2), np.flatnonzero(np.isfinite(capacitance_f))
        capacitance_f, later_s = capacitance_f[sensed], -0.5 * glimpse_s[sensed]
    count = starts_s.size
    drive = Drive(
        np.append(starts_s, time_s[-1] + step_s[-1]), volt,
        np.full(count, mass_kg * GRAVITY_M_S2), np.full(count, mass_kg), np.zeros(count),
    )  # fmt: skip
    measured = [
        (no, no) if values is None else (values, np.full(values.size, std or _noise(name, values)))
        for values, std in ((length_m, length_std_m), (capacitance_f, capacitance_std_f))
    ]
    (length_m, length_std), (capacitance_f, capacitance_std) = measured
    return MotionRecord(
        name, drive, seen_s, length_m, length_std, 2 * sensed, np.arange(sensed.size),
        capacitance_f, capacitance_std, (name,), np.zeros(length_m.size, np.int64),
        np.zeros(sensed.size, np.int64), capacitance_later_s=later_s,
        std_estimated=length_std_m is None and capacitance_std_f is None,
    )  # fmt: skip


def _noise(name: str, values: Floats) -> float:
    """Standard deviation of the noise, by the differences of the order that shows the least.

    Low orders contain motion. Where the motion changes in each row, all orders contain it.
    """
    steps = np.diff(np.unique(values))
    if steps.size == 0:
        raise InputError(f"{name}: all measured values are {values[0]:g}. Check the column.")
    # the median of a normal variable's size is 0.674 of its deviation
    found = [
        float(np.median(np.abs(np.diff(values, order)))) / math.sqrt(math.comb(2 * order, order))
        for order in _ORDERS
        if values.size >= (_LEAST_VALUES if order > _ORDERS[0] else 1) + order
    ]
    noise = min(found, default=0.0) / 0.674
    return max(noise, max(float(steps.min()), grid_step(values)) / math.sqrt(12.0))
