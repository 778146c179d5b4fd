"""Drive signals: one value for each output update."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError

__all__ = ["constant", "linear_chirp", "triangle"]


def _count(duration_s: float, rate_hz: float) -> int:
    if not (duration_s > 0.0 and rate_hz > 0.0):
        raise InputError(
            f"Duration {duration_s:g} s at {rate_hz:g} Hz gives no sample; both must be positive."
        )
    return round(duration_s * rate_hz)


def constant(level: float, duration_s: float, rate_hz: float) -> NDArray[np.float64]:
    """One level.

    Args:
        level: value of every sample, any unit.
        duration_s: length, in s.
        rate_hz: updates per second.
    Returns:
        Samples, shape `(round(duration_s * rate_hz),)`.
    Raises:
        InputError: no sample at all.
    Example:
        >>> constant(1.0, 0.03, 100.0)
        array([1., 1., 1.])
    """
    return np.full(_count(duration_s, rate_hz), float(level))


def triangle(
    low: float, high: float, frequency_hz: float, cycles: int, rate_hz: float
) -> NDArray[np.float64]:
    """Triangle from `low` up to `high` and back.

    Args:
        low: start, any unit.
        high: peak, same unit.
        frequency_hz: of one rise and fall.
        cycles: how many.
        rate_hz: updates per second.
    Returns:
        Samples, shape `(round(cycles / frequency_hz * rate_hz),)`.
    Raises:
        InputError: no sample at all.
    Source: reference study, row S2.
    Example:
        >>> triangle(0.0, 2.0, 0.25, 1, 2.0)
        array([0. , 0.5, 1. , 1.5, 2. , 1.5, 1. , 0.5])
    """
    time_s = np.arange(_count(cycles / frequency_hz, rate_hz)) / rate_hz
    phase = (time_s * frequency_hz) % 1.0
    rise: NDArray[np.float64] = 1.0 - np.abs(2.0 * phase - 1.0)
    return low + (high - low) * rise


def linear_chirp(
    start_hz: float, stop_hz: float, duration_s: float, rate_hz: float
) -> NDArray[np.float64]:
    r"""Sine of unit amplitude whose frequency grows linearly.

    $x = \sin 2\pi\,(f_0 t + (f_1 - f_0)\,t^2 / 2T)$

    Args:
        start_hz: frequency at the start.
        stop_hz: frequency at the end.
        duration_s: length, in s.
        rate_hz: updates per second.
    Returns:
        Samples, shape `(round(duration_s * rate_hz),)`.
    Raises:
        InputError: no sample, or a frequency at or above half the update rate.
    Source: reference study, row S2.
    Example:
        >>> linear_chirp(0.1, 10.0, 10.0, 100.0).shape
        (1000,)
    """
    if not 0.0 <= min(start_hz, stop_hz) <= max(start_hz, stop_hz) < 0.5 * rate_hz:
        raise InputError(
            f"Chirp {start_hz:g} to {stop_hz:g} Hz needs frequencies in [0, {0.5 * rate_hz:g}) Hz. "
            "Lower them or raise the update rate."
        )
    time_s = np.arange(_count(duration_s, rate_hz)) / rate_hz
    sweep_hz_s = (stop_hz - start_hz) / duration_s
    return np.sin(2.0 * np.pi * (start_hz * time_s + 0.5 * sweep_hz_s * time_s**2))
