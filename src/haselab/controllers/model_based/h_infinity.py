r"""H-infinity loop shaping in the force of the field, with a planned reference.

The loop is closed in force coordinates, as that of `force`: about a strain in the middle of the
range, the plant from electric force to sensed length is linear, its delay and hold included. The
weight

$W(s) = g\,\frac{s + \omega_i}{s}\,\frac{1 + s/\omega_l}{1 + s/\omega_h}$

shapes it, and `coprime` adds the controller that is robust to the largest error of the shaped
plant's coprime factors. The inverse dynamics along a planned reference are fed forward. The
weight gets the force that was put out, not the one that was asked for, so it does not wind up.

Source: see `coprime`; the weight in self-conditioned form: R. Hanus, M. Kinnaert and
J.-L. Henrotte, Automatica 23 (1987), 729.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.actuators import GRAVITY_M_S2
from haselab.controllers.model_based.coprime import Sampled, in_series, robust_controller
from haselab.controllers.motion_model import MotionModel
from haselab.controllers.protocol import ControllerSetting, Measurement
from haselab.controllers.reference_plan import ReferencePlan
from haselab.controllers.sampled_point import SampledPoint, sampled_point

__all__ = ["HInfinityController", "Synthesis", "force_plant", "synthesis"]

Floats = NDArray[np.float64]
_SMALL_M, _SMALL_M_S, _SMALL_N = 1e-3, 0.03, 0.1  # units of the states, near 1 for the solver
_SLOWER = 8.0  # times the lead's zero: its pole
_WEIGHED_S = 0.04  # time constant of the mean load


@dataclass(frozen=True)
class Synthesis:
    """The designed loop: weight, controller, and how robust they are.

    Args:
        weight: from the output of the controller, in m, to a force, in N.
        controller: from the sensed length, in m; positive feedback.
        shaped: plant with weight.
        epsilon: stability margin that the controller has at least.
    """

    weight: Sampled
    controller: Sampled
    shaped: Sampled
    epsilon: float

    @property
    def feedback(self) -> Sampled:
        """From the sensed length, in m, to the force, in N."""
        return in_series(self.controller, self.weight)


def synthesis(setting: ControllerSetting, values: Mapping[str, float]) -> Synthesis:
    """Shape the plant in the middle of the reachable range, and find the robust controller.

    Args:
        setting: timing of the loop, and the actuator.
        values: parameters of `HInfinityController`.
    Returns:
        Weight and controller.
    Raises:
        ResultError: The equations have no solution.
    """
    assert setting.actuator is not None, "the kind needs it"
    low, high = setting.actuator.reachable()
    plant = force_plant(sampled_point(setting, 0.5 * (low + high)), setting)
    weight = _weight(values, setting.period_s)
    shaped = in_series(weight, plant)
    controller, epsilon, _ = robust_controller(shaped)
    return Synthesis(weight, controller, shaped, epsilon)


def force_plant(point: SampledPoint, setting: ControllerSetting) -> Sampled:
    """From an electric force, in N, to the length, in m, if the sensed length gives the voltage.

    Args:
        point: actuator about an equilibrium, whose input is the square of the voltage.
        setting: of the loop.
    """
    per_v2, bend = point.pull_per_v2, point.volt2 * point.pull_per_v2_m
    a, b = point.a - bend / per_v2 * np.outer(point.b, point.c), point.b / per_v2
    delay_s = 0.5 * setting.period_s if setting.delay_s is None else setting.delay_s
    waiting = int(delay_s / setting.period_s + 1e-9) + 1  # inputs, the last states
    unit = np.full(b.size, _SMALL_N)
    unit[:2], unit[-waiting:] = (_SMALL_M, _SMALL_M_S), _SMALL_N / abs(per_v2)
    return Sampled(a * unit / unit[:, None], b / unit, point.c * unit)


def _weight(values: Mapping[str, float], period_s: float) -> Sampled:
    """The weight by Tustin's rule, which keeps its inverse stable."""
    lead = values["lead_rad_s"]
    slow = _first_order(1.0, values["integral_rad_s"], 1.0, 0.0, period_s)
    fast = _first_order(1.0 / lead, 1.0, 1.0 / (_SLOWER * lead), 1.0, period_s)
    both, gain = in_series(slow, fast), values["gain_n_per_m"]
    return Sampled(both.a, both.b, gain * both.c, gain * both.d)


def _first_order(b1: float, b0: float, a1: float, a0: float, period_s: float) -> Sampled:
    rate = 2.0 / period_s
    over = a1 * rate + a0
    direct, pole = (b1 * rate + b0) / over, (a1 * rate - a0) / over
    rest = (b0 - b1 * rate) / over + direct * pole
    return Sampled(np.array([[pole]]), np.ones(1), np.array([rest]), direct)


