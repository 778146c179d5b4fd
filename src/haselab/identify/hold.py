"""Convert an input to the points, or the held values, that a simulation takes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab.identify.record import Record
from haselab.models.filters import resample_poly

__all__ = ["fine_input", "held_input"]

Floats = NDArray[np.float64]
_FINER = 8  # points per sample of the straight lines that approximate a band-limited input
_PIECES = {"first": 8, "band-limited": 2}  # held values for each straight line


def fine_input(record: Record) -> tuple[Floats, float]:
    """Return the points of the input and their rate.

    Args:
        record: has the input and its hold.
    Returns:
        Input, and its rate in Hz. A band-limited input is interpolated to a higher rate.
    """
    u, rate_hz = record.u, record.input_rate_hz
    if record.hold == "band-limited":
        u = resample_poly(u, _FINER, 1, window=("kaiser", 9.0), padtype="line")
        # Straight lines damp a tone by 1 - (omega T)^2/12; the second difference corrects that.
        u[1:-1] -= np.diff(u, 2) / 12.0
        rate_hz *= _FINER
    return np.ascontiguousarray(u), rate_hz


def held_input(record: Record) -> tuple[Floats, float]:
    """Return the input as held values; an input that is not held is approximated by small steps.

    Args:
        record: has the input and its hold.
    Returns:
        Input, and its rate in Hz.
    Example:
        >>> time_s = np.arange(8) / 2.0
        >>> ramp = Record(time_s, 2.0, time_s**2, time_s, None, hold="first")
        >>> values, rate_hz = held_input(ramp)
        >>> rate_hz, float(values[0]), float(values[-1])
        (16.0, 0.03125, 3.5)
    """
    u, rate_hz = fine_input(record)
    if record.hold == "zero":
        return u, rate_hz
    count = _PIECES[record.hold]
    share = (np.arange(count) + 0.5) / count  # the mean of each part of the line
    pieces = u[:-1, np.newaxis] + np.diff(u)[:, np.newaxis] * share
    return np.append(pieces.ravel(), u[-1]), rate_hz * count
