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
_LEAST_MISSING = 0.05  # of the static strain, by which fast motion differs from it
_MOST_NOISE = 2.0  # of the modelled strain
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
        and contains the interpolation between the frames, errors of the map (0.01), and half of the
        difference from $1 - b$, which errors of the map and of the static strain cause.
    Raises:
        InputError: Fewer than 50 sensed strains within the measured ones; values that do not fit
            together; a motion that is too slow, or smaller than its noise.
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

    _check(time_s, sensed, static, frame_s, strain, modelled)
    inside = np.isfinite(sensed) & (time_s >= frame_s[0]) & (time_s <= frame_s[-1])
    if np.count_nonzero(inside) < _FEWEST:
        raise InputError(
            f"{np.count_nonzero(inside)} sensed strains are within the measured ones, but "
            f"{_FEWEST} are needed. Record longer, or check the sensing."
        )
    time_s, sensed, static = time_s[inside], sensed[inside], static[inside]
    frames = np.stack([strain, modelled], axis=1)
    whole = CubicSpline(frame_s, frames)
    _check_motion(static, whole(time_s))
    found, std = _fitted(whole, time_s, sensed, static)
    # With half the frames the error of a cubic spline is 16 times as large.
    kept = np.r_[0 : frame_s.size - 1 : 2, frame_s.size - 1]
    coarse, _ = _fitted(CubicSpline(frame_s[kept], frames[kept]), time_s, sensed, static)
    # Without errors of the map and of the static strain, 1 - b is the fraction too.
    doubt = 0.5 * (1.0 - found[0] - found[1])
    interpolated = (coarse[1] - found[1]) / 15.0
    return Estimate.normal(found[1], math.hypot(std, interpolated, doubt, _MAP_STD), "")


def _check(
    time_s: Floats, sensed: Floats, static: Floats, frame_s: Floats, strain: Floats, model: Floats
) -> None:
    """Refuse records of unequal lengths, without order, with gaps or with too few frames."""
    if not (time_s.shape == sensed.shape == static.shape and time_s.ndim == 1):
        raise InputError(
            f"Times, sensed and static strains have the shapes {time_s.shape}, {sensed.shape} and "
            f"{static.shape}. Give one value of each for each time."
        )
    if not (frame_s.shape == strain.shape == model.shape and frame_s.ndim == 1):
        raise InputError(
            f"Frame times, measured and modelled strains have the shapes {frame_s.shape}, "
            f"{strain.shape} and {model.shape}. Give one value of each for each frame."
        )
    if frame_s.size < _FEWEST or not (np.diff(frame_s) > 0.0).all():
        raise InputError(
            f"The {frame_s.size} frame times must rise, and {_FEWEST} or more are needed. Sort "
            "them, or record longer."
        )
    for name, values in (("static", static), ("measured", strain), ("modelled", model)):
        if not np.isfinite(values).all():
            raise InputError(f"A {name} strain is not finite. Leave this time out.")


def _check_motion(static: Floats, strains: Floats) -> None:
    """Refuse records that cannot show the fraction: slow ones, and mere noise."""
    measured, modelled = strains.T
    size, missing = np.std(modelled), np.std(static - modelled)
    if not missing > _LEAST_MISSING * np.std(static):
        raise InputError(
            f"The strain follows its static value within {_LEAST_MISSING:.0%}: the motion is too "
            "slow to show how much of the sensed strain follows the drive at once. Record a chirp "
            "up to the resonance."
        )
    if not np.std(measured - modelled) < _MOST_NOISE * size:
        raise InputError(
            f"The modelled strain of {size:.2g} (rms) differs from the measured one by "
            f"{np.std(measured - modelled):.2g}. Use a larger amplitude, or a better model."
        )


def _fitted(
    at: CubicSpline, time_s: Floats, sensed: Floats, static: Floats
) -> tuple[tuple[float, float], float]:
    """Factor b, the fraction, and its standard deviation; with both strains between the frames."""
    strains, rates = at(time_s), at(time_s, 1)
    size, speed = float(np.abs(static).max()), float(np.abs(rates[:, 1]).max())
    measured, instruments = (
        _columns(static / size, strains[:, k] / size, rates[:, k] / speed) for k in (0, 1)
    )
    edges = np.linspace(0, sensed.size, _PARTS + 1).astype(int)
    parts = [slice(*ends) for ends in itertools.pairwise(edges)]
    left = np.stack([instruments[part].T @ measured[part] for part in parts])
    right = np.stack([instruments[part].T @ (sensed[part] / size) for part in parts])
    found = _fraction(left.sum(axis=0), right.sum(axis=0))
    others = np.array(
        [
            _fraction(left.sum(axis=0) - own_left, right.sum(axis=0) - own_right)[1]
            for own_left, own_right in zip(left, right, strict=True)
        ]
    )
    spread = (_PARTS - 1.0) / _PARTS * float(((others - others.mean()) ** 2).sum())
    return found, math.sqrt(spread)


def _fraction(left: Floats, right: Floats) -> tuple[float, float]:
    """Factor b and the fraction by the sums of the normal equations."""
    by_length, by_voltage = (np.linalg.pinv(left) @ right)[:2].tolist()
    whole = by_length + by_voltage
    return by_length, by_voltage / whole if whole else math.inf


def _columns(static: Floats, strain: Floats, rate: Floats) -> Floats:
    """Terms of the equation, of strains and a rate of about 1."""
    powers = [strain**i * static**j for i in range(4) for j in range(4 - i) if i + j > 1]
    return np.stack([strain, static, np.ones_like(static), rate, *powers], axis=1)
