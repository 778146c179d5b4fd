"""Unstable poles of a closed loop, by the argument principle."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.control.gains import PidGains
from haselab.control.linear import LinearController
from haselab.control.plants.general import AnyPlant

__all__ = ["axis_factor", "open_loop_poles", "unstable_poles"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_ON_AXIS = 1e-9  # real part of a pole over its magnitude; smaller counts as on the axis
_LARGEST_TURN = 0.5  # rad between two neighbours of the grid
_ROUNDS = 40
_MOST_POINTS = 400_000
_ON_THE_EDGE = 1e-9
_NEARLY_REAL = 0.1
_DECADES = 12


def open_loop_poles(plant: AnyPlant, gains: PidGains | LinearController) -> tuple[int, Complexes]:
    """Number of open-loop poles right of the axis, and the poles on it, including conjugates.

    The controller's integrator is on the axis.
    """
    poles = np.asarray(plant.poles, dtype=complex)
    size = np.abs(poles)
    on_axis = np.abs(poles.real) <= _ON_AXIS * size
    axis = list(1j * poles[on_axis].imag)
    right = int((poles.real[~on_axis] > 0.0).sum())
    if isinstance(gains, LinearController):
        outside, own = gains.open_loop_poles
        right, axis = right + outside, [*axis, *own]
    elif gains.ki > 0.0:
        axis.append(0j)
    return right, np.array(axis, dtype=complex)


def axis_factor(
    axis: Complexes, omega_rad_s: Floats, rate_hz: float | None, scale_rad_s: float
) -> Complexes:
    """A stable, proper function that is zero where the open loop has poles on the axis."""
    factor = np.ones(omega_rad_s.size, complex)
    if rate_hz is None:
        s = 1j * omega_rad_s
        for pole in axis:
            factor *= (s - pole) / (s + scale_rad_s)
        return factor
    z = np.exp(1j * omega_rad_s / rate_hz)
    for pole in axis:
        factor *= (z - np.exp(pole / rate_hz)) / z
    return factor


def unstable_poles(
    response: Callable[[ArrayLike], Complexes],
    omega_rad_s: Floats,
    loop: Complexes,
    *,
    plant: AnyPlant,
    gains: PidGains | LinearController,
    rate_hz: float | None,
) -> int:
    r"""Count closed-loop poles right of the axis, or outside the unit circle for a sampled loop.

    $Z = P - \Delta\arg F/\pi$ with $F = (1 + L)\prod_i (s - p_i)/(s + a)$ over the poles on the
    axis, from frequency 0 to infinity (half the rate). The grid is refined until no two
    neighbours differ by more than half a radian in $\arg F$, and a midpoint adds no turn.

    Args:
        response: open-loop response at angular frequencies, in rad/s.
        omega_rad_s: rising grid to start with, in rad/s. Shape `(N,)`.
        loop: the response on it. Shape `(N,)`.
        plant: plant.
        gains: controller.
        rate_hz: sampling rate, in Hz; None for a continuous loop.
    Returns:
        The count; 1 or more if a pole is on the axis.
    Source: Nyquist (1932); the factors replace the indentations of the contour.
    """
    right, axis = open_loop_poles(plant, gains)
    scale = float(np.exp(np.log(omega_rad_s[[0, -1]]).mean()))

    def function(omega: Floats, at: Complexes) -> Complexes:
        return (1.0 + at) * axis_factor(axis, omega, rate_hz, scale)

    omega, values = omega_rad_s, function(omega_rad_s, loop)
    for _ in range(_DECADES):
        if abs(values[0].imag) < _NEARLY_REAL * abs(values[0]):
            break
        lower = np.array([0.1 * omega[0]])
        omega = np.concatenate([lower, omega])
        values = np.concatenate([function(lower, response(lower)), values])
    for _ in range(_ROUNDS):
        turns = np.abs(np.angle(values[1:] * np.conj(values[:-1])))
        wide = np.flatnonzero(turns > _LARGEST_TURN)
        wide = wide[omega[wide + 1] - omega[wide] > 1e-13 * omega[wide + 1]]
        if wide.size == 0 or omega.size > _MOST_POINTS:
            break
        middle = 0.5 * (omega[wide] + omega[wide + 1])
        new = function(middle, response(middle))
        omega = np.insert(omega, wide + 1, middle)
        values = np.insert(values, wide + 1, new)
    size = np.abs(values) / (np.abs(axis_factor(axis, omega, rate_hz, scale)) + 1e-300)
    if not np.isfinite(values).all() or size.min() < _ON_THE_EDGE:
        return 1
    argument = np.unwrap(np.angle(values))
    # F is real at frequency 0 and at the end; the first point is near the former.
    turned = argument[-1] - math.pi * round(float(argument[0]) / math.pi)
    return right - round(float(turned) / math.pi)
