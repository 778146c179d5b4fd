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
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from haselab.actuators import GRAVITY_M_S2
from haselab.controllers.linear_loop import LinearLoop
from haselab.controllers.motion_model import MotionModel
from haselab.controllers.protocol import ControllerSetting, Measurement
from haselab.controllers.reference_plan import ReferencePlan

Floats = NDArray[np.float64]
__all__ = ["ObserverController"]

_POINTS = 9  # strains of the reachable range at which the observer's gains are computed
_CREEP = 1e-3  # of the weight, per root of a second: how uncertain the branches are
_CORRECTIONS = 2
_WEIGHED_S = 0.04  # time constant of the mean load


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
        low, high = known.reachable()
        self._strains = np.linspace(low, high, _POINTS).tolist()
        self._gains = self._observer_gains(self._strains)
        self._state: list[float] | None = None
        self._load_mean_n, self._forget = 0.0, math.exp(-period_s / _WEIGHED_S)

    @property
    def estimated_load_kg(self) -> float:
        """Hung mass, by the estimated load of the last 0.1 s."""
        return self._known.mass_kg + self._load_mean_n / GRAVITY_M_S2

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
        state = self._state = self._observed(self._state, past_v, length_m)
        self._load_mean_n = state[-1] + self._forget * (self._load_mean_n - state[-1])
        ahead = self._ahead(state, past_v)
        zero_m = self._known.zero_length_m
        wanted = [zero_m * (1.0 + value) for value in (reference, *measurement.preview)]
        wanted_now = self._plan.next(wanted, self._acts_s, ahead)
        most_v = self._most_v
        drive_v = self._drive_v(ahead, wanted_now, (past_v[0] - most_v, past_v[0] + most_v))
        past_v.insert(0, drive_v)
        past_v.pop()
        return drive_v

    def _ahead(self, state: list[float], past_v: list[float]) -> list[float]:
        """The state when the new drive takes effect."""
        found = self._model.moved(state, past_v[self._whole], self._late_s)
        for k in range(self._whole - 1, -1, -1):
            found = self._model.moved(found, past_v[k], self._period_s)
        return found

    def _sensed_m(self, measurement: Measurement) -> float:
        known = self._known
        if math.isnan(measurement.capacitance_f):
            return known.length_m(measurement.strain)
        return known.sensed_length_m(measurement.capacitance_f, self._past_v[self._whole])

    def _observed(self, state: list[float], past_v: list[float], length_m: float) -> list[float]:
        """The state one period later, corrected by the sensed length unless that is NaN."""
        whole, late_s = self._whole, self._late_s
        state = self._model.moved(state, past_v[whole + 1], late_s)
        state = self._model.moved(state, past_v[whole], self._period_s - late_s)
        if math.isnan(length_m):
            return state
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
        self, state: list[float], wanted: tuple[float, float, float], limits_v: tuple[float, float]
    ) -> float:
        """Drive that leads the state back to the wanted length, speed and acceleration."""
        model, period_s = self._model, self._period_s
        length_m, speed = state[:2]
        pushed = (
            wanted[2] + self._per_m * (wanted[0] - length_m) + self._per_m_s * (wanted[1] - speed)
        )
        half_s = 0.5 * period_s
        middle_m = length_m + half_s * speed + 0.5 * half_s * half_s * pushed
        pull_n = model.needed_n(state, middle_m, speed + half_s * pushed, pushed)
        longest_m = max(middle_m, length_m + period_s * max(speed, 0.0))
        high_v = min(self._high_v, self._known.highest_drive_v(longest_m), limits_v[1])
        low_v = min(max(self._low_v, limits_v[0]), high_v)
        for _ in range(_CORRECTIONS):  # until the speed after the whole period is as wanted
            drive_v = max(min(self._known.drive_v(middle_m, pull_n), high_v), low_v)
            missed = speed + period_s * pushed - model.moved(state, drive_v, period_s)[1]
            pull_n += model.inertia_kg * missed / period_s
        return max(min(self._known.drive_v(middle_m, pull_n), high_v), low_v)

    def linear_loop(
        self, strain: float, stiffness: float = 1.0, later_s: float = 0.0
    ) -> LinearLoop:
        """The closed loop where it holds a strain, limits apart, by central differences.

        Args:
            strain: held.
            stiffness: of the actuator, over the identified one, about that strain.
            later_s: delay beyond the stated one.
        """
        known, period_s = self._known, self._period_s
        length_m, drive_v = known.length_m(strain), known.static_drive_v(strain)
        plant = self._model.stiffened(length_m, stiffness)
        rest = self._model.at_rest(length_m, drive_v)
        whole = int((self._whole * period_s + self._late_s + later_s) / period_s + 1e-9)
        late_s = self._whole * period_s + self._late_s + later_s - whole * period_s
        size, waiting = len(rest), max(whole, self._whole) + 2
        free = -math.inf, math.inf
        start = np.array([*rest[:-1], *rest, *[drive_v] * waiting])

        def after(change: Floats, load_n: float, noise_m: float, added_v: float) -> Floats:
            moved = start + change
            true = [*moved[: size - 1].tolist(), rest[-1] + load_n]
            seen, past_v = moved[size - 1 : 2 * size - 1].tolist(), moved[2 * size - 1 :].tolist()
            seen = self._observed(seen, past_v, true[0] + noise_m)
            new_v = self._drive_v(self._ahead(seen, past_v), (length_m, 0.0, 0.0), free)
            # the drives wait one more update: the actuator sees them as the observer does
            past_v = [new_v, *past_v[:-1]]
            true = plant.moved(true, past_v[whole + 1] + added_v, late_s)
            true = plant.moved(true, past_v[whole] + added_v, period_s - late_s)
            return np.array([*true[:-1], *seen, *past_v])

        small = [1e-7, 1e-5, *[1e-4] * (size - 3)]
        scales = np.array([*small, *small, 1e-4, *[1e-5] * waiting])
        none = np.zeros(start.size)

        def slope(k: int | None, load_n: float, noise_m: float, added_v: float) -> Floats:
            change = none.copy()
            scale = max(load_n, noise_m, added_v)
            if k is not None:
                change[k] = scale = scales[k]
            ends = [
                after(sign * change, sign * load_n, sign * noise_m, sign * added_v)
                for sign in (1.0, -1.0)
            ]
            return (ends[0] - ends[1]) / (2.0 * scale)

        a = np.stack([slope(k, 0.0, 0.0, 0.0) for k in range(start.size)], axis=1)
        load, added = slope(None, 1e-4, 0.0, 0.0), slope(None, 0.0, 0.0, 1e-5)
        noise = slope(None, 0.0, 1e-7, 0.0)
        at = 2 * size - 1  # of the newest drive
        drive = a[at].copy()
        length = none.copy()
        length[0] = 1.0
        return LinearLoop(a, load, noise, added, length, drive, float(noise[at]))

    def _observer_gains(self, strains: list[float]) -> list[list[float]]:
        """The steady gains of Kalman's filter at each strain."""
        known, model, period_s = self._known, self._model, self._period_s
        branches = len(known.law.losses.branch_share)
        creep = (_CREEP * model.weight_n) ** 2 * period_s
        noise = np.diag([0.0, 0.0, *[creep] * branches, self._load_n**2 * period_s])
        shaken = self._shake**2 * period_s
        noise[:2, :2] = shaken * np.array(
            [[period_s**2 / 3.0, period_s / 2.0], [period_s / 2.0, 1.0]]
        )
        unit = np.array([1e-6, 1e-4, *[1e-3] * branches, 1e-2])  # near 1, for the solver
        seen = np.zeros((1, unit.size))
        seen[0, 0] = 1.0
        gains = []
        for strain in strains:
            drive_v = known.static_drive_v(strain)
            a = model.linear(known.length_m(strain), drive_v, period_s) * unit / unit[:, None]
            missed = (known.length_noise_m(strain) / unit[0]) ** 2
            p = solve_discrete_are(a.T, seen.T, noise / np.outer(unit, unit), [[missed]])
            gains.append((p[:, 0] / (p[0, 0] + missed) * unit / unit[0]).tolist())
        return gains
