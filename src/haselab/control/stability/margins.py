"""Stability margins of the loop from its exact frequency response, including delay."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar

from haselab.base import LimitError
from haselab.control.gains import PidGains
from haselab.control.linear import LinearController
from haselab.control.plants.general import AnyPlant, corners_of, sampled_response_of
from haselab.control.plants.general_loops import closed_loop_poles
from haselab.control.simulate import LoopSetting
from haselab.control.stability.encirclement import unstable_poles
from haselab.models.rational import RationalModel

__all__ = ["Crossover", "Margins", "frequency_grid", "loop_margins", "loop_response", "margins"]
_LONGEST_SEARCH, _STEPS_PER_UPDATE = 20, 4  # updates of added delay; tries in each
_JUST_AFTER = 1e-4  # of an update
_POLE_ERROR, _COARSE = 1e-9, 1500
_LEAST_DAMPING = 1e-6  # for the width of the grid near a resonance
_MOST_TURNS = 20_000
_MOST_STEPS = 100  # iterations for one root
_ROOT = 2e-13  # relative


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
    """Stability margins of a loop.

    Args:
        stable: whether the closed loop is stable.
        phase_margin_deg: the smallest distance over all crossovers, in degrees; negative when
            the closed loop is unstable, infinite without a crossover.
        gain_margin_db: the smallest change of gain, up or down, that makes the loop unstable, in
            dB, infinite if none does. For an unstable loop, the (negative) change of gain to the
            nearest lower crossing, NaN if there is none.
        gain_margin_rad_s: frequency of that instability, in rad/s (NaN when there is none).
        delay_margin_s: the smallest added delay that makes the loop unstable, in s.
        peak_sensitivity: largest `|1/(1 + L)|`.
        peak_sensitivity_rad_s: its frequency, in rad/s.
        crossovers: all gain crossovers, rising in frequency.
        unstable_poles: closed-loop poles in the right half-plane, by an encirclement count.
    """

    stable: bool
    phase_margin_deg: float
    gain_margin_db: float
    gain_margin_rad_s: float
    delay_margin_s: float
    peak_sensitivity: float
    peak_sensitivity_rad_s: float
    crossovers: tuple[Crossover, ...]
    unstable_poles: int = 0

    @property
    def crossover_rad_s(self) -> float:
        """The highest crossover, in rad/s; NaN without one."""
        return self.crossovers[-1].omega_rad_s if self.crossovers else math.nan


def loop_response(
    plant: AnyPlant,
    gains: PidGains | LinearController,
    omega_rad_s: ArrayLike,
    *,
    loop_delay_s: float,
    rate_hz: float | None,
    feedthrough: float = 0.0,
) -> NDArray[np.complex128]:
    """Open-loop response: controller, plant, delay and, for a sampled loop, the hold.

    Args:
        plant: plant; including its own delay.
        gains: controller.
        omega_rad_s: angular frequencies, in rad/s. Shape `(...)`.
        loop_delay_s: delay besides the plant's and the hold's, in s.
        rate_hz: sampling rate of the loop, in Hz; None for a continuous loop.
        feedthrough: of the measurement, see `LoopSetting`.
    Returns:
        Complex response of the same shape.
    Raises:
        LimitError: `rate_hz` is None, and the controller or the feedthrough exists only sampled.
    Example:
        >>> from haselab.models import Plant
        >>> plant, gains = Plant(1.0, 20.0, 0.5), PidGains(0.0, 2.0)
        >>> loop = loop_response(plant, gains, 20.0, loop_delay_s=0.0, rate_hz=None)
        >>> round(float(loop.real), 6)
        -0.1
    """
    omega = np.asarray(omega_rad_s, dtype=float)
    if rate_hz is None:
        if isinstance(gains, LinearController):
            raise LimitError("rate_hz is None, but this controller is sampled. Give its rate_hz.")
        if feedthrough:
            raise LimitError(
                "rate_hz is None, but a feedthrough needs a sampled loop. Give its rate_hz."
            )
        delay = np.exp(-1j * omega * loop_delay_s)
        return np.asarray(gains.frequency_response(omega) * plant.frequency_response(omega) * delay)
    sampled = sampled_response_of(plant, omega, rate_hz, loop_delay_s, feedthrough)
    return np.asarray(gains.sampled_response(omega, rate_hz) * sampled)


def frequency_grid(
    plant: AnyPlant, gains: PidGains | LinearController, rate_hz: float | None, points: int
) -> NDArray[np.float64]:
    """Frequency grid dense enough to resolve every crossing, densest at the resonance.

    Args:
        plant: plant whose resonance and slow modes set the range.
        gains: controller; its gains set the range.
        rate_hz: sampling rate, in Hz (the grid then ends at half of it), or None.
        points: number of points of the logarithmic part; a third as many again are
            around the resonance.
    Returns:
        Rising angular frequencies, in rad/s. Shape `(N,)`.
    """
    if isinstance(plant, RationalModel):
        return _general_grid(plant, gains, rate_hz, points)
    if isinstance(gains, LinearController):
        return _general_grid(RationalModel.from_plant(plant), gains, rate_hz, points)
    wn, zeta = plant.natural_frequency_rad_s, max(plant.damping_ratio, _LEAST_DAMPING)
    static = abs(plant.gain) + sum(abs(mode.gain) for mode in plant.slow_modes)
    corners = [wn, wn * math.sqrt(static * gains.kp), static * wn * wn * gains.kd]
    slow = [1.0 / mode.time_constant_s for mode in plant.slow_modes]
    low = 1e-3 * min([wn, *slow, *([gains.ki * static] if gains.ki * static > 0.0 else [])])
    high = math.pi * rate_hz if rate_hz else 100.0 * max(corners + slow)
    even = np.geomspace(low, high, points)
    near = wn * (1.0 + zeta * np.tan(np.linspace(-1.5, 1.5, points // 3)))
    return np.unique(np.concatenate([even, near[(near > low) & (near < high)]]))


def _general_grid(
    model: RationalModel, gains: PidGains | LinearController, rate_hz: float | None, points: int
) -> NDArray[np.float64]:
    """Logarithmic grid, dense near each pole and zero, aliased for a sampled loop."""
    corners = corners_of(model, gains)
    sizes = np.abs(corners) if corners.size else np.ones(1)
    level = [
        size * abs(complex(gains.frequency_response(size) * model.frequency_response(size)))
        for size in (1.001 * sizes).tolist()  # next to a pole on the axis
    ]
    reached = [value for value in level if 0.0 < value < math.inf]
    low = 1e-3 * min([*sizes.tolist(), *reached])
    high = math.pi * rate_hz if rate_hz else 100.0 * max([*sizes.tolist(), *reached])
    parts = [np.geomspace(min(low, 0.1 * high), high, points)]
    for corner in corners:
        width = max(abs(corner.real), _LEAST_DAMPING * abs(corner))
        near = abs(corner.imag) + width * np.tan(np.linspace(-1.55, 1.55, points // 12 * 2))
        if rate_hz:
            turn = 2.0 * math.pi * rate_hz
            near = np.abs((near + 0.5 * turn) % turn - 0.5 * turn)
        parts.append(near[(near > low) & (near < high)])
    return np.unique(np.concatenate(parts))


def margins(
    plant: AnyPlant,
    gains: PidGains | LinearController,
    *,
    loop_delay_s: float,
    rate_hz: float | None,
    feedthrough: float = 0.0,
) -> Margins:
    """Compute the margins of a loop from its exact response, without approximating the delay.

    Crossings are bracketed on a dense grid and then solved for; the phase margin is the smallest
    over all crossovers, not that of one of them. Stability is determined by the
    argument principle, so a plant may be unstable, integrate, ring without damping or have a
    negative gain.

    Args:
        plant: plant, or any rational model with a delay.
        gains: controller.
        loop_delay_s: delay besides the plant's and the hold's, in s.
        rate_hz: sampling rate, in Hz: plant behind a zero-order hold, controller sampled as in
            the C core; None for a continuous loop.
        feedthrough: of the measurement, see `LoopSetting`.
    Returns:
        The margins.
    Raises:
        LimitError: the delay is negative, or the rate is not positive.
    Source: Nyquist's criterion; K. J. Astrom and R. M. Murray, Feedback Systems, chapter 10.
    Example:
        >>> from haselab.models import Plant
        >>> paper = Plant(0.5, 26.14**0.5, 0.93 / (2.0 * 26.14**0.5))
        >>> result = margins(paper, PidGains(0.85, 1.5), loop_delay_s=0.0, rate_hz=None)
        >>> round(result.phase_margin_deg, 4), round(result.gain_margin_rad_s, 4)
        (12.6039, 7.434)
    """
    if not 0.0 <= loop_delay_s < math.inf:
        raise LimitError(f"loop delay = {loop_delay_s:g} s; it must be 0 s or more.")
    if rate_hz is not None and not 0.0 < rate_hz < math.inf:
        raise LimitError(f"rate = {rate_hz:g} Hz; it must be above 0 Hz, or none.")

    response = _response(plant, gains, loop_delay_s, rate_hz, feedthrough)
    omega = _with_delay(frequency_grid(plant, gains, rate_hz, 6000), plant.delay_s + loop_delay_s)
    loop = response(omega)
    finite = np.isfinite(loop)  # the grid may meet a pole on the axis
    omega, loop = omega[finite], loop[finite]
    unstable = unstable_poles(response, omega, loop, plant=plant, gains=gains, rate_hz=rate_hz)
    stable = unstable == 0
    crossovers = _gain_crossovers(response, omega, loop)
    factor, factor_at = _gain_margin(_axis_crossings(response, omega, loop), stable=stable)
    change_db = 20.0 * math.log10(factor)
    peak, peak_at = _peak_sensitivity(response, omega, loop)
    worst = min((abs(item.phase_margin_deg) for item in crossovers), default=math.inf)
    delay = min(
        (math.radians(c.phase_margin_deg) % (2.0 * math.pi) / c.omega_rad_s for c in crossovers),
        default=math.inf,
    )
    if stable and rate_hz is not None and _passes_steps(plant, feedthrough):

        def stays(added_s: float) -> bool:
            later = replace(plant, delay_s=plant.delay_s + added_s)
            return _is_stable(later, gains, loop_delay_s, rate_hz, feedthrough)

        delay = _first_unstable_s(stays, plant.delay_s + loop_delay_s, 1.0 / rate_hz, delay)
    return Margins(
        stable=stable,
        unstable_poles=unstable,
        phase_margin_deg=worst if stable else -worst,
        gain_margin_db=abs(change_db) if stable else change_db,
        gain_margin_rad_s=factor_at,
        delay_margin_s=delay if stable else 0.0,
        peak_sensitivity=peak,
        peak_sensitivity_rad_s=peak_at,
        crossovers=crossovers,
    )


def _response(
    plant: AnyPlant,
    gains: PidGains | LinearController,
    loop_delay_s: float,
    rate_hz: float | None,
    feedthrough: float,
) -> Callable[[ArrayLike], NDArray[np.complex128]]:
    """The open loop as a function of the angular frequencies."""
    return partial(
        loop_response, plant, gains, loop_delay_s=loop_delay_s, rate_hz=rate_hz,
        feedthrough=feedthrough,
    )  # fmt: skip


def _passes_steps(plant: AnyPlant, feedthrough: float) -> bool:
    """Whether a part of the measurement jumps with the drive, so its delay is whole updates.

    An added delay then does not only turn the phase.
    """
    proper = isinstance(plant, RationalModel) and len(plant.numerator) == len(plant.denominator)
    return feedthrough != 0.0 or proper


def _is_stable(
    plant: AnyPlant,
    gains: PidGains | LinearController,
    loop_delay_s: float,
    rate_hz: float,
    feedthrough: float,
) -> bool:
    """Whether a sampled loop is stable: by its poles, or by encirclements."""
    if isinstance(gains, PidGains):
        setting = LoopSetting(rate_hz, loop_delay_s, feedthrough=feedthrough)
        poles = closed_loop_poles(plant, [gains], setting)
        return float(np.abs(poles).max()) <= 1.0 + _POLE_ERROR
    response = _response(plant, gains, loop_delay_s, rate_hz, feedthrough)
    omega = frequency_grid(plant, gains, rate_hz, _COARSE)
    loop = response(omega)
    good = np.isfinite(loop)
    count = unstable_poles(
        response, omega[good], loop[good], plant=plant, gains=gains, rate_hz=rate_hz
    )
    return count == 0


def _first_unstable_s(
    stays: Callable[[float], bool], delay_s: float, period_s: float, by_phase_s: float
) -> float:
    """The smallest added delay that makes a loop unstable; `by_phase_s` if none up to it does.

    Args:
        stays: whether the loop is stable with an added delay.
        delay_s: of the loop.
        period_s: of the loop.
        by_phase_s: delay margin if an added delay only turned the phase.
    """
    last_s = min(by_phase_s, _LONGEST_SEARCH * period_s)
    jumps = period_s * (np.arange(_LONGEST_SEARCH) + 1 + math.floor(delay_s / period_s)) - delay_s
    steps = period_s / _STEPS_PER_UPDATE * np.arange(1, _LONGEST_SEARCH * _STEPS_PER_UPDATE + 1)
    tried = np.unique(np.r_[steps, jumps + _JUST_AFTER * period_s])
    low = 0.0
    for high in tried[(tried > 0.0) & (tried <= last_s)].tolist():
        if not stays(high):
            break
        low = high
    else:
        return by_phase_s
    while high - low > _JUST_AFTER * period_s:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stays(middle) else (low, middle)
    return float(low)


def loop_margins(
    plant: AnyPlant, gains: PidGains | LinearController, setting: LoopSetting
) -> Margins:
    """Compute the margins of a loop at its rate, with its delay and feedthrough.

    Args:
        plant: see `margins`.
        gains: see `margins`.
        setting: of the loop.
    Returns:
        The margins.
    """
    return margins(
        plant,
        gains,
        loop_delay_s=setting.measurement_delay_s,
        rate_hz=setting.rate_hz,
        feedthrough=setting.feedthrough,
    )


def _with_delay(omega: NDArray[np.float64], delay_s: float) -> NDArray[np.float64]:
    """The grid, refined so that a delay changes the phase by less than half a radian.

    Above the highest of these points the refinement of the count is used.
    """
    if delay_s <= 0.0:
        return omega
    step = 0.5 / delay_s
    gaps = np.diff(omega)
    if not (gaps > step).any():
        return omega
    first = omega[int(np.argmax(gaps > step))]
    count = min(int((omega[-1] - first) / step) + 2, _MOST_TURNS)
    return np.unique(np.concatenate([omega, first + step * np.arange(count)]).clip(max=omega[-1]))


def _gain_crossovers(
    response: Callable[[ArrayLike], NDArray[np.complex128]],
    omega: NDArray[np.float64],
    loop: NDArray[np.complex128],
) -> tuple[Crossover, ...]:
    def excess(at: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.log(np.abs(response(at))))

    above = np.abs(loop) > 1.0
    index = np.flatnonzero(above[1:] != above[:-1])
    roots = _roots(excess, omega[index], omega[index + 1])
    degrees = np.degrees(np.angle(-response(roots)))
    return tuple(Crossover(*pair) for pair in zip(roots.tolist(), degrees.tolist(), strict=True))


def _axis_crossings(
    response: Callable[[ArrayLike], NDArray[np.complex128]],
    omega: NDArray[np.float64],
    loop: NDArray[np.complex128],
) -> list[tuple[float, float]]:
    """Gain factor that moves each crossing of the negative real axis to -1, and its frequency."""

    def imaginary(at: NDArray[np.float64]) -> NDArray[np.float64]:
        return response(at).imag

    half_rate = abs(loop[-1].imag) < 1e-9 * abs(loop[-1])  # a sampled loop is real there
    signs = (loop.imag if not half_rate else loop.imag[:-1]) > 0.0
    crossing = np.flatnonzero(signs[1:] != signs[:-1])
    crossing = crossing[(loop.real[crossing] < 0.0) & (loop.real[crossing + 1] < 0.0)]
    roots = _roots(imaginary, omega[crossing], omega[crossing + 1])
    found = list(zip((1.0 / np.abs(response(roots))).tolist(), roots.tolist(), strict=True))
    flat = abs(loop[1] - loop[0]) < 1e-3 * abs(loop[0])  # no pole at 0
    if flat and abs(loop[0].imag) < 0.1 * abs(loop[0]) and loop[0].real < 0.0:
        found.append((1.0 / abs(loop[0]), 0.0))  # a negative static gain
    if half_rate and loop[-1].real < 0.0:
        found.append((1.0 / abs(loop[-1]), float(omega[-1])))
    return found


def _roots(
    function: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Roots between neighbours of the grid, computed together; clamped to their interval.

    A long delay causes thousands of crossings, and each call of a response costs as much as a
    hundred of its frequencies.

    Source: Chandrupatla, Adv. Eng. Softw. 28 (1997), 145.
    """
    a, b, fa, fb = high.copy(), low.copy(), function(high), function(low)
    c, fc = a.copy(), fa.copy()
    t = np.full(a.size, 0.5)
    outside = fa * fb >= 0.0
    best = np.where(np.abs(fa) < np.abs(fb), a, b)
    open_ = np.flatnonzero(~outside)
    for _ in range(_MOST_STEPS):
        if open_.size == 0:
            break
        i = open_
        x = a[i] + t[i] * (b[i] - a[i])
        fx = function(x)
        same = np.sign(fx) == np.sign(fa[i])
        c[i], fc[i] = np.where(same, a[i], b[i]), np.where(same, fa[i], fb[i])
        b[i], fb[i] = np.where(same, b[i], a[i]), np.where(same, fb[i], fa[i])
        a[i], fa[i] = x, fx
        best[i] = np.where(np.abs(fa[i]) < np.abs(fb[i]), a[i], b[i])
        width = np.abs(b[i] - a[i])
        limit = _ROOT * np.abs(best[i]) / width
        left = (limit <= 0.5) & (fx != 0.0)
        i, limit = i[left], limit[left]
        with np.errstate(divide="ignore", invalid="ignore"):
            xi = (a[i] - b[i]) / (c[i] - b[i])
            phi = (fa[i] - fb[i]) / (fc[i] - fb[i])
            inverse = (fa[i] / (fb[i] - fa[i])) * (fc[i] / (fb[i] - fc[i])) + (
                (c[i] - a[i])
                / (b[i] - a[i])
                * (fa[i] / (fc[i] - fa[i]))
                * (fb[i] / (fc[i] - fb[i]))
            )
        curved = (phi**2 < xi) & ((1.0 - phi) ** 2 < 1.0 - xi) & np.isfinite(inverse)
        t[i] = np.clip(np.where(curved, inverse, 0.5), limit, 1.0 - limit)
        open_ = i
    return best


def _gain_margin(crossings: list[tuple[float, float]], *, stable: bool) -> tuple[float, float]:
    """Gain factor to the limit of stability, and its frequency."""
    if stable:
        nearest = (math.inf, math.nan)
        return min(crossings, key=lambda item: abs(math.log(item[0])), default=nearest)
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
