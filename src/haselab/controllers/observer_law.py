"""What the observer and the feedback of `observer` compute, without a memory of their own."""

from __future__ import annotations

import math
from copy import copy

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from haselab.controllers.known_actuator import KnownActuator
from haselab.controllers.motion_model import MotionModel
from haselab.controllers.protocol import ControllerSetting

__all__ = ["ObserverLaw", "critical_feedback", "process_noise"]

_POINTS = 9  # strains of the reachable range at which the observer's gains are computed
_CREEP = 1e-3  # of the weight, per root of a second: how uncertain the branches are
_CORRECTIONS = 2


def critical_feedback(bandwidth_rad_s: float, period_s: float) -> tuple[float, float]:
    """Acceleration over error and over its rate with which an error decays without oscillation.

    Args:
        bandwidth_rad_s: of the decay.
        period_s: for which an acceleration is held.
    Returns:
        Gains in 1/s^2 and 1/s.
    Example:
        >>> [round(gain) for gain in critical_feedback(10.0, 1e-6)]
        [100, 20]
    """
    decay = math.exp(-bandwidth_rad_s * period_s)
    return ((1.0 - decay) / period_s) ** 2, 0.5 * (1.0 - decay) * (3.0 + decay) / period_s


def process_noise(shake_m_s2: float, period_s: float) -> NDArray[np.float64]:
    """Covariance of length and speed after one period of unknown accelerations.

    Args:
        shake_m_s2: in m/s^2 per root of hertz.
        period_s: of an update.
    """
    rows = [[period_s**2 / 3.0, period_s / 2.0], [period_s / 2.0, 1.0]]
    return shake_m_s2**2 * period_s * np.array(rows)


class ObserverLaw:
    """One update of observer and feedback, for any state and any drives before it.

    States are those of `MotionModel`; drives are a list, the latest first.

    Args:
        setting: of the loop, with the actuator.
        bandwidth_rad_s: see `ObserverController`.
        load_n: see `ObserverController`.
        shake_m_s2: see `ObserverController`.
    """

    def __init__(
        self, setting: ControllerSetting, bandwidth_rad_s: float, load_n: float, shake_m_s2: float
    ) -> None:
        assert setting.actuator is not None, "the kind needs it"
        known = self._known = setting.actuator
        self.model, period_s = MotionModel(known), setting.period_s
        self._period_s, self._load_n, self._shake = period_s, load_n, shake_m_s2
        self.delay_s = 0.5 * period_s if setting.delay_s is None else setting.delay_s
        self.whole = int(self.delay_s / period_s + 1e-9)  # periods of the delay
        self._late_s = self.delay_s - self.whole * period_s
        self._per_m, self._per_m_s = critical_feedback(bandwidth_rad_s, period_s)
        self._low_v, self._high_v = max(setting.drive_low, 0.0), setting.drive_high
        low, high = known.reachable()
        self._strains = np.linspace(low, high, _POINTS).tolist()
        self._rests = [
            (
                self.model.linear(known.length_m(strain), known.static_drive_v(strain), period_s),
                known.length_noise_m(strain),
            )
            for strain in self._strains
        ]
        self._gains = self._steady_gains()

    def tuned(self, bandwidth_rad_s: float, load_n: float) -> ObserverLaw:
        """The same law with another bandwidth and expected load.

        Args:
            bandwidth_rad_s: see `ObserverController`.
            load_n: see `ObserverController`.
        """
        found = copy(self)
        found._per_m, found._per_m_s = critical_feedback(bandwidth_rad_s, self._period_s)
        found._load_n = load_n
        found._gains = found._steady_gains()
        return found

    def observed(self, state: list[float], past_v: list[float], length_m: float) -> list[float]:
        """The state one period later, corrected by the sensed length.

        Args:
            state: at the measurement before.
            past_v: drives.
            length_m: sensed; NaN: not known.
        """
        whole, late_s = self.whole, self._late_s
        state = self.model.moved(state, past_v[whole + 1], late_s)
        state = self.model.moved(state, past_v[whole], self._period_s - late_s)
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

    def ahead(self, state: list[float], past_v: list[float]) -> list[float]:
        """The state when the new drive takes effect.

        Args:
            state: at the last measurement.
            past_v: drives.
        """
        found = self.model.moved(state, past_v[self.whole], self._late_s)
        for k in range(self.whole - 1, -1, -1):
            found = self.model.moved(found, past_v[k], self._period_s)
        return found

    def drive_v(
        self, state: list[float], wanted: tuple[float, float, float], limits_v: tuple[float, float]
    ) -> float:
        """Drive that leads the state back to what is wanted.

        Args:
            state: when the drive takes effect.
            wanted: length, speed and acceleration then.
            limits_v: lowest and highest drive, beside those of the setting and of the field.
        """
        model, period_s = self.model, self._period_s
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

    def hung(self, known: KnownActuator) -> ObserverLaw:
        """The same gains with the motion of another hung mass.

        Args:
            known: the actuator with that mass.
        """
        found = copy(self)
        found._known, found.model = known, self.model.hung(known.mass_kg)
        return found

    def _steady_gains(self) -> list[list[float]]:
        """Gains of Kalman's filter at rest, at each strain."""
        model, period_s = self.model, self._period_s
        branches = len(model.branches)
        creep = (_CREEP * model.weight_n) ** 2 * period_s
        noise = np.diag([0.0, 0.0, *[creep] * branches, self._load_n**2 * period_s])
        noise[:2, :2] = process_noise(self._shake, period_s)
        unit = np.array([1e-6, 1e-4, *[1e-3] * branches, 1e-2])  # near 1, for the solver
        seen = np.zeros((1, unit.size))
        seen[0, 0] = 1.0
        gains = []
        for linear, noise_m in self._rests:
            a = linear * unit / unit[:, None]
            missed = (noise_m / unit[0]) ** 2
            p = solve_discrete_are(a.T, seen.T, noise / np.outer(unit, unit), [[missed]])
            gains.append((p[:, 0] / (p[0, 0] + missed) * unit / unit[0]).tolist())
        return gains
