"""Detection of records in steady state at a single tone."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len, rfft
from scipy.optimize import minimize_scalar

from haselab.identify.noise import whiteness_p
from haselab.identify.record import Record

__all__ = ["steady_tone_hz"]

Floats = NDArray[np.float64]
_PURE = 1e-4  # of the input's energy that may be outside its tone
_FEWEST_PERIODS = 2.0
_WHITE = 1e-3
_FINER = 4  # padding of the spectrum


def steady_tone_hz(record: Record) -> float | None:
    """Frequency of a record whose input is one tone and whose output is the same tone plus noise.

    Whatever its length, such a record determines two parameters: gain and phase at that
    frequency. A transient at its start, another tone or a change of the input would be detected.

    Args:
        record: input and output.
    Returns:
        Frequency in Hz; None for any other record.
    Example:
        >>> time_s = np.arange(2000) / 100.0
        >>> u, y = np.sin(3.0 * time_s), 0.4 * np.sin(3.0 * time_s - 1.0)
        >>> y = y + 0.01 * np.random.default_rng(2).normal(size=2000)
        >>> round(2 * np.pi * steady_tone_hz(Record.sampled(u, y, 100.0)), 2)
        3.0
    """
    u = record.u
    if u.size < 8 or np.ptp(u) == 0.0:
        return None
    time_s = np.arange(u.size) / record.input_rate_hz
    size = next_fast_len(_FINER * u.size, real=True)
    spectrum = np.abs(rfft((u - u.mean()) * np.hanning(u.size), size))
    bin_hz = record.input_rate_hz / size
    peak_hz = float(np.argmax(spectrum)) * bin_hz
    if peak_hz * u.size / record.input_rate_hz < _FEWEST_PERIODS:
        return None
    near = (peak_hz - _FINER * bin_hz, peak_hz + _FINER * bin_hz)
    found = minimize_scalar(
        lambda hz: float(np.sum(_beside(u, time_s, hz) ** 2)),
        bounds=near, method="bounded", options={"xatol": 1e-6 * bin_hz},
    )  # fmt: skip
    if found.fun > _PURE * float(np.sum((u - u.mean()) ** 2)):
        return None
    rest = _beside(record.y, record.output_time_s, float(found.x))
    return float(found.x) if whiteness_p([rest]) > _WHITE else None


def _beside(values: Floats, time_s: Floats, hz: float) -> Floats:
    """Residuals of a constant and one tone."""
    angle = 2.0 * math.pi * hz * time_s
    basis = np.stack([np.ones(values.size), np.cos(angle), np.sin(angle)], axis=1)
    factors, *_ = np.linalg.lstsq(basis, values, rcond=None)
    return np.asarray(values - basis @ factors)
