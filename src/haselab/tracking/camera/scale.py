"""Metres per pixel with uncertainty, from two points, a ruler or a checkerboard."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from haselab.base import Estimate, InputError, ResultError
from haselab.tracking.options import Floats

__all__ = ["scale_from_checkerboard", "scale_from_points", "scale_from_ruler"]

_CLICK_STD_PX = 12.0**-0.5  # a position given to the whole pixel
_ACROSS = 5  # parallel lines averaged over a ruler
_FEWEST_TICKS = 4
_LEAST_SHARE = 0.2  # of the profile's power required of the ticks and their harmonics
_CORNER_PX = 0.03  # common error of the corners of one board, found with synthetic boards
_UNIT = "m/px"


def _estimate(value: float, std: float) -> Estimate:
    return Estimate.normal(value, std, _UNIT)


def _distance_px(a_px: Floats, b_px: Floats) -> float:
    a, b = np.asarray(a_px, float), np.asarray(b_px, float)
    if a.shape != (2,) or b.shape != (2,) or not np.isfinite([a, b]).all():
        raise InputError(f"Two points [x, y] are required, not {a.tolist()} and {b.tolist()}.")
    distance = float(np.hypot(*(b - a)))
    if distance < 1.0:
        raise InputError(
            f"The two points are {distance:g} px apart; a scale needs at least 1 px, better "
            "hundreds. Choose points far from each other."
        )
    return distance


def _check_length(name: str, length_m: float) -> None:
    if not (np.isfinite(length_m) and length_m > 0.0):
        raise InputError(
            f"{name} = {length_m:g} m is not a positive length. Give the measured length."
        )


def scale_from_points(
    a_px: Floats, b_px: Floats, length_m: float, *, point_std_px: float = _CLICK_STD_PX
) -> Estimate:
    r"""Scale from two points at a known distance: $s = L/d$, $\sigma_s = s\,\sqrt2\,\sigma_p/d$.

    Args:
        a_px, b_px: the points `[x, y]`, in px. Shape `(2,)`.
        length_m: distance between them, in m.
        point_std_px: standard deviation of a point along each axis, in px; by default that of a
            position given to the whole pixel.

    Returns:
        Metres per pixel.

    Raises:
        InputError: points less than 1 px apart, or a length that is not positive.

    Example:
        >>> round(scale_from_points(np.array([0, 0]), np.array([300, 400]), 0.05).value, 9)
        0.0001
    """
    distance = _distance_px(a_px, b_px)
    _check_length("length_m", length_m)
    scale = length_m / distance
    return _estimate(scale, scale * np.sqrt(2.0) * point_std_px / distance)


def _profile(image: NDArray[np.generic], a: Floats, b: Floats) -> tuple[Floats, float]:
    """Grey levels along a line, averaged over five parallel lines, and their spacing in px."""
    distance = _distance_px(a, b)
    height, width = image.shape
    ends = np.stack([a, b])
    if (ends < 0).any() or (ends > np.array([width - 1, height - 1])).any():
        raise InputError(
            f"The ruler from {a.tolist()} to {b.tolist()} px is not inside the {width} x {height} "
            "px image. Give two points inside it."
        )
    count = int(np.ceil(2.0 * distance)) + 1
    along = a + np.linspace(0.0, 1.0, count)[:, None] * (b - a)
    normal = np.array([-(b - a)[1], (b - a)[0]]) / distance
    offsets = np.arange(_ACROSS) - (_ACROSS - 1) / 2
    places = along[None] + offsets[:, None, None] * normal
    grey = map_coordinates(image.astype(float), [places[..., 1], places[..., 0]], order=3)
    return np.asarray(grey.mean(axis=0)), distance / (count - 1)


def _harmonic_power(profile: Floats, place_px: Floats, period_px: float, harmonics: int) -> float:
    """Power of the profile at a period and its harmonics."""
    phase = 2.0 * np.pi * np.outer(np.arange(1, harmonics + 1), place_px) / period_px
    rows = np.concatenate([np.cos(phase), np.sin(phase)])
    return float(np.sum((rows @ profile) ** 2))


def scale_from_ruler(
    image: NDArray[np.generic], a_px: Floats, b_px: Floats, tick_m: float
) -> Estimate:
    r"""Scale from the ticks of a ruler along a line: their period, fitted to all ticks.

    The period with the most power, including its second and third harmonic; the standard
    deviation is the Cramér-Rao bound of a frequency in white noise of the fit's residual,
    $\sigma_f^2 = 6\,\sigma^2 / (\pi^2 N L^2 \sum_k k^2 A_k^2)$.

    Args:
        image: grey levels. Shape `(H, W)`.
        a_px, b_px: two points `[x, y]` on the ruler between which the ticks run, in px.
        tick_m: from tick to tick, in m.

    Returns:
        Metres per pixel.

    Raises:
        InputError: the line leaves the image, or is shorter than 1 px.
        ResultError: no regular ticks.

    Source: Rife and Boorstyn 1974 (single-tone parameter estimation), eq. 18.

    Example:
        >>> x = np.arange(400.0)
        >>> ruler = np.tile(128 + 50 * np.cos(2 * np.pi * x / 12.5), (40, 1))
        >>> scale = scale_from_ruler(ruler, np.array([10, 20]), np.array([390, 20]), 1e-3)
        >>> round(scale.value * 12.5 * 1e3, 4)
        1.0
    """
    _check_length("tick_m", tick_m)
    a, b = np.asarray(a_px, float), np.asarray(b_px, float)
    profile, step = _profile(image, a, b)
    place = np.asarray(step * np.arange(profile.size), np.float64)
    length = place[-1]
    slope = np.polynomial.Polynomial.fit(place, profile, 2)
    profile = profile - slope(place)
    window = np.hanning(profile.size)
    lowest, highest = _FEWEST_TICKS / length, 1.0 / 3.0  # ticks of at least 3 px
    trial = np.arange(lowest, highest, 0.1 / length)
    if not trial.size:
        raise ResultError(
            f"The line of {length:.0f} px is too short for {_FEWEST_TICKS} ticks. Use a longer "
            "part of the ruler."
        )
    weighted = profile * window
    # Half the frequency of a comb also contains its power, in its second harmonic; the fundamental
    # must contribute, so it is counted twice.
    score = [
        _harmonic_power(weighted, place, 1 / f, 3) + _harmonic_power(weighted, place, 1 / f, 1)
        for f in trial
    ]
    frequency = float(trial[int(np.argmax(score))])
    for width in (0.1 / length, 0.01 / length, 0.001 / length):
        near = frequency + width * np.linspace(-1.0, 1.0, 21)
        power = [_harmonic_power(weighted, place, 1 / f, 3) for f in near]
        frequency = float(near[int(np.argmax(power))])
    return _ruler_estimate(profile, place, frequency, tick_m)


def _ruler_estimate(profile: Floats, place: Floats, frequency: float, tick_m: float) -> Estimate:
    order = np.arange(1, 4)
    phase = 2.0 * np.pi * frequency * np.outer(place, order)
    rows = np.hstack([np.cos(phase), np.sin(phase), np.ones((place.size, 1))])
    fit = np.linalg.lstsq(rows, profile, rcond=None)[0]
    residual = profile - rows @ fit
    explained = 1.0 - float(residual @ residual) / max(float(profile @ profile), 1e-12)
    if explained < _LEAST_SHARE:
        raise ResultError(
            f"No regular ticks along the line: the best period explains {100 * explained:.0f} % "
            f"of its grey levels, {100 * _LEAST_SHARE:.0f} % are required. Place the line across "
            "the ticks, or give two points with --scale-points."
        )
    amplitude2 = fit[:3] ** 2 + fit[3:6] ** 2
    length = place[-1]
    noise = float(residual @ residual) / (place.size - 7)
    curvature = float(np.sum(order**2 * amplitude2))
    std = np.sqrt(6.0 * noise / (np.pi**2 * place.size * length**2 * curvature))
    # neighbours half a pixel apart have correlated noise, so two count as one
    std *= np.sqrt(2.0)
    return _estimate(tick_m * frequency, tick_m * float(std))


def scale_from_checkerboard(corners_px: Floats, square_m: float) -> Estimate:
    """Scale from the inner corners of a checkerboard facing the camera.

    The mean side over both directions, by least squares over all corners; the scatter of the
    corners about the regular grid gives the standard deviation, plus a common 0.03 px.

    Args:
        corners_px: inner corners `[x, y]`, row by row, in px. Shape `(R, C, 2)`.
        square_m: side of a square, in m.

    Returns:
        Metres per pixel.

    Raises:
        InputError: fewer than 2 x 2 corners, or a side that is not positive.
        ResultError: the board is tilted, so its sides differ by more than 2 %.

    Example:
        >>> board = np.stack(np.meshgrid(np.arange(7) * 20.0, np.arange(5) * 20.0), axis=-1)
        >>> round(scale_from_checkerboard(board, 0.002).value, 9)
        0.0001
    """
    corners = np.asarray(corners_px, float)
    _check_length("square_m", square_m)
    if corners.ndim != 3 or corners.shape[2] != 2 or min(corners.shape[:2]) < 2:
        raise InputError(
            f"corners_px has shape {corners.shape}, expected (R, C, 2) with R, C >= 2."
        )
    rows, columns = corners.shape[:2]
    v, u = np.mgrid[:rows, :columns]
    design = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1).astype(float)
    flat = corners.reshape(-1, 2)
    fit, *_ = np.linalg.lstsq(design, flat, rcond=None)
    sides = np.hypot(*fit[:2].T)
    if abs(sides[0] / sides[1] - 1.0) > 0.02:
        raise ResultError(
            f"The board's sides are {sides[0]:.2f} and {sides[1]:.2f} px long, so it is tilted. "
            "Hold it in the plane of the motion, facing the camera."
        )
    residual = flat - design @ fit
    noise = float(np.sum(residual**2)) / max(2 * len(flat) - 6, 1)
    spread = np.linalg.inv(design.T @ design)
    side = float(sides.mean())
    side_var = 0.25 * noise * (spread[0, 0] + spread[1, 1])
    side_var += 2.0 * (_CORNER_PX / (max(rows, columns) - 1)) ** 2
    value = square_m / side
    return _estimate(value, value * float(np.sqrt(side_var)) / side)
