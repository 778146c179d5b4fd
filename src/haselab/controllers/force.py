r"""Force-coordinate loop: PID in the force of the field, which the sensed length turns into volts.

$u = k(x)\,(V^2 + r),\quad u = u_0(x_r) + m\ddot x_r + d\dot x_r + x_0\,(k_p e + k_i\!\int\! e
+ k_d\,\dot e)$

The voltage squared and the slope of the capacitance, both of which change many times over the range
of an actuator, leave the loop. What is left is the elastic stiffness. The force of equilibrium
$u_0$, the inertia and the damping of a smoothed reference $x_r$ are fed forward. The length also
limits the field: the drive never exceeds what it allows at the length to come.

Source: S. Skogestad and I. Postlethwaite, Multivariable Feedback Control, ch. 2, for the demand on
the peak sensitivity.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from haselab.base import LimitError, ResultError
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

__all__ = ["FORCE", "ForceController", "ForceDemands", "design_force", "force_loop"]

Floats = NDArray[np.float64]
_POINTS = (0.1, 0.5, 0.9)  # of the reachable range
_SPREAD = ((1.1, 0.0), (0.9, 2e-3))  # stiffness, later_s
_PEAK_SENSITIVITY = 1.8
_AUTHORITY = 0.5  # of the force beyond equilibrium that a step of the reference may take
_STEP = 0.04
_ERROR = 0.01  # strain that the proportional part may answer with all the spare force
_LEAST_FILTER = 0.05  # of a period
_GAIN = 1e6


@dataclass(frozen=True)
class ForceDemands:
    """What noise may do in a loop, and where the search for gains starts.

    Args:
        moved: standard deviation of the length by noise, over that of one sensed length.
        shaken: of the drive, over its highest value.
        changed: change of the drive in one update, over the highest one that the loop allows.
        slower: logarithms of the speeds from which the search starts, over the fastest loop.
        filtered: power of that speed to which the derivative's filter is slower at the start.
    """

    moved: float = 1.2
    shaken: float = 0.005
    changed: float = math.inf
    slower: tuple[float, ...] = (0.0, -0.7, -1.4)
    filtered: float = 0.0


_BENCH = ForceDemands()


class ForceController:
    """PID in the force of the field, with feed-forward of a smoothed reference.

    Args:
        kp: proportional gain, in N per strain.
        ki: integral gain, in N/s per strain.
        kd: derivative gain, in N s per strain.
        filter_s: time constant of the derivative's filter, in s.
        reference_s: time constant of the reference's smoothing, twice in series, in s.
    """

    def __init__(
        self, kp: float, ki: float, kd: float, filter_s: float, reference_s: float
    ) -> None:
        self._kp, self._ki, self._kd = kp, ki, kd
        self._filter_s, self._reference_s = filter_s, reference_s

    def start(self, setting: ControllerSetting) -> None:
        """See `Controller`."""
        assert setting.actuator is not None, "the kind needs it"
        self._actuator: KnownActuator = setting.actuator
        self._low_v, self._high_v = setting.drive_low, setting.drive_high
        self._period_s = setting.period_s
        self._ahead_s = (setting.delay_s or 0.0) + 0.5 * setting.period_s
        inertia_kg = self._actuator.mass_kg + self._actuator.added_inertia_kg
        self._inertia_kg = inertia_kg + self._actuator.law.moving_mass_kg
        losses = self._actuator.law.losses
        self._branches = [
            (share, math.exp(-setting.period_s / relaxation_s))
            for share, relaxation_s in zip(
                losses.branch_share, losses.branch_relaxation_s, strict=True
            )
        ]
        self._branch_n = [0.0] * len(self._branches)
        self._keep = math.exp(-setting.period_s / max(self._filter_s, 1e-9))
        lag = self._ahead_s / setting.period_s  # updates from a force to the sensed length
        self._lag = lag - int(lag)
        self._past = [0.0] * (2 + int(lag))  # smoothed references, the oldest first
        self._past_rate = 0.0
        self._wanted: float | None = None  # smoothed reference
        self._wanted_per_s = self._integral_n = self._rate = 0.0
        self._last = math.nan
        self._drive_v = setting.drive_start

    def step(self, reference: float, measurement: Measurement) -> float:
        """See `Controller`; without a valid measurement nothing is integrated."""
        if not measurement.valid:
            return self._drive_v
        known = self._actuator
        if math.isnan(measurement.capacitance_f):
            length_m = known.length_m(measurement.strain)
        else:
            length_m = known.sensed_length_m(measurement.capacitance_f, measurement.voltage_v)
        strain = known.strain(length_m)
        if self._wanted is None:
            self._begin(strain, length_m, measurement.voltage_v)
        wanted, wanted_per_s, wanted_per_s2 = self._smooth(known.limited_strain(reference))
        slope = (strain - self._last) / self._period_s
        self._rate = self._keep * self._rate + (1.0 - self._keep) * slope
        self._last = strain
        past, past_rate = self._as_sensed(wanted)
        error = past - strain
        zero_m = known.zero_length_m
        damping = known.law.losses.damping_n_s_per_m
        forward_n = (
            known.static_pull_n(wanted)
            + self._creep_n(wanted)
            + zero_m * (self._inertia_kg * wanted_per_s2 + damping * wanted_per_s)
        )
        back_n = self._kp * error + self._kd * (past_rate - self._rate)
        pull_n = forward_n + back_n + self._integral_n
        # where the actuator will be when the force acts, if it follows the reference
        coming_m = length_m + zero_m * (wanted - past)
        longest_m = max(coming_m, length_m + zero_m * self._rate * self._ahead_s)
        high_v = min(self._high_v, known.highest_drive_v(longest_m))
        drive_v = min(max(known.drive_v(coming_m, pull_n), max(self._low_v, 0.0)), high_v)
        got_n = known.pull_n(coming_m, drive_v)
        push_n = self._ki * error * self._period_s
        if abs(got_n - pull_n) < 1e-9 + 1e-6 * abs(pull_n) or push_n * (got_n - pull_n) > 0.0:
            self._integral_n += push_n
        self._drive_v = drive_v
        return drive_v

    def _begin(self, strain: float, length_m: float, drive_v: float) -> None:
        """Start without a jump: the integral holds what equilibrium and present force differ by."""
        self._wanted, self._last, self._before = strain, strain, strain
        self._past = [strain] * len(self._past)
        self._elastic_n = self._actuator.elastic_n(self._actuator.length_m(strain))
        present_n = self._actuator.pull_n(length_m, drive_v)
        self._integral_n = present_n - self._actuator.static_pull_n(strain)

    def _creep_n(self, wanted: float) -> float:
        """Force of the viscoelastic branches, if the length followed the smoothed reference."""
        elastic_n = self._actuator.elastic_n(self._actuator.length_m(wanted))
        change_n, self._elastic_n = elastic_n - self._elastic_n, elastic_n
        for k, (share, decay) in enumerate(self._branches):
            self._branch_n[k] = decay * self._branch_n[k] + share * change_n
        return sum(self._branch_n)

    def _as_sensed(self, wanted: float) -> tuple[float, float]:
        """The smoothed reference that the sensed length should have followed by now, its rate."""
        past = self._past
        past.pop(0)
        past.append(wanted)
        before = self._before
        found = self._lag * past[0] + (1.0 - self._lag) * past[1]
        self._before = found
        slope = (found - before) / self._period_s
        self._past_rate = self._keep * self._past_rate + (1.0 - self._keep) * slope
        return found, self._past_rate

    def _smooth(self, reference: float) -> tuple[float, float, float]:
        """Follow the reference critically damped: strain, its rate and acceleration."""
        assert self._wanted is not None
        if self._reference_s <= 0.0:
            self._wanted, self._wanted_per_s = reference, 0.0
            return reference, 0.0, 0.0
        rate = 1.0 / self._reference_s
        gap, speed, t = self._wanted - reference, self._wanted_per_s, self._period_s
        decay, mixed = math.exp(-rate * t), speed + rate * gap
        after = (gap + mixed * t) * decay
        self._wanted_per_s = (speed - rate * mixed * t) * decay
        self._wanted = reference + after
        pulled = -rate * rate * after - 2.0 * rate * self._wanted_per_s
        return self._wanted, self._wanted_per_s, pulled


def design_force(setting: ControllerSetting, demands: ForceDemands = _BENCH) -> Mapping[str, float]:
    """Choose the gains that reject a change of load best and stay robust over the whole range.

    Minimises the sum of squared errors after a step of the load, over three strains of the
    reachable range, with the stiffness 10 % lower and higher and the delay 2 ms longer. In each
    case the peak sensitivity is at most 1.8, and noise does at most what is demanded.

    Args:
        setting: timing of the loop, and the actuator.
        demands: on the noise.
    Returns:
        The parameters of `ForceController`.
    Raises:
        ResultError: No gains keep the loop stable, or all demands.
    """
    FORCE.check(setting)
    known = setting.actuator
    assert known is not None
    points = _points(setting, known)
    spare_n = _spare_n(known)
    inertia = known.mass_kg + known.added_inertia_kg + known.law.moving_mass_kg
    fast = 0.35 / ((setting.delay_s or 0.0) + 0.5 * setting.period_s)  # rad/s, of the crossover
    scale = inertia * known.zero_length_m
    start = np.log([scale * fast**2, scale * fast**3 / 4.0, scale * fast, setting.period_s])

    def gains(values: Floats) -> tuple[float, float, float, float]:
        kp, ki, kd, filter_s = np.exp(values).tolist()
        return kp, ki, kd, max(filter_s, _LEAST_FILTER * setting.period_s)

    def cost(values: Floats) -> float:
        return sum(_cost(point, setting, gains(values), demands, spare_n) for point in points)

    best = None
    for shift in demands.slower:
        found = minimize(cost, start + np.array([2.0, 3.0, 1.0, -demands.filtered]) * shift,
                         method="Nelder-Mead", options={"maxfev": 400, "xatol": 0.02})  # fmt: skip
        if best is None or found.fun < best.fun:
            best = found
    assert best is not None
    if best.fun > UNSTABLE:
        raise ResultError(
            f"No gains of the force loop are stable with a delay of {setting.delay_s or 0.0:g} s. "
            "Shorten the delay."
        )
    _refuse_missed(points, setting, gains(best.x), demands)
    kp, ki, kd, filter_s = (float(f"{value:.4g}") for value in gains(best.x))
    needed_s = math.sqrt(inertia * known.zero_length_m * _STEP / (_AUTHORITY * spare_n))
    reference_s = max(needed_s, setting.period_s)
    return {"kp": kp, "ki": ki, "kd": kd, "filter_s": filter_s,
            "reference_s": float(f"{reference_s:.4g}")}  # fmt: skip


def _spare_n(known: KnownActuator) -> float:
    """Force that the highest drive adds to that of equilibrium, in the lower part of the range."""
    low, high = known.reachable()
    middle = low + 0.2 * (high - low) if known.elongates else high - 0.2 * (high - low)
    length_m = known.length_m(middle)
    full_n = known.pull_n(length_m, known.highest_drive_v(length_m))
    return abs(full_n - known.static_pull_n(middle))


def _points(setting: ControllerSetting, known: KnownActuator) -> list[SampledPoint]:
    low, high = known.reachable()
    found = []
    for share in _POINTS:
        for stiffness, later_s in _SPREAD:
            try:
                strain = low + share * (high - low)
                found.append(sampled_point(setting, strain, stiffness=stiffness, later_s=later_s))
            except LimitError:  # a strain near the end of the range
                continue
    if not found:
        raise ResultError("The actuator has no equilibrium within its reachable range.")
    return found


def force_loop(
    point: SampledPoint, setting: ControllerSetting, gains: tuple[float, ...], known: KnownActuator
) -> LinearLoop:
    """Closed loop with filtered rate and integral; the drive is the square of the voltage.

    Args:
        point: actuator.
        setting: of the loop.
        gains: `kp`, `ki`, `kd` and `filter_s` of `ForceController`.
        known: scale of the length.
    """
    per_m, per_m_s, per_m_filter = (gain / known.zero_length_m for gain in gains[:3])
    keep, period_s = math.exp(-setting.period_s / gains[3]), setting.period_s
    size = point.b.size
    # states: those of the point, the last length, the filtered rate, the integral in N
    rate = np.zeros(size + 3)
    rate[:size], rate[size] = point.c, -1.0
    rate = (1.0 - keep) / period_s * rate
    rate[size + 1] = keep
    length = np.r_[point.c, np.zeros(3)]
    pull = -per_m * length - per_m_filter * rate
    pull[size + 2] += 1.0
    bend = point.volt2 * point.pull_per_v2_m  # N/m: what the sensed length takes from the voltage
    w_row = (pull - bend * length) / point.pull_per_v2
    noise_row = -(per_m + per_m_filter * (1.0 - keep) / period_s + bend) / point.pull_per_v2
    a = np.zeros((size + 3, size + 3))
    a[:size, :size] = point.a
    a[:size] += np.outer(point.b, w_row)
    a[size] = length
    a[size + 1] = rate
    a[size + 2] = -per_m_s * period_s * length
    a[size + 2, size + 2] += 1.0
    load = np.r_[point.load, np.zeros(3)]
    noise = np.r_[point.b * noise_row, 1.0, (1.0 - keep) / period_s, -per_m_s * period_s]
    return LinearLoop(a, load, noise, np.r_[point.b, np.zeros(3)], length, w_row, noise_row)


def _demands(point: SampledPoint, setting: ControllerSetting, demands: ForceDemands) -> Demands:
    known = setting.actuator
    assert known is not None
    per_v2 = 0.5 / math.sqrt(point.volt2) / known.gain_v_per_v  # V of drive per V^2
    allowed_v = setting.highest_rate_per_s * setting.period_s
    changed = math.inf if math.isinf(demands.changed) else demands.changed * allowed_v / per_v2
    return Demands(
        known.length_noise_m(point.strain), demands.shaken * known.high_v / per_v2,
        _PEAK_SENSITIVITY, demands.moved, changed,
    )  # fmt: skip


def _cost(
    point: SampledPoint, setting: ControllerSetting, gains: tuple[float, ...],
    demands: ForceDemands, spare_n: float,
) -> float:  # fmt: skip
    """Cost of the loop, also where the proportional part asks for more than the spare force."""
    known = setting.actuator
    assert known is not None
    missed = max(gains[0] * _ERROR / spare_n - 1.0, 0.0)
    loop = force_loop(point, setting, gains, known)
    factor = penalty(loop, setting.period_s, _demands(point, setting, demands), missed)
    return factor if factor > UNSTABLE else factor * squared_error(loop, setting.period_s)


def _refuse_missed(
    points: list[SampledPoint], setting: ControllerSetting, gains: tuple[float, ...],
    demands: ForceDemands,
) -> None:  # fmt: skip
    """Refuse gains with which a loop misses a demand: the search found none that keep all."""
    known = setting.actuator
    assert known is not None
    found = [
        shares_of(
            force_loop(point, setting, gains, known), setting.period_s,
            _demands(point, setting, demands),
        )
        for point in points
    ]  # fmt: skip
    refuse_missed(
        found, "gains of the force loop", setting.period_s,
        "Use the controller 'observer', slower updates or a sensor with less noise.",
    )  # fmt: skip


FORCE = ControllerKind(
    "force",
    ForceController,
    (
        Parameter("kp", "N", None, 0.0, _GAIN),
        Parameter("ki", "N/s", None, 0.0, _GAIN),
        Parameter("kd", "N s", None, 0.0, _GAIN),
        Parameter("filter_s", "s", None, 1e-6, 1.0),
        Parameter("reference_s", "s", 0.02, 0.0, 10.0),
    ),
    output="voltage",
    needs_actuator=True,
    design=design_force,
)
