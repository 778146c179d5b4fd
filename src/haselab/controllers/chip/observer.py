"""Observer with inverse dynamics in integers: `hs_observer_step` of the core.

It is the law of `haselab.controllers.observer` with four simplifications: the state of the observer
is that at the time at which the drive acts, so that nothing is predicted twice; creep follows the
model alone; the sensed length corrects length, speed and load; and a plan is the polynomial from
rest to rest, two of which may overlap.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

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
from haselab.controllers.chip.observer_design import (
    design_chip_observer,
    feedback_gains,
    steady_gains,
)
from haselab.controllers.kind import ControllerKind
from haselab.controllers.observer_design import OBSERVER
from haselab.controllers.protocol import ControllerSetting, Measurement

__all__ = ["CHIP_OBSERVER", "ChipObserverController"]

_WEIGHED_S = 0.04  # time constant of the mean load


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
        # the branches relax a share of elastic force minus weight, not of the elastic force alone
        relaxed = float(motion.numbers["branch_share"].sum()) / 2.0**15
        self._relaxed_n = relaxed * GRAVITY_M_S2 * self._known.mass_kg
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
        load_n = self._loop.load * self._per_load_n - self._relaxed_n
        self._load_mean_n = load_n + self._forget * (self._load_mean_n - load_n)
        return found

    def c_text(self, setting: ControllerSetting) -> str:
        """See `ChipController`."""
        motion, gains = self._records(setting)
        return c_file("observer", motion.numbers, gains)

    def _records(self, setting: ControllerSetting) -> tuple[MotionRecord, NDArray[np.void]]:
        motion = motion_record(setting, self._reserve)
        per_x, per_v = feedback_gains(motion, self._bandwidth, setting.period_s)
        gains = np.zeros((), _core.OBSERVER)
        gains["kp"] = as_q(per_x, 10, "The gain of the length")
        gains["kd"] = as_q(per_v, 10, "The gain of the speed")
        set_lag(gains, motion, setting)
        knots = gains["gain_x"].size
        for k, x in enumerate(np.linspace(0.0, 1.0, knots)):
            strain = motion.low + motion.span * float(x)
            row = steady_gains(motion, setting, strain, self._load_n, self._shake)
            gains["gain_x"][k] = as_q(row[0], 13, "A gain of the observer", 2**13)
            gains["gain_v"][k] = as_q(row[1], 13, "A gain of the observer")
            gains["gain_load"][k] = as_q(row[2], 13, "A gain of the observer")
        return motion, gains


CHIP_OBSERVER = ControllerKind(
    "chip-observer",
    ChipObserverController,
    OBSERVER.parameters,
    output="voltage",
    needs_actuator=True,
    design=design_chip_observer,
    loop=chip_setting,
)
