"""What no controller can do better: limits of the device, computed from its true law.

Limits of the motion assume that the voltage may jump between 0 and its highest value at once, that
the highest value is that of the drive or of the permitted field, and that law and state are known
exactly. Limits of the knowledge come from the noise of the sensed length alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from haselab.actuators import GRAVITY_M_S2, Drive, SampledLaw
from haselab.base import ResultError
from haselab.controllers import KnownActuator

__all__ = ["FastestStep", "fastest_step", "least_peak", "least_tracking_error", "mean_error",
           "weight_error_kg"]  # fmt: skip

Floats = NDArray[np.float64]
_STEP_S = 1e-4
_ROUNDS = 40
_SHORTEST_S, _LONGEST_S = 0.05, 30.0
_MEDIAN = 0.6745  # of the absolute value of a normal error, over its standard deviation
_FARTHEST = 10.0  # standard deviations, above the largest of any number of errors
_SMALL_KG = 1e-3
_HEAVY = 1e3  # weight of the equations that close a period


@dataclass(frozen=True)
class FastestStep:
    """The time-optimal step from rest to rest: full voltage, then none, or the other way round.

    Args:
        time_s: until the actuator is at rest at its new length.
        rise_s: 10 to 90 % of the way.
        switch_s: when the voltage switches.
        motion: times from the start, and strains. Shape `(2, N)`.
    """

    time_s: float
    rise_s: float
    switch_s: float
    motion: Floats = field(compare=False, repr=False)


class _Motion:
    """The true device at rest at a strain, and what it does under two voltages in a row."""

    def __init__(self, known: KnownActuator, strain: float) -> None:
        self._known = known
        self._sampled = SampledLaw(
            known.law, known.gain_v_per_v * known.high_v + 2.0 * math.sqrt(known.carrier_v2),
            added_inertia_kg=known.added_inertia_kg,
        )  # fmt: skip
        volt = known.gain_v_per_v * known.static_drive_v(strain)
        self._load_n = GRAVITY_M_S2 * known.mass_kg
        self._start, _ = self._sampled.at_rest(
            volt, known.carrier_v2, self._load_n, longest_m=known.longest_m
        )

    def highest_v(self, strain: float) -> float:
        """Highest voltage of the actuator at a strain."""
        return self._known.gain_v_per_v * self._known.highest_drive_v(self._known.length_m(strain))

    def under(
        self, parts: list[tuple[float, float]], load_n: float | None = None,
        mass_kg: float | None = None,
    ) -> tuple[Floats, Floats, Floats]:  # fmt: skip
        """Times, strains and their rates under durations and voltages."""
        parts = [part for part in parts if part[0] > 0.0]
        edge_s = np.concatenate([[0.0], np.cumsum([duration for duration, _ in parts])])
        volt = np.array([volt for _, volt in parts])
        one = np.ones(volt.size)
        load = self._load_n if load_n is None else load_n
        mass = self._known.mass_kg if mass_kg is None else mass_kg
        drive = Drive(edge_s, volt, load * one, mass * one, self._known.carrier_v2 * one)
        time_s = np.arange(0.0, edge_s[-1], _STEP_S)
        off = np.zeros(volt.size, dtype=np.uint8)
        found = self._sampled.respond(drive, time_s, self._start, sensed=off)
        zero_m = self._known.zero_length_m
        return time_s, found.length_m / zero_m - 1.0, found.speed_m_s / zero_m


def fastest_step(known: KnownActuator, before: float, after: float) -> FastestStep:
    """The time-optimal step from rest to rest, on the nonlinear law.

    One switch is optimal for a device of one mass; viscoelasticity is slow against it. The highest
    voltage is that at the longer of both lengths.

    Args:
        known: true device.
        before: strain at rest.
        after: desired strain at rest.
    Returns:
        The step.
    Raises:
        ResultError: The device cannot be driven there.
    """
    motion = _Motion(known, before)
    longer = (after > before) == known.elongates
    high_v = motion.highest_v(max(before, after))
    first_v, then_v = (high_v, 0.0) if longer else (0.0, high_v)
    sign = math.copysign(1.0, after - before)
    last_s = _SHORTEST_S
    while True:  # without a switch the device would be there after this time
        time_s, strain, _ = motion.under([(last_s, first_v)])
        gone = sign * (strain - after) >= 0.0
        if gone.any():
            break
        last_s *= 2.0
        if last_s > _LONGEST_S:
            raise ResultError(f"The device cannot be driven from {before:g} to {after:g}.")
    low_s, high_s = 0.0, float(time_s[int(np.argmax(gone))])
    last_s = 4.0 * high_s
    for _ in range(_ROUNDS):  # the turning point moves on with the time of the switch
        middle_s = 0.5 * (low_s + high_s)
        _, strain, rate = motion.under([(middle_s, first_v), (last_s - middle_s, then_v)])
        turn = _turn(rate, middle_s, sign)
        if sign * (strain[turn] - after) < 0.0:
            low_s = middle_s
        else:
            high_s = middle_s
    time_s, strain, rate = motion.under([(high_s, first_v), (last_s - high_s, then_v)])
    turn = _turn(rate, high_s, sign)
    moved = (strain[: turn + 1] - before) / (after - before)
    ten, ninety = (float(np.interp(level, moved, time_s[: turn + 1])) for level in (0.1, 0.9))
    path = np.stack([time_s, strain])[:, : turn + 1]
    return FastestStep(float(time_s[turn]), ninety - ten, high_s, path)


def _turn(rate: Floats, after_s: float, sign: float) -> int:
    """Index at which the motion ends, after the switch."""
    first = min(math.ceil(after_s / _STEP_S), rate.size - 1)
    ended = sign * rate[first:] <= 0.0
    return first + (int(np.argmax(ended)) if ended.any() else ended.size - 1)


def least_peak(known: KnownActuator, strain: float, added_kg: float, dead_s: float) -> float:
    """Least deviation after a change of the hung mass that is noticed after a dead time.

    During the dead time the voltage stays. Then the extreme voltage brakes the motion; the largest
    deviation is where the speed is 0.

    Args:
        known: true device.
        strain: held before.
        added_kg: change of the mass.
        dead_s: from the change to the first output that knows of it.
    Returns:
        Deviation, in strain.
    """
    motion = _Motion(known, strain)
    held_v = known.gain_v_per_v * known.static_drive_v(strain)
    outward = added_kg > 0.0
    brake_v = 0.0 if outward == known.elongates else motion.highest_v(strain)
    mass_kg = known.mass_kg + added_kg
    _, moved, _ = motion.under([(dead_s, held_v), (1.0, brake_v)], GRAVITY_M_S2 * mass_kg, mass_kg)
    sign = 1.0 if outward else -1.0
    away = sign * (moved - moved[0])
    falls = np.flatnonzero(np.diff(away) < 0.0)
    return float(away[: falls[0] + 1].max()) if falls.size else float(away.max())


# ---- limits by noise -----------------------------------------------------------------------------


def mean_error(noises: Sequence[float], count: float) -> float:
    r"""Median error of the best estimate of a constant from measurements with white noise.

    Of several constants the largest error counts: the median $q$ of the largest is where
    $\prod_k (2\Phi(q/\sigma_k) - 1) = 1/2$.

    Args:
        noises: standard deviation of one measurement, of each constant.
        count: of the measurements of one constant.
    Example:
        >>> round(mean_error([1.0], 100.0), 4), round(mean_error([1.0, 1e-3], 100.0), 4)
        (0.0674, 0.0674)
    """
    from scipy.optimize import brentq  # slow to import
    from scipy.special import erf

    stds = np.asarray(noises, dtype=float) / math.sqrt(count)

    def beyond(error: float) -> float:
        return float(np.prod(erf(error / (math.sqrt(2.0) * stds)))) - 0.5

    return float(brentq(beyond, 0.0, _FARTHEST * stds.max(), rtol=1e-12))


def weight_error_kg(
    known: KnownActuator, strain: float, noise: float, at_s: NDArray[np.float64]
) -> float:
    r"""Cramer-Rao bound of a change of the hung mass, as the median of the absolute error.

    $\sigma_m = \sigma / \sqrt{\sum_k (\partial x(t_k)/\partial m)^2}$ with the length after the
    change, of which all else is known.

    Args:
        known: true device.
        strain: held before.
        noise: standard deviation of one measured strain.
        at_s: times of the measurements after the change. Shape `(N,)`.
    Returns:
        Error, in kg.
    """
    motion, mass_kg = _Motion(known, strain), known.mass_kg
    volt = known.gain_v_per_v * known.static_drive_v(strain)
    part = [(float(at_s[-1]) + 2.0 * _STEP_S, volt)]
    time_s, heavier, _ = motion.under(
        part, GRAVITY_M_S2 * (mass_kg + _SMALL_KG), mass_kg + _SMALL_KG
    )
    _, same, _ = motion.under(part)
    slope = np.interp(at_s, time_s, heavier - same) / _SMALL_KG
    return _MEDIAN * noise / math.sqrt(float(slope @ slope))


def least_tracking_error(
    known: KnownActuator, wanted: Floats, step_s: float, update_s: float, first_s: float
) -> float:
    """Least rms error of a periodic reference with a force that is constant between updates.

    The mass is a double integrator for the force beyond that of the reference: within an update the
    spring changes by little. Its force stays within the limits of the drive along the reference.

    Args:
        known: true device.
        wanted: desired strains of one period. Shape `(N,)`.
        step_s: between them.
        update_s: between two changes of the force.
        first_s: the first change in the period.
    Returns:
        The error, over the peak-to-peak value of the reference.
    """
    from scipy.optimize import lsq_linear  # slow to import

    last_s = step_s * wanted.size
    starts_s = first_s + update_s * np.arange(round(last_s / update_s))
    time_s = step_s * np.arange(wanted.size + 1)

    def moved(order: int) -> Floats:
        """What a unit of each force has moved, and then the speed; those before act at the end."""
        since = np.maximum(time_s[:, None] - starts_s, 0.0) ** order
        until = np.maximum(time_s[:, None] - starts_s - update_s, 0.0) ** order
        return np.asarray((since - until) / order)

    # the last force also acts before the first change
    way, speed = moved(2), moved(1)
    early = np.minimum(time_s, first_s)
    way[:, -1] += early**2 / 2.0 + early * np.maximum(time_s - first_s, 0.0)
    speed[:, -1] += early
    rows = np.column_stack([np.ones(time_s.size), time_s, way])
    closed = np.r_[0.0, time_s[-1], way[-1]], np.r_[0.0, 0.0, speed[-1]]
    a = np.vstack([rows[:-1], _HEAVY * closed[0], _HEAVY * update_s * closed[1]])
    b = np.r_[wanted, 0.0, 0.0]
    low, high = _accelerations(known, np.interp(starts_s % last_s, time_s[:-1], wanted))
    found = np.linalg.lstsq(a, b, rcond=None)[0]
    if not (np.all(found[2:] >= low) and np.all(found[2:] <= high)):
        free = np.full(2, np.inf)
        found = lsq_linear(a, b, (np.r_[-free, low], np.r_[free, high])).x
    error = rows[:-1] @ found - wanted
    return float(np.sqrt(np.mean(error**2)) / np.ptp(wanted))


def _accelerations(known: KnownActuator, strains: Floats) -> tuple[Floats, Floats]:
    """Lowest and highest acceleration that the drive gives at strains, per s^2."""
    inertia_kg = known.mass_kg + known.added_inertia_kg + known.law.moving_mass_kg
    ends = []
    for strain in strains.tolist():
        length_m = known.length_m(strain)
        rest_n = known.static_pull_n(strain)
        pulls_n = [known.pull_n(length_m, v) for v in (0.0, known.highest_drive_v(length_m))]
        ends.append(sorted((pull_n - rest_n) / inertia_kg / known.zero_length_m
                           for pull_n in pulls_n))  # fmt: skip
    low, high = np.array(ends).T
    return low, high
