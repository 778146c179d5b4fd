r"""Observer with inverse dynamics: states and load are estimated, the reference is planned.

The identified motion runs along, from one sensed length to the next, with the drives that were put
out. Each length corrects it: length, speed, the forces of the viscoelastic branches, and a load
that nobody announced. From the state at the time at which a drive takes effect follows the force
that moves the actuator along the reference,

$F_u = m\,(\ddot x_r + k_d\,(\dot x_r - \dot x) + k_p\,(x_r - x)) + F(x) + \sum q_i + d\,\dot x
- m g - \Delta$

and from that force and the length the voltage. The estimated load is also the integrator. A
desired strain that jumps is reached by a polynomial of the fifth order that is as fast as limits of
drive, field and rate allow; one that is smooth is followed with its rate.

Source: R. E. Kalman, J. Basic Eng. 82 (1960), 35, for the gains of the observer; T. Flash and
N. Hogan, J. Neurosci. 5 (1985), 1688, for the polynomial.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from haselab.actuators import GRAVITY_M_S2
from haselab.base import LimitError, ResultError
from haselab.controllers.kind import ControllerKind, Parameter
from haselab.controllers.known_actuator import KnownActuator
from haselab.controllers.motion_model import MotionModel
from haselab.controllers.protocol import ControllerSetting, Measurement
from haselab.controllers.reference_plan import ReferencePlan

__all__ = ["OBSERVER", "ObserverController", "design_observer"]

Floats = NDArray[np.float64]
_POINTS = 9  # strains of the reachable range at which the observer's gains are computed
_USUAL_NOISE = 2e-4  # strain, where it is not known
_CREEP_N = 1e-3  # of the weight, per root of a second: how uncertain the branches are
_CORRECTIONS = 2
_PREVIEW_S = 0.05


class ObserverController:
    """State feedback of an observer in the force of the field, with a planned reference.

    Args:
        bandwidth_rad_s: of the error's decay, critically damped.
        load_n: change of the load that is expected in a second, in N.
        shake_m_s2: unknown accelerations, in m/s^2 per root of hertz.
        reserve: share of the force's range that a plan leaves to the feedback.
    """

    def __init__(
        self, bandwidth_rad_s: float, load_n: float, shake_m_s2: float, reserve: float
    ) -> None:
        self._bandwidth, self._reserve = bandwidth_rad_s, reserve
        self._load_n, self._shake = load_n, shake_m_s2

    def start(self, setting: ControllerSetting) -> None:
        """See `Controller`."""
        assert setting.actuator is not None, "the kind needs it"
        known = setting.actuator
        self._known, self._model = known, MotionModel(known)
        period_s = self._period_s = setting.period_s
        delay_s = 0.5 * period_s if setting.delay_s is None else setting.delay_s
        age_s = 0.5 * period_s if setting.sensed_before_s is None else setting.sensed_before_s
        self._whole = int(delay_s / period_s + 1e-9)
        self._late_s = delay_s - self._whole * period_s
        self._acts_s = max(delay_s - age_s, 0.0)  # after the end of a block
        decay = math.exp(-self._bandwidth * period_s)
        self._per_m = ((1.0 - decay) / period_s) ** 2
        self._per_m_s = 0.5 * (1.0 - decay) * (3.0 + decay) / period_s
        self._low_v, self._high_v = max(setting.drive_low, 0.0), setting.drive_high
        self._most_v = setting.highest_rate_per_s * period_s
        self._past_v = [setting.drive_start] * (self._whole + 2)  # the latest first
        self._plan = ReferencePlan(
            self._model, known, period_s, self._reserve, setting.highest_rate_per_s
        )
        self._strains, self._gains = self._observer_gains()
        self._state: list[float] | None = None

    @property
    def estimated_load_kg(self) -> float:
        """Hung mass, by the estimated load."""
        if self._state is None:
            return self._known.mass_kg
        return self._known.mass_kg + self._state[-1] / GRAVITY_M_S2

    def step(self, reference: float, measurement: Measurement) -> float:
        """See `Controller`; without a valid measurement the observer goes on alone."""
        past_v, whole, model = self._past_v, self._whole, self._model
        past_v[0] = measurement.voltage_v
        length_m = math.nan
        if measurement.valid:
            length_m = self._sensed_m(measurement)
        if self._state is None:
            if math.isnan(length_m):
                return past_v[0]
            self._state = model.at_rest(length_m, past_v[whole])
            self._plan.begin(length_m)
        state = model.moved(self._state, past_v[whole + 1], self._late_s)
        state = model.moved(state, past_v[whole], self._period_s - self._late_s)
        if not math.isnan(length_m):
            state = self._corrected(state, length_m)
        self._state = state
        # to the time at which the new drive takes effect
        ahead = model.moved(state, past_v[whole], self._late_s)
        for k in range(whole - 1, -1, -1):
            ahead = model.moved(ahead, past_v[k], self._period_s)
        zero_m = self._known.zero_length_m
        wanted = [zero_m * (1.0 + value) for value in (reference, *measurement.preview)]
        drive_v = self._drive_v(ahead, *self._plan.next(wanted, self._acts_s, ahead))
        past_v.insert(0, drive_v)
        past_v.pop()
        return drive_v

    def _sensed_m(self, measurement: Measurement) -> float:
        known = self._known
        if math.isnan(measurement.capacitance_f):
            return known.length_m(measurement.strain)
        return known.sensed_length_m(measurement.capacitance_f, self._past_v[self._whole])

    def _corrected(self, state: list[float], length_m: float) -> list[float]:
        """The state with the gains of its length."""
        missed_m, strain = length_m - state[0], self._known.strain(state[0])
        place = (strain - self._strains[0]) / (self._strains[1] - self._strains[0])
        k = min(max(int(place), 0), len(self._gains) - 2)
        share = min(max(place - k, 0.0), 1.0)
        low, high = self._gains[k], self._gains[k + 1]
        return [
            value + missed_m * (a + share * (b - a))
            for value, a, b in zip(state, low, high, strict=True)
        ]

    def _drive_v(
        self, state: list[float], wanted_m: float, wanted_m_s: float, pushed_m_s2: float
    ) -> float:
        """Drive that leads the state back to the reference."""
        model, period_s = self._model, self._period_s
        length_m, speed = state[:2]
        pushed = (
            pushed_m_s2
            + self._per_m * (wanted_m - length_m)
            + self._per_m_s * (wanted_m_s - speed)
        )
        half_s = 0.5 * period_s
        middle_m = length_m + half_s * speed + 0.5 * half_s * half_s * pushed
        pull_n = model.needed_n(state, middle_m, speed + half_s * pushed, pushed)
        low_v, high_v = self._limits_v(max(middle_m, length_m + period_s * max(speed, 0.0)))
        for _ in range(_CORRECTIONS):  # until the speed after the whole period is as wanted
            drive_v = max(min(self._known.drive_v(middle_m, pull_n), high_v), low_v)
            missed = speed + period_s * pushed - model.moved(state, drive_v, period_s)[1]
            pull_n += model.inertia_kg * missed / period_s
        return max(min(self._known.drive_v(middle_m, pull_n), high_v), low_v)

    def _limits_v(self, length_m: float) -> tuple[float, float]:
        """Lowest and highest drive of the next period, in which this length is not exceeded."""
        high_v = min(self._high_v, self._known.highest_drive_v(length_m))
        high_v = min(high_v, self._past_v[0] + self._most_v)
        return min(max(self._low_v, self._past_v[0] - self._most_v), high_v), high_v

    def _observer_gains(self) -> tuple[list[float], list[list[float]]]:
        """Strains, and the steady gains of Kalman's filter there."""
        known, model = self._known, self._model
        low, high = known.reachable()
        strains = np.linspace(low, high, _POINTS)
        gains = []
        for strain in strains.tolist():
            drive_v = known.static_drive_v(strain)
            a = model.linear(known.length_m(strain), drive_v, self._period_s)
            size, period_s = a.shape[0], self._period_s
            branches = size - 3
            shaken = self._shake**2 * np.array([period_s**3 / 3.0, period_s])
            creep = (_CREEP_N * model.weight_n) ** 2 * period_s
            noise = np.diag(
                [*shaken, *[creep] * branches, self._load_n**2 * period_s]
            )
            noise[0, 1] = noise[1, 0] = self._shake**2 * period_s**2 / 2.0
            seen = np.zeros((1, size))
            seen[0, 0] = 1.0
            r = np.array([[self._noise_m(strain) ** 2]])
            unit = np.array([1e-6, 1e-4, *[1e-3] * branches, 1e-2])  # for the solver
            p = solve_discrete_are(
                (a * unit / unit[:, None]).T, (seen * unit).T / 1e-6,
                noise / np.outer(unit, unit), r / 1e-12,
            )
            gain = p[:, 0] / (p[0, 0] + r[0, 0] / 1e-12) * unit / 1e-6
            gains.append(gain.tolist())
        return strains.tolist(), gains

    def _noise_m(self, strain: float) -> float:
        """Standard deviation of the sensed length."""
        known = self._known
        length_m, step_m = known.length_m(strain), known.table.step_m
        ends = known.law.capacitance_f(np.array([length_m - step_m, length_m + step_m]))
        per_m = abs(float(ends[1] - ends[0])) / (2.0 * step_m) * known.sensing_scale
        noise_f = known.capacitance_noise_f
        return _USUAL_NOISE * known.zero_length_m if math.isnan(noise_f) else noise_f / per_m


def design_observer(setting: ControllerSetting) -> Mapping[str, float]:
    """Rough."""
    OBSERVER.check(setting)
    known = setting.actuator
    assert known is not None
    weight_n = known.mass_kg * GRAVITY_M_S2
    delay = (setting.delay_s or 0.0) + 0.5 * setting.period_s
    return {"bandwidth_rad_s": float(f"{0.5 / delay:.4g}"), "load_n": float(f"{0.5 * weight_n:.4g}"),
            "shake_m_s2": 0.05, "reserve": 0.15}


OBSERVER = ControllerKind(
    "observer",
    ObserverController,
    (
        Parameter("bandwidth_rad_s", "rad/s", None, 1e-3, 1e4),
        Parameter("load_n", "N", None, 1e-9, 1e6),
        Parameter("shake_m_s2", "m/s^2", 0.05, 1e-9, 1e6),
        Parameter("reserve", "", 0.15, 0.0, 0.9),
    ),
    output="voltage",
    needs_actuator=True,
    design=design_observer,
    preview_s=_PREVIEW_S,
)
