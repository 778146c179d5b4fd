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

from haselab.actuators import GRAVITY_M_S2
from haselab.controllers.known_actuator import KnownActuator
from haselab.controllers.observer_law import ObserverLaw
from haselab.controllers.protocol import ControllerSetting, Measurement, waiting_drives
from haselab.controllers.reference_plan import ReferencePlan

__all__ = ["ObserverController"]

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
        self._known, period_s = setting.actuator, setting.period_s
        law = self._law = ObserverLaw(setting, self._bandwidth, self._load_n, self._shake)
        age_s = 0.5 * period_s if setting.sensed_before_s is None else setting.sensed_before_s
        self._acts_s = max(law.delay_s - age_s, 0.0)  # after the end of a block
        self._most_v = setting.highest_rate_per_s * period_s
        self._past_v = [setting.drive_start] * (law.whole + 2)  # the latest first
        self._waiting = waiting_drives(setting)
        self._plan = self._new_plan(law, setting)
        self._state: list[float] | None = None
        self._load_mean_n, self._forget = 0.0, math.exp(-period_s / _WEIGHED_S)

    def _new_plan(self, law: ObserverLaw, setting: ControllerSetting) -> ReferencePlan:
        return ReferencePlan(
            law.model, self._known, setting.period_s, self._reserve, setting.highest_rate_per_s
        )

    @property
    def estimated_load_kg(self) -> float:
        """Hung mass, by the estimated load of the last 0.1 s."""
        return self._known.mass_kg + self._load_mean_n / GRAVITY_M_S2

    def step(self, reference: float, measurement: Measurement) -> float:
        """See `Controller`; without a valid measurement the observer goes on alone."""
        past_v, law = self._past_v, self._law
        past_v[self._waiting] = measurement.voltage_v
        length_m = math.nan
        if measurement.valid:
            length_m = self._sensed_m(measurement)
        if self._state is None:
            if math.isnan(length_m):
                return past_v[0]
            self._state = law.model.at_rest(length_m, past_v[law.whole])
            self._plan.begin(length_m)
        state = self._state = law.observed(self._state, past_v, length_m)
        self._load_mean_n = state[-1] + self._forget * (self._load_mean_n - state[-1])
        ahead = law.ahead(state, past_v)
        zero_m = self._known.zero_length_m
        wanted = [zero_m * (1.0 + value) for value in (reference, *measurement.preview)]
        wanted_now = self._plan.next(wanted, self._acts_s, ahead)
        most_v = self._most_v
        drive_v = law.drive_v(ahead, wanted_now, (past_v[0] - most_v, past_v[0] + most_v))
        past_v.insert(0, drive_v if measurement.valid else past_v[0])  # else the output is kept
        past_v.pop()
        return drive_v

    def exchange(self, known: KnownActuator, law: ObserverLaw) -> None:
        """Go on with the model of another hung mass; the weight, the motion and the plan stay.

        Args:
            known: the actuator with that mass.
            law: of it.
        """
        change_n = GRAVITY_M_S2 * (self._known.mass_kg - known.mass_kg)
        if self._state is not None:
            self._state = [*self._state[:-1], self._state[-1] + change_n]
        self._load_mean_n += change_n
        self._known, self._law = known, law
        self._plan.exchange(law.model, known)

    def put_out(self, drive_v: float) -> None:
        """Tell the observer that another drive than its last one was put out."""
        self._past_v[0] = drive_v

    def _sensed_m(self, measurement: Measurement) -> float:
        known = self._known
        if math.isnan(measurement.capacitance_f):
            return known.length_m(measurement.strain)
        return known.sensed_length_m(measurement.capacitance_f, self._past_v[self._law.whole])
