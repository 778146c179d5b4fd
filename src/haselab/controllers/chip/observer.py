"""Observer with inverse dynamics in integers: `hs_observer_step` of the core.

It is the law of `haselab.controllers.observer` with four simplifications: the state of the observer
is that at the time at which the drive acts, so that nothing is predicted twice; creep follows the
model alone; the sensed length corrects length, speed and load; and a plan is the polynomial from
rest to rest, two of which may overlap.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from haselab import _core
from haselab.actuators import GRAVITY_M_S2
from haselab.controllers.chip.c_text import c_file
from haselab.controllers.chip.loop import chip_setting
from haselab.controllers.chip.motion_record import (
    MotionRecord,
    as_q,
    motion_record,
    sensed_strain,
    set_lag,
)
from haselab.controllers.kind import ControllerKind
from haselab.controllers.observer_design import OBSERVER, design_observer
from haselab.controllers.observer_law import critical_feedback, process_noise
from haselab.controllers.protocol import ControllerSetting, Measurement

__all__ = ["CHIP_OBSERVER", "ChipObserverController"]

Floats = NDArray[np.float64]
_WEIGHED_S = 0.04  # time constant of the mean load
_SHAKEN = 0.06  # of the highest drive, by noise: more than on the bench, whose sensing is quieter


class ChipObserverController:
    """State feedback of an observer, with the bits of the microcontroller.

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
        self._known = setting.actuator
        motion, gains = self._records(setting)
        self._loop = _core.Observer(motion.numbers, gains)
        self._per_load_n = 1.0 / (2.0**30 * motion.acceleration_of(1.0, self._known.zero_length_m))
        self._load_mean_n, self._forget = 0.0, math.exp(-setting.period_s / _WEIGHED_S)

    @property
    def estimated_load_kg(self) -> float:
        """Hung mass, by the estimated load of the last 0.1 s."""
        return self._known.mass_kg + self._load_mean_n / GRAVITY_M_S2

    def step(self, reference: float, measurement: Measurement) -> float:
        """See `Controller`; without a valid measurement the observer goes on alone."""
        strain = 0.0
        if measurement.valid:
            strain = sensed_strain(self._known, measurement)
        found = self._loop.step(reference, strain, measurement.voltage_v, measurement.valid)
        load_n = self._loop.load * self._per_load_n
        self._load_mean_n = load_n + self._forget * (self._load_mean_n - load_n)
        return found

    def c_text(self, setting: ControllerSetting) -> str:
        """See `ChipController`."""
        motion, gains = self._records(setting)
        return c_file("observer", motion.numbers, gains)

    def _records(self, setting: ControllerSetting) -> tuple[MotionRecord, NDArray[np.void]]:
        motion = motion_record(setting, self._reserve)
        per_x, per_v = critical_feedback(self._bandwidth, setting.period_s)
        gains = np.zeros((), _core.OBSERVER)
        gains["kp"] = as_q(per_x * motion.unit_s**2, 10, "The gain of the length")
        gains["kd"] = as_q(per_v * motion.unit_s, 10, "The gain of the speed")
        set_lag(gains, motion, setting)
        for k, row in enumerate(self._steady_gains(motion, setting, gains)):
            for name, value in zip(("gain_x", "gain_v", "gain_load"), row, strict=True):
                gains[name][k] = as_q(
                    value, 13, "A gain of the observer", 2**13 if name == "gain_x" else 2**15 - 1
                )
        return motion, gains

    def _steady_gains(
        self, motion: MotionRecord, setting: ControllerSetting, gains: NDArray[np.void]
    ) -> list[list[float]]:
        """Gains of Kalman's filter for length, speed and load, at rest at each knot."""
        known, period_s = setting.actuator, setting.period_s
        assert known is not None
        width_m, step = known.zero_length_m * motion.span, period_s / motion.unit_s
        scale = np.array([1.0, motion.unit_s]) / width_m
        noise = np.zeros((3, 3))
        noise[:2, :2] = process_noise(self._shake, period_s) * np.outer(scale, scale)
        load = motion.acceleration_of(self._load_n, known.zero_length_m)
        noise[2, 2] = load**2 * period_s
        lag, square = gains["lag"] / 2.0**15, gains["lag_square"] / 2.0**16
        found = []
        for k, stiffness in enumerate(motion.slopes):
            strain = motion.low + motion.span * k / (motion.slopes.size - 1)
            error = known.length_noise_m(strain) / width_m
            a, accelerates = _transition(float(stiffness), motion.drag, step)
            seen = np.array([1.0, -lag, 0.0]) + square * accelerates
            p = solve_discrete_are(a.T, seen[:, None], noise / error**2, [[1.0]])
            found.append((p @ seen / (seen @ p @ seen + 1.0)).tolist())
        return found


def _transition(stiffness: float, drag: float, step: float) -> tuple[Floats, Floats]:
    """One step of the core from length, speed and load, and the acceleration in it."""
    half = np.array([[1.0, 0.5 * step, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    accelerates = np.array([-stiffness, -drag - 0.5 * step * stiffness, 1.0])
    after = half @ (half + np.outer([0.0, 1.0, 0.0], step * accelerates))
    return after, accelerates


def _design(setting: ControllerSetting) -> Mapping[str, float]:
    """Choose bandwidth and expected load as for `observer`, with more noise of the drive.

    Over three strains of the reachable range, the peak sensitivity is at most 2.5 with the
    stiffness 10 % higher, and with it 10 % lower and the delay a fifth longer; at most 5 with the
    delay longer by half. Noise moves the drive by at most 6 % of its range (standard deviation).

    Args:
        setting: timing of the loop, and the actuator.
    Returns:
        The parameters of `ChipObserverController`.
    """
    return design_observer(setting, _SHAKEN)


CHIP_OBSERVER = ControllerKind(
    "chip-observer",
    ChipObserverController,
    OBSERVER.parameters,
    output="voltage",
    needs_actuator=True,
    design=_design,
    loop=chip_setting,
)
