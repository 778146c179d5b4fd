r"""PID whose gains follow the voltage and the load, so that the loop has the same poles everywhere.

About an equilibrium, the actuator is a mass $m$ on a stiffness $K$ with a damping $d$, which a
change of the voltage pulls with $b = 2 V k(x)$ per volt. All of them change with voltage and
load. At each point of a grid the gains

$k_d = (m\,p_2 - d)/b,\quad k_p = (m\,p_1 - K)/b,\quad k_i = m\,p_0/b$

give the loop without its delay the poles of $s^3 + p_2 s^2 + p_1 s + p_0 =
(s^2 + 2\zeta\omega s + \omega^2)(s + \omega_i)$. Between the points they are interpolated over the
last drive and over the load by which the sensed length is in balance with the drive. The static
drive of a reference that is smoothed by $1/\omega$ is fed forward; the measurement is compared
with one that is smoothed twice, because the actuator follows that late. At rest, only the part that
is fed forward and the integral remain, so the drive does not jump when the gains change.

Source: W. J. Rugh and J. S. Shamma, Automatica 36 (2000), 1401.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from haselab.actuators import GRAVITY_M_S2
from haselab.base import InputError, LimitError, ResultError
from haselab.controllers.force import force_loop
from haselab.controllers.kind import ControllerKind, Parameter
from haselab.controllers.known_actuator import KnownActuator
from haselab.controllers.linear_loop import (
    UNSTABLE,
    Demands,
    LinearLoop,
    penalty,
    refuse_missed,
    shares_of,
    squared_error,
)
from haselab.controllers.protocol import ControllerSetting, Measurement
from haselab.controllers.sampled_point import SampledPoint, sampled_point

__all__ = [
    "SCHEDULED",
    "GridPoint",
    "ScheduledController",
    "design_scheduled",
    "grid_of",
    "loop_at",
]

Floats = NDArray[np.float64]
_LOADS = (0.7, 1.0, 1.4)  # of the known mass
_SHARES = (0.08, 0.3, 0.5, 0.7, 0.9)  # of the reachable range with a load
_SPREAD = ((1.0, 0.0), (1.1, 0.0), (0.9, 2e-3))  # stiffness, later_s
_PEAK_SENSITIVITY, _NOISE, _SHAKEN = 2.0, 1.5, 0.02
_LOAD_S = 0.5  # time constant of the sensed load
# power of the worst factor: with 5, a demand missed by 1 % at one point more than doubles the cost
_SEARCHES = (1.0, 120), (5.0, 120)  # and the number of evaluations
_LEAST_FILTER = 0.05  # of a period
_SIMPLEX = -0.4  # of the logarithms, at the beginning of the search


@dataclass(frozen=True)
class GridPoint:
    """The actuator at an equilibrium.

    Args:
        known: the actuator with the load of the point.
        strain: held.
        drive_v: that holds it.
        inertia_kg: that moves.
        stiffness_n_per_m: at this voltage.
        pull_n_per_v: change of the electric force by one volt of the drive.
    """

    known: KnownActuator
    strain: float
    drive_v: float
    inertia_kg: float
    stiffness_n_per_m: float
    pull_n_per_v: float

    def gains(self, omega_rad_s: float, damping: float, integral_rad_s: float) -> Floats:
        """Proportional, integral and derivative gain in V per m, V/s per m and V s per m."""
        p2 = 2.0 * damping * omega_rad_s + integral_rad_s
        p1 = omega_rad_s**2 + 2.0 * damping * omega_rad_s * integral_rad_s
        p0 = omega_rad_s**2 * integral_rad_s
        mass, drag = self.inertia_kg, self.known.law.losses.damping_n_s_per_m
        held = np.array([mass * p1 - self.stiffness_n_per_m, mass * p0, mass * p2 - drag])
        return np.asarray(held / self.pull_n_per_v)


def grid_of(known: KnownActuator) -> list[list[GridPoint]]:
    """Equilibria over load and voltage: a row for each load that can be held, rising.

    Args:
        known: the actuator.
    Raises:
        ResultError: No load of the grid can be held.
    """
    rows = []
    for load in _LOADS:
        loaded = replace(known, mass_kg=load * known.mass_kg)
        try:
            low, high = loaded.reachable()
        except InputError:
            continue
        points = [_grid_point(loaded, low + share * (high - low)) for share in _SHARES]
        rows.append(sorted(points, key=lambda point: point.drive_v))
    if not rows:
        raise ResultError("The actuator can hold none of the loads of the grid.")
    return rows


def _grid_point(known: KnownActuator, strain: float) -> GridPoint:
    length_m, drive_v = known.length_m(strain), known.static_drive_v(strain)
    step_m, step_v = known.table.step_m, 1e-3 * known.high_v

    def net_n(x: float) -> float:
        return known.elastic_n(x) - known.pull_n(x, drive_v)

    branches = 1.0 + sum(known.law.losses.branch_share)  # they do not relax within a period
    elastic = (known.elastic_n(length_m + step_m) - known.elastic_n(length_m - step_m)) / 2 / step_m
    softer = (net_n(length_m + step_m) - net_n(length_m - step_m)) / 2 / step_m - elastic
    pull = known.pull_n(length_m, drive_v + step_v) - known.pull_n(length_m, drive_v - step_v)
    inertia = known.mass_kg + known.added_inertia_kg + known.law.moving_mass_kg
    return GridPoint(known, strain, drive_v, inertia, branches * elastic + softer,
                     pull / (2.0 * step_v))  # fmt: skip


class ScheduledController:
    """PID with gains over voltage and load.

    Args:
        omega_rad_s: of the pair of poles.
        damping: of that pair.
        integral_rad_s: of the third pole.
        filter_s: time constant of the derivative's filter.
    """

    def __init__(
        self, omega_rad_s: float, damping: float, integral_rad_s: float, filter_s: float
    ) -> None:
        self._poles, self._filter_s = (omega_rad_s, damping, integral_rad_s), filter_s

    def start(self, setting: ControllerSetting) -> None:
        """See `Controller`."""
        assert setting.actuator is not None, "the kind needs it"
        self._known, self._period_s = setting.actuator, setting.period_s
        self._low_v, self._high_v = max(setting.drive_low, 0.0), setting.drive_high
        self._most_v = setting.highest_rate_per_s * setting.period_s
        self._ahead_s = (setting.delay_s or 0.0) + setting.period_s
        grid = grid_of(self._known)
        self._loads_kg = [row[0].known.mass_kg for row in grid]
        self._rows = [
            (np.array([point.drive_v for point in row]),
             np.stack([point.gains(*self._poles) for point in row]))
            for row in grid
        ]  # fmt: skip
        self._keep = math.exp(-self._period_s / max(self._filter_s, 1e-9))
        self._forget = math.exp(-self._period_s / _LOAD_S)
        self._smooth = math.exp(-self._period_s * self._poles[0])
        self._load_kg, self._drive_v = self._known.mass_kg, setting.drive_start
        self._last_m, self._rate, self._integral_v = math.nan, 0.0, 0.0
        self._wanted = self._coming = math.nan

    @property
    def estimated_load_kg(self) -> float:
        """Hung mass that is in balance with the sensed length, averaged over 0.5 s."""
        return self._load_kg

    def step(self, reference: float, measurement: Measurement) -> float:
        """See `Controller`; without a valid measurement the drive stays."""
        if not measurement.valid:
            return self._drive_v
        known, period_s = self._known, self._period_s
        length_m = known.length_m(measurement.strain)
        if not math.isnan(measurement.capacitance_f):
            length_m = known.sensed_length_m(measurement.capacitance_f, measurement.voltage_v)
        if math.isnan(self._last_m):
            self._last_m = length_m
            self._wanted = self._coming = known.strain(length_m)
            self._integral_v = measurement.voltage_v - self._forward_v()
        held_n = known.elastic_n(length_m) - known.pull_n(length_m, measurement.voltage_v)
        self._load_kg += (1.0 - self._forget) * (held_n / GRAVITY_M_S2 - self._load_kg)
        slope = (length_m - self._last_m) / period_s
        self._rate = self._keep * self._rate + (1.0 - self._keep) * slope
        self._last_m = length_m
        reference = known.limited_strain(reference)
        self._wanted = reference + self._smooth * (self._wanted - reference)
        self._coming = self._wanted + self._smooth * (self._coming - self._wanted)
        kp, ki, kd = self._gains()
        error_m = known.length_m(self._coming) - length_m
        wanted_v = self._forward_v() + kp * error_m - kd * self._rate + self._integral_v
        longest_m = length_m + max(self._rate, 0.0) * self._ahead_s
        high_v = min(self._high_v, known.highest_drive_v(longest_m), self._drive_v + self._most_v)
        low_v = min(max(self._low_v, self._drive_v - self._most_v), high_v)
        self._drive_v = min(max(wanted_v, low_v), high_v)
        push_v = ki * period_s * error_m
        if self._drive_v == wanted_v or push_v * (self._drive_v - wanted_v) > 0.0:
            self._integral_v += push_v
        return self._drive_v

    def _forward_v(self) -> float:
        """Static drive of the smoothed reference, with the known load."""
        return min(self._known.static_drive_v(self._wanted), self._high_v)

    def _gains(self) -> list[float]:
        """Gains at the last drive and the sensed load, beyond the grid those of its edge."""
        place = float(np.interp(self._load_kg, self._loads_kg, np.arange(len(self._loads_kg))))
        row = min(int(place), max(len(self._rows) - 2, 0))
        found = []
        for drives_v, gains in self._rows[row : row + 2]:
            found.append(np.array([np.interp(self._drive_v, drives_v, g) for g in gains.T]))
        share = place - row
        mixed = found[0] if len(found) == 1 else found[0] + share * (found[1] - found[0])
        return [float(value) for value in mixed]


def loop_at(
    point: GridPoint, sampled: SampledPoint, setting: ControllerSetting, values: tuple[float, ...]
) -> LinearLoop:
    """The closed loop about a point of the grid.

    Args:
        point: whose gains hold.
        sampled: the actuator there, which may be stiffer or later than the identified one.
        setting: of the loop.
        values: parameters of `ScheduledController`, in their order.
    """
    known = point.known
    # gains in N per strain; the bend of the force over the length stays in the actuator
    per_v = 2.0 * math.sqrt(sampled.volt2) * known.gain_v_per_v * sampled.pull_per_v2
    gains = point.gains(*values[:3]) * per_v * known.zero_length_m
    free = replace(sampled, pull_per_v2_m=0.0)
    return force_loop(free, setting, (*gains.tolist(), values[3]), known)


def design_scheduled(setting: ControllerSetting) -> Mapping[str, float]:
    """Choose the poles that reject a change of load best and stay robust at every grid point.

    Minimises the sum of squared errors after a step of the load, over three loads (0.7, 1 and 1.4
    times the known one, as far as they can be held) and five voltages. At each of these points the
    peak sensitivity is at most 2: with the identified stiffness, with 10 % more, and with 10 %
    less and a delay that is 2 ms longer. The noise of the sensed length moves the actuator by at
    most 1.5 times that noise and the drive by at most 2 % of its range (rms).

    Args:
        setting: timing of the loop, and the actuator.
    Returns:
        The parameters of `ScheduledController`.
    Raises:
        ResultError: No poles keep the loop stable, or all demands.
    """
    SCHEDULED.check(setting)
    assert setting.actuator is not None
    points = [
        (point, sampled)
        for row in grid_of(setting.actuator)
        for point in row for sampled in _sampled(setting, point)
    ]  # fmt: skip
    fast = 0.3 / ((setting.delay_s or 0.0) + 0.5 * setting.period_s)

    def values(logs: Floats) -> tuple[float, ...]:
        omega, damping, integral, filter_s = np.exp(logs).tolist()
        return omega, damping, integral, max(filter_s, _LEAST_FILTER * setting.period_s)

    def cost(logs: Floats, strict: float) -> float:
        total, worst = 0.0, 1.0
        for point, sampled in points:
            factor, error = _cost(point, sampled, setting, values(logs))
            if factor > UNSTABLE:
                return factor
            total, worst = total + error, max(worst, factor)
        return float(total * worst**strict)

    start = np.log([fast, 0.4, 0.5 * fast, 0.5 * setting.period_s])
    for strict, evaluations in _SEARCHES:
        simplex = start + _SIMPLEX * np.vstack([np.zeros(4), np.eye(4)])
        best = minimize(cost, start, (strict,), "Nelder-Mead",
                        options={"maxfev": evaluations, "initial_simplex": simplex})  # fmt: skip
        start = best.x
    if best.fun > UNSTABLE:
        raise ResultError(
            "No poles of the scheduled PID are stable at all voltages and loads of its grid with a "
            f"delay of {setting.delay_s or 0.0:g} s. Use the controller observer, or shorten the "
            "delay."
        )
    names = [parameter.name for parameter in SCHEDULED.parameters]
    found = [float(f"{value:.4g}") for value in values(best.x)]
    shares = [
        shares_of(loop_at(point, sampled, setting, tuple(found)), setting.period_s,
                  _demands(point, sampled))
        for point, sampled in points
    ]  # fmt: skip
    refuse_missed(shares, "poles of the scheduled PID", setting.period_s,
                  "Use the controller observer, or shorten the delay.")  # fmt: skip
    return dict(zip(names, found, strict=True))


def _sampled(setting: ControllerSetting, point: GridPoint) -> list[SampledPoint]:
    found, loaded = [], replace(setting, actuator=point.known)
    for stiffness, later_s in _SPREAD:
        try:
            found.append(sampled_point(loaded, point.strain, stiffness=stiffness, later_s=later_s))
        except LimitError:  # near the end of the range
            continue
    return found


def _cost(
    point: GridPoint, sampled: SampledPoint, setting: ControllerSetting, values: tuple[float, ...]
) -> tuple[float, float]:
    """Factor by the demands that are missed, and error after a step of the load."""
    loop = loop_at(point, sampled, setting, values)
    factor = penalty(loop, setting.period_s, _demands(point, sampled))
    return factor, 0.0 if factor > UNSTABLE else squared_error(loop, setting.period_s)


def _demands(point: GridPoint, sampled: SampledPoint) -> Demands:
    known = point.known
    per_v2 = 0.5 / math.sqrt(sampled.volt2) / known.gain_v_per_v  # V of drive per V^2
    return Demands(
        known.length_noise_m(sampled.strain), _SHAKEN * known.high_v / per_v2, _PEAK_SENSITIVITY,
        _NOISE,
    )  # fmt: skip


SCHEDULED = ControllerKind(
    "scheduled-pid",
    ScheduledController,
    (
        Parameter("omega_rad_s", "rad/s", None, 1e-3, 1e4),
        Parameter("damping", "", None, 1e-3, 1e3),
        Parameter("integral_rad_s", "rad/s", None, 0.0, 1e4),
        Parameter("filter_s", "s", None, 1e-6, 1.0),
    ),
    output="voltage",
    needs_actuator=True,
    design=design_scheduled,
)
