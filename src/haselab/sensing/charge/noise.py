"""Noise of both monitors from the record itself, effect of converter steps, and hum."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb, erfc

import numpy as np
from numpy.typing import NDArray

__all__ = ["Noise", "dither_of", "hum_of", "noise_of"]

Floats = NDArray[np.float64]

_ORDERS = (2, 4, 6, 8)  # orders of differences; a higher order leaves less of the drive
_NORMAL = 0.6745  # median of |x| over the standard deviation of a normal distribution
_LONGEST = 1 << 17  # largest number of points used
_CLEAR_HUM = 60.0  # power of the line over its surroundings
_HUM_BAND_HZ = 5.0
_BESIDE = 5  # samples of a median on either side of a pair
_FEWEST_PAIRS = 200
_STDS = np.linspace(0.05, 0.8, 76)  # of the noise, in steps; above, no correction is needed
_DISCRETE = 3  # levels of the current for ramps with holds
_ALONE = 6.0  # power of the line over the neighbouring one
_FASTEST = 1e-3  # share of the drive's energy above half of the hum's frequency


@dataclass(frozen=True)
class Noise:
    """Noise of one point, in the unit of the readings.

    Args:
        v_var: variance of the voltage.
        i_var: variance of the current.
        coarse: relative error of a charge by current steps that noise does not average out.
        v_step: of the converter on the voltage, 0 for none.
    """

    v_var: float
    i_var: float
    coarse: float
    v_step: float = 0.0


def noise_of(
    v: Floats,
    i: Floats,
    runs: list[slice],
    step: Floats,
    thinning: int,
    dither: NDArray[np.intp] | None = None,
) -> Noise:
    r"""Noise above the band of the drive, by high differences.

    Args:
        v: voltage, shape `(blocks, points)`.
        i: current, the same shape.
        runs: runs of blocks that count.
        step: of the converter on each channel, 0 for none; shape `(2,)`.
        thinning: samples averaged per point.
        dither: of the current, see `dither_of`; None: not counted.
    Returns:
        Variances, none below $\Delta^2/12$ of the converter's step, and the remaining effect of
        the steps.
    Source: B. Widrow, I. Kollar, Quantization Noise, Cambridge 2008, ch. 5 (mean error of a
        constant under a quantiser, $\exp(-2\pi^2\sigma^2/\Delta^2)$).
    Example:
        >>> rng = np.random.default_rng(1)
        >>> v, i = rng.normal(0.0, 0.1, (2, 4, 1000))
        >>> noise = noise_of(v, i, [slice(0, 4)], np.zeros(2), 1)
        >>> round(noise.v_var ** 0.5, 2), noise.coarse
        (0.1, 0.0)
    """
    variances = []
    for channel, size in ((v, step[0]), (i, step[1])):
        measured = _variance(channel, runs)
        variances.append(max(measured, size**2 / 12.0 / thinning))
    current = np.concatenate([i[run].ravel() for run in runs])
    lsb = float(step[1])
    smear = max(variances[1] * thinning / lsb**2 - 1.0 / 12.0, 0.0) if lsb else 0.0
    if dither is not None:
        smear = min(smear, _smear(int(dither[0]), int(dither[1])))
    return Noise(variances[0], variances[1], _coarse(current, lsb, smear))


def dither_of(current: NDArray[np.generic], lsb: float) -> NDArray[np.intp]:
    """Count pairs of neighbouring samples that are two converter steps apart.

    Noise of less than half a step changes a reading between two values only, whatever
    its variance looks like. Places where the current itself steps do not count.

    Args:
        current: samples.
        lsb: step of the converter, 0 for none.
    Returns:
        Pairs that are two steps or more apart, and pairs that were examined.
    Example:
        >>> rng = np.random.default_rng(1)
        >>> dither_of(np.round(0.5 + rng.normal(0.0, 0.1, 1000)), 1.0).tolist()
        [0, 991]
    """
    flat = np.asarray(current[: 2 * _LONGEST], dtype=np.float64)
    if lsb == 0.0 or flat.size < 2 * _BESIDE:
        return np.zeros(2, dtype=np.intp)
    level = np.median(np.lib.stride_tricks.sliding_window_view(flat, _BESIDE), axis=1)
    still = np.abs(level[_BESIDE:] - level[:-_BESIDE]) < 1.5 * lsb
    apart = np.abs(np.diff(flat))[_BESIDE - 1 : flat.size - _BESIDE] > 1.5 * lsb
    return np.array([np.count_nonzero(apart & still), np.count_nonzero(still)], dtype=np.intp)


def _smear(far: int, pairs: int) -> float:
    r"""Variance of the noise before the converter, in steps, from pairs two steps apart.

    With the level uniform between two edges their share is
    $\mathrm E\max(0, |\delta| - 1)$, $\delta \sim N(0, 2\sigma^2)$, while that is below one half.
    """
    if pairs < _FEWEST_PAIRS:
        return np.inf  # the current sweeps over the steps, which also acts as dither
    std = np.sqrt(2.0) * _STDS
    normal = np.exp(-0.5 / std**2) / np.sqrt(2.0 * np.pi)
    tail = np.array([erfc(1.0 / (one * np.sqrt(2.0))) for one in std.tolist()])
    share = 2.0 * std * normal - tail
    at = int(np.searchsorted(share, (far + 1.0) / pairs))
    return float(_STDS[at] ** 2) if at < _STDS.size else np.inf


def _coarse(current: Floats, lsb: float, smear: float) -> float:
    """Relative error of a charge due to rounding of a nearly constant current."""
    low, high = np.percentile(current, (10, 90)).tolist()
    if lsb == 0.0:
        return 0.0
    if not high > low:
        return 1.0  # one step only
    _, counts = np.unique(np.round(current / lsb), return_counts=True)
    share = float((counts.astype(np.float64) ** 2).sum()) / current.size**2
    levels = max(1.0, 1.0 / (_DISCRETE * share))  # a sweep through many steps averages over them
    error = lsb * (1.0 / 12.0) ** 0.5 * np.exp(-2.0 * np.pi**2 * smear) / levels**0.5
    return float(error / (0.5 * (high - low)))


def _variance(channel: Floats, runs: list[slice]) -> float:
    flat = [channel[run].ravel()[:_LONGEST] for run in runs]
    best = np.inf
    for order in _ORDERS:
        differences = np.concatenate([np.diff(x, order) for x in flat if x.size > order])
        if differences.size:
            size = float(np.median(np.abs(differences))) / _NORMAL
            best = min(best, size**2 / comb(2 * order, order))
    return best if np.isfinite(best) else 0.0


def hum_of(v: Floats, i: Floats, point_s: float) -> float:
    """Frequency of mains hum in the current that is not caused by the voltage.

    Args:
        v: voltage, shape `(points,)`.
        i: current, the same shape.
        point_s: time between points, in s.
    Returns:
        50 or 60 Hz; 0 without hum, or if the drive itself is that fast.
    Example:
        >>> time_s = np.arange(4000) / 1e3
        >>> i = 0.01 * np.sin(2 * np.pi * 50 * time_s)
        >>> hum_of(np.sin(time_s), i + np.cos(time_s), 1e-3)
        50.0
    """
    v, i = v[:_LONGEST], i[:_LONGEST]
    if v.size * point_s < 4.0 / _HUM_BAND_HZ:
        return 0.0
    window = np.hanning(v.size)
    hz = np.fft.rfftfreq(v.size, point_s)
    spectrum = np.fft.rfft((v - v.mean()) * window)
    fast = 2j * np.pi * hz * spectrum
    drawn = np.fft.rfft((i - i.mean()) * window)
    slow = hz < 0.25 * _HUM_BAND_HZ * 8.0
    kappa = float((np.conj(fast) * drawn)[slow].sum().real / (np.abs(fast[slow]) ** 2).sum())
    left = np.abs(drawn - kappa * fast) ** 2
    best, at = 0.0, 0.0
    for line_hz in (50.0, 60.0):
        near = np.abs(hz - line_hz) < max(0.3, 2.5 * hz[1])
        beside = (np.abs(hz - line_hz) < _HUM_BAND_HZ) & ~near
        if not near.any() or not beside.any():
            continue
        clear = left[near].max() > _CLEAR_HUM * np.median(left[beside])
        clear &= left[near].max() > _ALONE * left[beside].max()  # not a harmonic of the drive
        quick = (np.abs(spectrum[hz > 0.5 * line_hz]) ** 2).sum()
        drive_is_slow = quick < _FASTEST * (np.abs(spectrum) ** 2).sum()
        if clear and drive_is_slow and left[near].max() > best:
            best, at = float(left[near].max()), line_hz
    return at
