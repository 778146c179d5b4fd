"""A table of voltage and length, or capacitance, as one motion that a physical model predicts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab.actuators import GRAVITY_M_S2, Drive
from haselab.base import InputError
from haselab.identify.physical import MotionRecord

__all__ = ["motion_of_table"]

Floats = NDArray[np.float64]
_GLIMPSE = 0.01  # of the time to the next row


def motion_of_table(
    name: str,
    time_s: Floats,
    voltage_v: Floats,
    *,
    mass_kg: float,
    length_m: Floats | None = None,
    capacitance_f: Floats | None = None,
    std: float,
) -> MotionRecord:
    """Make a motion of the samples of a table.

    Each voltage acts from its time to the next one, and what was measured belongs to the same time.
    Before the first row, the actuator has been at rest under the first voltage.

    Args:
        name: for messages; the one experiment is called so, too.
        time_s: of the rows, rising. Shape `(N,)`.
        voltage_v: of the actuator. Shape `(N,)`.
        mass_kg: that hangs.
        length_m: measured; None: it was not. Shape `(N,)`.
        capacitance_f: likewise. Shape `(N,)`.
        std: standard deviation of the measured values, in m or F.
    Returns:
        The motion.
    Raises:
        InputError: Fewer than 2 rows, times that do not rise, or nothing measured.
    """
    if time_s.size < 2 or not (np.diff(time_s) > 0.0).all():
        raise InputError(
            f"{name} has {time_s.size} rows. A prediction needs at least 2 rows whose times rise. "
            "Sort the rows by time, and remove repeated times."
        )
    count = time_s.size
    step_s = np.diff(time_s, append=2.0 * time_s[-1] - time_s[-2])
    # a capacitance is the mean over an interval, so each row begins with a short one
    glimpse_s = _GLIMPSE * step_s
    starts_s = np.stack([time_s, time_s + glimpse_s], axis=1).ravel()
    pairs = 2 * count
    drive = Drive(
        np.append(starts_s, time_s[-1] + step_s[-1]), np.repeat(voltage_v, 2),
        np.full(pairs, mass_kg * GRAVITY_M_S2), np.full(pairs, mass_kg), np.zeros(pairs),
    )  # fmt: skip
    no, none = np.zeros(0), np.zeros(0, dtype=np.int64)
    rows, stds = np.arange(count), np.full(count, std)
    frames, length_m = (no, no) if length_m is None else (time_s, length_m)
    sensed, capacitance_f = (none, no) if capacitance_f is None else (rows, capacitance_f)
    sizes = frames.size, sensed.size
    return MotionRecord(
        name, drive, frames, length_m, stds[: sizes[0]], 2 * sensed, sensed, capacitance_f,
        stds[: sizes[1]], (name,), np.zeros(sizes[0], np.int64), np.zeros(sizes[1], np.int64),
        capacitance_later_s=-0.5 * glimpse_s[: sizes[1]],
    )  # fmt: skip
