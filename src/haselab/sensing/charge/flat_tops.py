"""Flat tops: a monitor that saturates below the converter's full scale, without a carrier."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab.sensing.charge.noise import Noise
from haselab.sensing.charge.path import runs_of

__all__ = ["flat_tops"]

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

_PILED = 10  # fewest points at one extreme value
_PILED_SHARE = 2e-4
_NOISY = 3  # distinct values near the extreme
_BAND = 6.0  # standard deviations below the extreme that count as flat top
_SHORTEST = 8  # points of a flat top
_WINDOW = 64  # largest number of points before and after its edge
_CLEAR = 6.0  # standard deviations
_STANDS = 0.25  # of the earlier change of the voltage: less counts as constant
_FLOWS = 0.5  # of the earlier current: more counts as flowing
_CURVED = 0.05  # change of the voltage's slope at constant current
_NARROW = 0.1  # of the current: width of its flat top
_SMOOTH = 16  # points of the current that are averaged


def flat_tops(
    v: Floats,
    i: Floats,
    noise: Noise,
    lsb: Floats,
    without_hum: tuple[Floats, Floats] | None = None,
) -> tuple[Flags, Flags]:
    """Find points at which a monitor stays at its extreme value while the other one changes.

    A monitor that saturates has one value far more often than noise reaches an
    extreme. If it has noise, the other monitor decides: at the edge of a flat top of
    the voltage the current would stop, and during one of the current the voltage has a constant
    slope.

    Args:
        v: voltage of one run, shape `(points,)`.
        i: current minus its offset, the same shape.
        noise: of a point.
        lsb: step of the converter on each channel, 0 for none.
        without_hum: voltage and current with hum subtracted, if any.
    Returns:
        Points of the voltage and of the current, each of shape `(points,)`.
    Example:
        >>> time_s = np.arange(2000) / 1e3
        >>> v, i = np.sin(6.28 * time_s), 6.28 * np.cos(6.28 * time_s)
        >>> noise = Noise(1e-8, 1e-8, 0.0)
        >>> voltage, current = flat_tops(np.minimum(v, 0.8), i, noise, np.zeros(2))
        >>> bool(300 < voltage.sum() < 500), int(current.sum())
        (True, 0)
    """
    flat = np.zeros((2, v.size), dtype=np.bool_)
    slow_v, slow_i = without_hum or (v, i)
    for sign in (1.0, -1.0):
        flat[0] |= _piled(sign * v, noise.v_var, float(lsb[0]))
        flat[0] |= _flat_voltage(sign * slow_v, sign * slow_i, noise)
        flat[1] |= _piled(sign * i, noise.i_var, float(lsb[1]))
        flat[1] |= _flat_current(sign * slow_v, sign * slow_i, noise)
    return flat[0], flat[1]


def _piled(x: Floats, variance: float, lsb: float) -> Flags:
    """Points at the largest value, if there are more than noise explains."""
    most, std = float(x.max()), variance**0.5
    top = x >= most - 1e-9 * float(np.ptp(x))
    count = np.count_nonzero(top)
    if lsb > std or count < max(_PILED, _PILED_SHARE * x.size):
        return np.zeros(x.size, dtype=np.bool_)
    below = x[~top & (x > most - 3.0 * std)]
    beside = int(np.count_nonzero(below > most - max(1.5 * lsb, 0.25 * std)))
    values, counts = np.unique(below, return_counts=True)
    beside = max(beside, int(counts[-1]) if counts.size else 0)
    noisy = values.size >= _NOISY  # otherwise the record repeats exactly
    return np.asarray(top & (noisy and count > beside), dtype=np.bool_)


def _tops(x: Floats, variance: float) -> list[slice]:
    """Runs of points within the noise of the largest value."""
    near = x >= x.max() - _BAND * variance**0.5 - 1e-9 * float(np.ptp(x))
    return [run for run in runs_of(near) if run.stop - run.start >= _SHORTEST]


def _flat_voltage(v: Floats, i: Floats, noise: Noise) -> Flags:
    """Runs at the largest voltage at whose edges the current still flows."""
    flat = np.zeros(v.size, dtype=np.bool_)
    runs = _tops(v, noise.v_var)
    moved = np.zeros(4)  # voltage before and after the edge, charge before and after it
    spread = np.zeros(2)
    for run in runs:
        for one, other, at in ((v, i, run.start), (v[::-1], -i[::-1], v.size - run.stop)):
            width = min((run.stop - run.start) // 4, _WINDOW, at)
            if width < 2:
                continue
            half = width // 2
            before, after = slice(at - width, at), slice(at, at + width)
            for k, part in enumerate((before, after)):
                moved[k] += one[part][half:].mean() - one[part][:half].mean()
                moved[2 + k] += other[part].sum()
            spread += (2.0 * noise.v_var / half, noise.i_var * width)
    v_before, v_after, q_before, q_after = moved
    clear = v_before > _CLEAR * spread[0] ** 0.5 and q_after > _CLEAR * spread[1] ** 0.5
    if clear and v_after < _STANDS * v_before and q_after > _FLOWS * q_before > 0.0:
        for run in runs:
            flat[run] = True
    return flat


def _flat_current(v: Floats, i: Floats, noise: Noise) -> Flags:
    """Runs at the largest current during which the voltage's slope has its peak.

    A capacitance that grows with the squared voltage can flatten a sine's current to the fourth
    order, which explains a change of the slope by 0.37 of the root of the band.
    """
    flat = np.zeros(v.size, dtype=np.bool_)
    if v.size < 2 * _SMOOTH:
        return flat
    mean = np.convolve(i, np.full(_SMOOTH, 1.0 / _SMOOTH), "valid")
    variance = noise.i_var / _SMOOTH
    band = _BAND * variance**0.5 / max(float(mean.max()), 1e-300)
    if not 0.0 <= band < _NARROW:
        return flat
    runs = [run for run in _tops(mean, variance) if run.stop - run.start >= 2 * _SHORTEST]
    # A current pulse is not a flat top, although its moving average looks like one.
    flowing = 0.5 * float(mean.max())
    runs = [run for run in runs if np.median(i[run.start : run.stop + _SMOOTH]) > flowing]
    inner = outer = spread = 0.0
    for run in runs:
        third = (run.stop - run.start - 1) // 3
        a, b, c, d = (float(v[run.start + _SMOOTH // 2 + k * third]) for k in range(4))
        inner += c - b
        outer += 0.5 * (b - a + d - c)
        spread += 5.0 * noise.v_var
    if inner - outer > max(max(_CURVED, 0.5 * band**0.5) * abs(inner), _CLEAR * spread**0.5):
        for run in runs:
            flat[run.start : run.stop + _SMOOTH - 1] = True
    return flat