class HInfinityController:
    """H-infinity loop shaping with inverse dynamics along a planned reference.

    Args:
        gain_n_per_m: of the weight between its corners.
        integral_rad_s: below which the weight integrates.
        lead_rad_s: from which on the weight rises, up to eight times that.
        reserve: share of the force's range that a plan leaves to the feedback.
    """

    def __init__(
        self, gain_n_per_m: float, integral_rad_s: float, lead_rad_s: float, reserve: float
    ) -> None:
        self._values = {"gain_n_per_m": gain_n_per_m, "integral_rad_s": integral_rad_s,
                        "lead_rad_s": lead_rad_s}  # fmt: skip
        self._reserve = reserve

    def start(self, setting: ControllerSetting) -> None:
        """See `Controller`."""
        known, period_s = setting.actuator, setting.period_s
        assert known is not None, "the kind needs it"
        self._known, self._period_s = known, period_s
        found = synthesis(setting, self._values)
        self._weight, self._controller = found.weight, found.controller
        self._model = MotionModel(known)
        self._plan = ReferencePlan(
            self._model, known, period_s, self._reserve, setting.highest_rate_per_s
        )
        delay_s = 0.5 * period_s if setting.delay_s is None else setting.delay_s
        age_s = 0.5 * period_s if setting.sensed_before_s is None else setting.sensed_before_s
        self._acts_s, self._delay_s = max(delay_s - age_s, 0.0), delay_s
        self._back = math.ceil(delay_s / period_s - 1e-9)
        self._low_v, self._high_v = max(setting.drive_low, 0.0), setting.drive_high
        self._most_v = setting.highest_rate_per_s * period_s
        self._decays = [math.exp(-period_s / tau) for _, tau in self._model.branches]
        self._forget = math.exp(-period_s / _WEIGHED_S)
        self._drive_v, self._load_mean_n = setting.drive_start, 0.0
        self._of_weight = np.zeros(self._weight.b.size)
        self._of_controller = np.zeros(self._controller.b.size)
        self._wanted: list[tuple[float, float, float]] = []  # the latest first
        self._state: list[float] = []  # of the motion along the reference

    @property
    def estimated_load_kg(self) -> float:
        """Hung mass whose weight the feedback holds beside the model, averaged over 0.04 s."""
        return self._known.mass_kg + self._load_mean_n / GRAVITY_M_S2

    def step(self, reference: float, measurement: Measurement) -> float:
        """See `Controller`; without a valid measurement the drive stays."""
        if not measurement.valid:
            return self._drive_v
        known, period_s = self._known, self._period_s
        length_m = known.length_m(measurement.strain)
        if not math.isnan(measurement.capacitance_f):
            length_m = known.sensed_length_m(measurement.capacitance_f, measurement.voltage_v)
        if not self._state:
            self._begin(length_m, measurement.voltage_v)
        samples_m = [known.length_m(value) for value in (reference, *measurement.preview)]
        loaded = [*self._state[:-1], self._load_mean_n]
        wanted = self._plan.next(samples_m, self._acts_s, loaded)
        self._wanted = [wanted, *self._wanted[: self._back]]
        away_m = length_m - self._as_sensed()
        from_controller = float(self._controller.c @ self._of_controller)
        from_controller += self._controller.d * away_m
        self._of_controller = self._controller.a @ self._of_controller + self._controller.b * away_m
        of_weight = float(self._weight.c @ self._of_weight)
        back_n = of_weight + self._weight.d * from_controller
        got_n = self._put_out(wanted, back_n, away_m)
        self._of_weight = self._weight.a @ self._of_weight + self._weight.b * (
            (got_n - of_weight) / self._weight.d
        )
        self._load_mean_n += (1.0 - self._forget) * (self._state[-1] - got_n - self._load_mean_n)
        self._move(wanted, period_s)
        return self._drive_v

    def _begin(self, length_m: float, drive_v: float) -> None:
        """Start without a jump: a load of the model explains the present force."""
        self._state = self._model.at_rest(length_m, drive_v)
        self._load_mean_n = self._state[-1]
        self._plan.begin(length_m)
        self._wanted = [(length_m, 0.0, 0.0)] * (self._back + 1)

    def _as_sensed(self) -> float:
        """The planned length at the time of the sensed one, in m."""
        length_m, speed, pushed = self._wanted[self._back]
        time_s = self._back * self._period_s - self._delay_s
        return length_m + time_s * (speed + 0.5 * time_s * pushed)

    def _put_out(self, wanted: tuple[float, float, float], back_n: float, away_m: float) -> float:
        """Set the drive of the plan's force and that of the feedback; return what is put out."""
        length_m, speed, pushed = wanted
        half_s = 0.5 * self._period_s
        middle_m = length_m + half_s * (speed + 0.5 * half_s * pushed)
        forward_n = self._model.needed_n(self._state, middle_m, speed + half_s * pushed, pushed)
        # where the actuator will be, if it stays as far from the plan as it was sensed
        coming_m = middle_m + away_m
        known = self._known
        longest_m = coming_m + half_s * max(speed, 0.0)
        high_v = min(self._high_v, known.highest_drive_v(longest_m), self._drive_v + self._most_v)
        low_v = min(max(self._low_v, self._drive_v - self._most_v), high_v)
        wanted_n = forward_n + back_n
        self._drive_v = min(max(known.drive_v(coming_m, wanted_n), low_v), high_v)
        limited = self._drive_v in (low_v, high_v)
        return known.pull_n(coming_m, self._drive_v) - forward_n if limited else back_n

    def _move(self, wanted: tuple[float, float, float], period_s: float) -> None:
        """Let the branches of the model follow the plan for an update."""
        length_m, speed, pushed = wanted
        after_m = length_m + period_s * (speed + 0.5 * period_s * pushed)
        change_n = self._model.elastic_n(after_m) - self._model.elastic_n(length_m)
        forces_n = [
            decay * force_n + share * change_n
            for decay, force_n, (share, _) in zip(
                self._decays, self._state[2:-1], self._model.branches, strict=True
            )
        ]
        self._state = [after_m, speed + period_s * pushed, *forces_n, self._state[-1]]
