"""Feedthrough of the voltage to a sensed strain, from a record of fast motion."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate, InputError

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

__all__ = ["fit_feedthrough"]

Floats = NDArray[np.float64]
_FEWEST = 50  # values
_MAP_STD = 0.01  # by errors of the map; 0.011 (rms) in 7 studies of Peano and curling twins
_PARTS = 20  # of the record, each of which is left out once


def fit_feedthrough(
    time_s: Floats,
    sensed: Floats,
    static: Floats,
    frame_s: Floats,
    strain: Floats,
    modelled: Floats,
) -> Estimate:
    r"""Fit the fraction of a sensed strain that follows the voltage without the plant's dynamics.

    The map from capacitance to strain holds for slow changes. In fast motion, a capacitance that
    depends on the voltage besides the length gives

    $y_\mathrm{sensed} = b\,y + c\,y_\mathrm{static} + f(y, y_\mathrm{static}) + \tau\,\dot y$

    with the measured strain $y$ and the strain $y_\mathrm{static}$ that the present voltage would
    hold. $f$ has an offset and all terms of second and third degree, because the motion of a
    record may be large; $\tau$ is the time difference of both measurements. The fraction is that
    of small motion about strain 0, $d = c / (b + c)$.

    Args:
        time_s: of the sensed strains. Shape `(N,)`.
        sensed: strain by the map, NaN where sensing failed. Shape `(N,)`.
        static: strain that the voltage at each time would hold. Shape `(N,)`.
        frame_s: times of the measured strain, rising. Shape `(F,)`.
        strain: measured by camera or sensor. Shape `(F,)`.
        modelled: the same strain by a model that was fitted to it and depends on the drive alone.
            It is the instrument of the fit: noise of the measured strain, which is in both sides of
            the equation, would look like feedthrough. Shape `(F,)`.
    Returns:
        The fraction d; 0 for a capacitance that depends on the length alone. Its standard deviation
        is that of the jackknife with 20 parts of the record, which allows for correlated residuals,
        and contains the interpolation between the frames and errors of the map (0.01).
    Raises:
        InputError: Fewer than 50 sensed strains within the measured ones.
    Source: instrumental variables, T. Soederstrom and P. Stoica, System Identification (1989),
        chapter 8; jackknife, B. Efron and C. Stein, Annals of Statistics 9 (1981), 586.
    Example:
        >>> t = np.arange(0.0, 10.0, 0.01)
        >>> static = np.sin(t**2)
        >>> length = np.sin(t**2 - 0.5 * t) / (1.0 + 0.1 * t)
        >>> found = fit_feedthrough(t, 0.7 * length + 0.3 * static, static, t, length, length)
        >>> round(found.value, 3)
        0.3
    """
    from scipy.interpolate import CubicSpline

    inside = np.isfinite(sensed) & (time_s >= frame_s[0]) & (time_s <= frame_s[-1])
    if np.count_nonzero(inside) < _FEWEST:
        raise InputError(
            f"{np.count_nonzero(inside)} sensed strains are within the measured ones, but "
            f"{_FEWEST} are needed. Record longer, or check the sensing."
        )
    time_s, sensed, static = time_s[inside], sensed[inside], static[inside]
    frames = np.stack([strain, modelled], axis=1)
    fraction, std = _fitted(CubicSpline(frame_s, frames), time_s, sensed, static)
    # With half the frames the error of a cubic spline is 16 times as large.
    kept = np.r_[0 : frame_s.size - 1 : 2, frame_s.size - 1]
    coarse, _ = _fitted(CubicSpline(frame_s[kept], frames[kept]), time_s, sensed, static)
    return Estimate.normal(fraction, math.hypot(std, (coarse - fraction) / 15.0, _MAP_STD), "")


def _fitted(at: CubicSpline, time_s: Floats, sensed: Floats, static: Floats) -> tuple[float, float]:
    """Fraction and its standard deviation, with measured and modelled strain between the frames."""
    strains, rates = at(time_s), at(time_s, 1)
    size, speed = float(np.abs(static).max()), float(np.abs(rates[:, 1]).max())
    measured, instruments = (
        _columns(static / size, strains[:, k] / size, rates[:, k] / speed) for k in (0, 1)
    )
    edges = np.linspace(0, sensed.size, _PARTS + 1).astype(int)
    parts = [slice(*ends) for ends in itertools.pairwise(edges)]
    left = np.stack([instruments[part].T @ measured[part] for part in parts])
    right = np.stack([instruments[part].T @ sensed[part] for part in parts])
    fraction = _fraction(left.sum(axis=0), right.sum(axis=0))
    others = np.array(
        [
            _fraction(left.sum(axis=0) - own_left, right.sum(axis=0) - own_right)
            for own_left, own_right in zip(left, right, strict=True)
        ]
    )
    spread = (_PARTS - 1.0) / _PARTS * float(((others - others.mean()) ** 2).sum())
    return fraction, math.sqrt(spread)


def _fraction(left: Floats, right: Floats) -> float:
    """Fraction by the sums of the normal equations."""
    by_length, by_voltage = (np.linalg.pinv(left) @ right)[:2].tolist()
    return float(by_voltage / (by_length + by_voltage))


def _columns(static: Floats, strain: Floats, rate: Floats) -> Floats:
    """Terms of the equation, of strains and a rate of about 1."""
    powers = [strain**i * static**j for i in range(4) for j in range(4 - i) if i + j > 1]
    return np.stack([strain, static, np.ones_like(static), rate, *powers], axis=1)
