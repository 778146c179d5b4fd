"""Check of the stated standard deviations against the scatter of the blocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from haselab.sensing.sensed import Sensed

__all__ = ["widen_deviations"]

Floats = NDArray[np.float64]
_WINDOW = 301  # blocks over which the scatter is evaluated
_LAGS = (1, 3)  # distances of the compared blocks
_FEWEST = 20
_CLEAR = 4.0  # standard deviations of the estimated scatter
_EFFICIENCY = 1.7  # standard deviation of the median of second differences, times root of count
_NORMAL = 1.4826  # standard deviation over the median of a normal variable's size
_TEXT = "scatter of the blocks beyond their noise"


def widen_deviations(sensed: Sensed) -> Sensed:
    """Widen standard deviations that are smaller than the scatter of the blocks.

    Noise and tones near the carrier can be constant within a block and differ from block to block.
    They scatter both parts of the impedance equally, while a strain changes the reactance smoothly
    and the resistance with it. Therefore the second differences of the reactance between blocks,
    and those of the resistance without the part correlated with the reactance, are compared with
    their standard deviations. The smaller of both ratios is used.

    Args:
        sensed: blocks of one record, in order.
    Returns:
        The same results with wider standard deviations, and a text for these blocks.
    Example:
        >>> from haselab.sensing import Lockin, LockinConfig
        >>> config = LockinConfig(200e3, 2000, 2000.0, 0.0, ohm_per_ratio=1e6)
        >>> rng = np.random.default_rng(1)
        >>> slow = np.repeat(rng.standard_normal((60, 2)), 2000, axis=0)
        >>> angle = 2 * np.pi * 0.01 * np.arange(120_000)
        >>> tone = slow[:, 0] * np.cos(angle) + slow[:, 1] * np.sin(angle)
        >>> v = 1000 * np.cos(angle) + rng.standard_normal(120_000)
        >>> i = -1000 * np.sin(angle) + rng.standard_normal(120_000) + 5 * tone
        >>> sensed = Lockin(config).sense_channels(v, i)
        >>> error = sensed.capacitance_f / np.median(sensed.capacitance_f) - 1
        >>> bool(0.7 < np.mean(sensed.capacitance_std_f) / 8e-11 / error.std() < 1.4)
        True
    """
    count = sensed.valid.size
    if count < _FEWEST:
        return sensed
    with np.errstate(invalid="ignore", divide="ignore"):
        std = sensed.resistance_std_ohm  # of either quadrature
        reactance = sensed.capacitance_f / sensed.capacitance_std_f * std
        ratios = [_beyond(sensed.resistance_ohm, reactance, std, lag) for lag in _LAGS]
    ratio = np.fmax.reduce(ratios)
    wide = sensed.valid & np.isfinite(ratio)
    if not wide.any():
        return sensed
    factor = np.where(wide, ratio, 1.0)
    seen = dict(sensed.seen)
    for k in np.flatnonzero(wide).tolist():
        seen[k] = f"{seen[k]}; {_TEXT}" if seen.get(k) else _TEXT
    return replace(
        sensed,
        capacitance_std_f=sensed.capacitance_std_f * factor,
        resistance_std_ohm=sensed.resistance_std_ohm * factor,
        seen=seen,
    )


def _beyond(resistance: Floats, reactance: Floats, std: Floats, lag: int) -> Floats:
    """Scatter relative to its std; NaN where it is not clearly above 1."""
    found = np.full(std.size, np.nan)
    if std.size <= 2 * lag:
        return found
    scale = np.sqrt(std[2 * lag :] ** 2 + 4.0 * std[lag:-lag] ** 2 + std[: -2 * lag] ** 2)
    one, other = (
        (values[2 * lag :] - 2.0 * values[lag:-lag] + values[: -2 * lag]) / scale
        for values in (resistance, reactance)
    )
    known = np.flatnonzero(np.isfinite(one) & np.isfinite(other))
    if known.size < _FEWEST:
        return found
    one, other = one[known], other[known]
    one = one - other * (one @ other) / (other @ other)  # without the part due to strain
    window = min(_WINDOW, known.size)
    spread = np.minimum(*(_NORMAL * _medians(np.abs(d), window) for d in (one, other)))
    spread[spread < 1.0 + _CLEAR * _EFFICIENCY / np.sqrt(window)] = np.nan
    at = np.clip(np.searchsorted(known + lag, np.arange(std.size)), 0, known.size - 1)
    found[:] = spread[at]
    return found


def _medians(values: Floats, window: int) -> Floats:
    """Running medians; the overall median if the window contains half of the values."""
    if values.size < 2 * window:
        return np.full(values.size, np.median(values))
    return np.asarray(median_filter(values, window, mode="mirror"))
