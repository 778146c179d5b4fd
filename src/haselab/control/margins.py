"""Stability margins of the loop from its exact frequency response, delay included."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq, minimize_scalar

from haselab.base import LimitError
from haselab.control.gains import PidGains
from haselab.control.modes import Modes
from haselab.models.plant import Plant

__all__ = ["Crossover", "Margins", "frequency_grid", "loop_response", "margins"]
_LEAST_DAMPING = 1e-9


@dataclass(frozen=True)
class Crossover:
    """A frequency at which the loop's gain is 1.

    Args:
        omega_rad_s: angular frequency, in rad/s.
        phase_margin_deg: distance of the loop's phase from -180 degrees, in (-180, 180].
    """

    omega_rad_s: float
    phase_margin_deg: float


@dataclass(frozen=True)
class Margins:
    """How far a loop is from instability.

    Args:
        stable: whether the closed loop is stable (Nyquist count).
        phase_margin_deg: the smallest distance over all crossovers, in degrees; negative when
            the closed loop is unstable, infinite without a crossover.
        gain_margin_db: the smallest increase of gain that makes the loop unstable, in dB,
            infinite when none does. Of an unstable loop, the (negative) change of gain to the
            nearest crossing below, NaN when there is none.
        gain_margin_rad_s: frequency of that instability, in rad/s (NaN when there is none).
        delay_margin_s: the smallest added delay that makes the loop unstable, in s.
        peak_sensitivity: largest `|1/(1 + L)|`.
        peak_sensitivity_rad_s: its frequency, in rad/s.
        crossovers: all gain crossovers, rising in frequency.
    """

    stable: bool
    phase_margin_deg: float
    gain_margin_db: float
    gain_margin_rad_s: float
    delay_margin_s: float
    peak_sensitivity: float
    peak_sensitivity_rad_s: float
    crossovers: tuple[Crossover, ...]

    @property
    def crossover_rad_s(self) -> float:
        """The highest crossover, in rad/s; NaN without one."""
        return self.crossovers[-1].omega_rad_s if self.crossovers else math.nan


def loop_response(
    plant: Plant,
    gains: PidGains,
    omega_rad_s: ArrayLike,
    *,
    loop_delay_s: float,
    rate_hz: float | None,
) -> NDArray[np.complex128]:
    """Open-loop response: controller, plant, delay and, when sampled, the hold.

    Args:
        plant: plant; its own delay counts.
        gains: controller.
        omega_rad_s: angular frequencies, in rad/s. Shape `(...)`.
        loop_delay_s: delay besides the plant's and the hold's, in s.
        rate_hz: sampling rate of the loop, in Hz; None for a continuous loop.
    Returns:
        Complex response of the same shape.
    Example:
        >>> plant, gains = Plant(1.0, 20.0, 0.5), PidGains(0.0, 2.0)
        >>> loop = loop_response(plant, gains, 20.0, loop_delay_s=0.0, rate_hz=None)
        >>> round(float(loop.real), 6)
        -0.1
    """
    omega = np.asarray(omega_rad_s, dtype=float)
    if rate_hz is None:
        delay = np.exp(-1j * omega * loop_delay_s)
        return np.asarray(gains.frequency_response(omega) * plant.frequency_response(omega) * delay)
    delay_s = loop_delay_s + plant.delay_s
    sampled = Modes.of(plant).sampled_response(omega, rate_hz, delay_s)
    return np.asarray(gains.sampled_response(omega, rate_hz) * sampled)


def frequency_grid(
    plant: Plant, gains: PidGains, rate_hz: float | None, points: int
) -> NDArray[np.float64]:
    """Angular frequencies dense enough to see every crossing, densest at the resonance.

    Args:
        plant: plant whose resonance and slow modes set the range.
        gains: controller; its gains set the range.
        rate_hz: sampling rate, in Hz (the grid then ends at half of it), or None.
        points: number of points of the even (logarithmic) part; a third as many again lie
            around the resonance.
    Returns:
        Rising angular frequencies, in rad/s. Shape `(N,)`.
    """
    wn, zeta = plant.natural_frequency_rad_s, plant.damping_ratio
    static = abs(plant.gain) + sum(abs(mode.gain) for mode in plant.slow_modes)
    corners = [wn, wn * math.sqrt(static * gains.kp), static * wn * wn * gains.kd]
    slow = [1.0 / mode.time_constant_s for mode in plant.slow_modes]
    low = 1e-3 * min([wn, *slow, *([gains.ki * static] if gains.ki * static > 0.0 else [])])
    high = math.pi * rate_hz if rate_hz else 100.0 * max(corners + slow)
    even = np.geomspace(low, high, points)
    near = wn * (1.0 + zeta * np.tan(np.linspace(-1.5, 1.5, points // 3)))
    return np.unique(np.concatenate([even, near[(near > low) & (near < high)]]))


def margins(
    plant: Plant, gains: PidGains, *, loop_delay_s: float, rate_hz: float | None
) -> Margins:
    """Margins of the loop, from its exact response: no rational approximation of the delay.

    Crossings are bracketed on a dense grid and then solved for; the phase margin is the worst
    over all crossovers, not that of one of them.

    Args:
        plant: stable plant.
        gains: controller.
        loop_delay_s: delay besides the plant's and the hold's, in s.
        rate_hz: sampling rate, in Hz: plant behind a zero-order hold, controller sampled as in
            the C core; None for a continuous loop.
    Returns:
        The margins.
    Raises:
        LimitError: the delay is negative, the rate is not positive, or the plant is not damped.
    Source: Nyquist's criterion; K. J. Astrom and R. M. Murray, Feedback Systems, chapter 10.
    Example:
        >>> paper = Plant(0.5, 26.14**0.5, 0.93 / (2.0 * 26.14**0.5))
        >>> result = margins(paper, PidGains(0.85, 1.5), loop_delay_s=0.0, rate_hz=None)
        >>> round(result.phase_margin_deg, 4), round(result.gain_margin_rad_s, 4)
        (12.6039, 7.434)
    """
    if not 0.0 <= loop_delay_s < math.inf:
        raise LimitError(f"loop delay = {loop_delay_s:g} s; allowed: 0 s or more. Correct it.")
    if rate_hz is not None and not 0.0 < rate_hz < math.inf:
        raise LimitError(f"rate = {rate_hz:g} Hz; allowed: above 0 Hz, or none. Correct it.")
    if plant.damping_ratio < _LEAST_DAMPING:
        raise LimitError(
            f"damping_ratio = {plant.damping_ratio:g}: the gain at the resonance is not finite; "
            f"margins need {_LEAST_DAMPING:g} or more. Correct the plant."
        )

    def response(omega: ArrayLike) -> NDArray[np.complex128]:
        return loop_response(plant, gains, omega, loop_delay_s=loop_delay_s, rate_hz=rate_hz)

    omega = frequency_grid(plant, gains, rate_hz, 6000)
    loop = response(omega)
    stable = _is_stable(loop)
    crossovers = _gain_crossovers(response, omega, loop)
    factor, factor_at = _gain_margin(_axis_crossings(response, omega, loop), stable=stable)
    peak, peak_at = _peak_sensitivity(response, omega, loop)
    worst = min((abs(item.phase_margin_deg) for item in crossovers), default=math.inf)
    delay = min(
        (math.radians(c.phase_margin_deg) % (2.0 * math.pi) / c.omega_rad_s for c in crossovers),
        default=math.inf,
    )
    return Margins(
        stable=stable,
        phase_margin_deg=worst if stable else -worst,
        gain_margin_db=20.0 * math.log10(factor),
        gain_margin_rad_s=factor_at,
        delay_margin_s=delay if stable else 0.0,
        peak_sensitivity=peak,
        peak_sensitivity_rad_s=peak_at,
        crossovers=crossovers,
    )


def _is_stable(loop: NDArray[np.complex128]) -> bool:
    """Nyquist count for a stable plant behind at most one integrator.

    From the first frequency (near the integrator's -90 degrees, or a positive real number) the
    argument of 1 + L must come back to zero without a turn about the origin.
    """
    argument = np.unwrap(np.angle(1.0 + loop))
    return bool(abs(argument[-1]) < 0.5 * math.pi)


def _gain_crossovers(
    response: Callable[[ArrayLike], NDArray[np.complex128]],
    omega: NDArray[np.float64],
    loop: NDArray[np.complex128],
) -> tuple[Crossover, ...]:
    def excess(value: float) -> float:
        return math.log(abs(complex(response(value))))

    above = np.abs(loop) > 1.0
    found = []
    for index in np.flatnonzero(above[1:] != above[:-1]):
        at = _root(excess, omega[index], omega[index + 1])
        margin = math.degrees(float(np.angle(-complex(response(at)))))
        found.append(Crossover(at, margin))
    return tuple(found)


def _axis_crossings(
    response: Callable[[ArrayLike], NDArray[np.complex128]],
    omega: NDArray[np.float64],
    loop: NDArray[np.complex128],
) -> list[tuple[float, float]]:
    """Factor of gain that moves each crossing of the negative real axis to -1; its frequency."""

    def imaginary(value: float) -> float:
        return complex(response(value)).imag

    half_rate = abs(loop[-1].imag) < 1e-9 * abs(loop[-1])  # there a sampled loop is real
    signs = (loop.imag if not half_rate else loop.imag[:-1]) > 0.0
    crossing = np.flatnonzero(signs[1:] != signs[:-1])
    found = []
    for index in crossing[(loop.real[crossing] < 0.0) & (loop.real[crossing + 1] < 0.0)]:
        at = _root(imaginary, omega[index], omega[index + 1])
        found.append((1.0 / abs(complex(response(at))), at))
    if half_rate and loop[-1].real < 0.0:
        found.append((1.0 / abs(loop[-1]), float(omega[-1])))
    return found


def _root(function: Callable[[float], float], low: float, high: float) -> float:
    """Root between two neighbours of the grid; where rounding moved it out, the nearer end."""
    ends = (function(low), function(high))
    if ends[0] * ends[1] >= 0.0:
        return float(low if abs(ends[0]) <= abs(ends[1]) else high)
    return float(brentq(function, low, high, xtol=1e-12, rtol=1e-13))


def _gain_margin(crossings: list[tuple[float, float]], *, stable: bool) -> tuple[float, float]:
    if stable:
        return min((item for item in crossings if item[0] > 1.0), default=(math.inf, math.nan))
    return max((item for item in crossings if item[0] < 1.0), default=(math.nan, math.nan))


def _peak_sensitivity(
    response: Callable[[ArrayLike], NDArray[np.complex128]],
    omega: NDArray[np.float64],
    loop: NDArray[np.complex128],
) -> tuple[float, float]:
    distance = np.abs(1.0 + loop)
    index = int(np.argmin(distance))
    low, high = omega[max(index - 1, 0)], omega[min(index + 1, omega.size - 1)]
    found = minimize_scalar(
        lambda value: abs(1.0 + complex(response(value))),
        bounds=(low, high),
        method="bounded",
        options={"xatol": 1e-10 * high},
    )
    if found.fun < distance[index]:
        return 1.0 / float(found.fun), float(found.x)
    return 1.0 / float(distance[index]), float(omega[index])
