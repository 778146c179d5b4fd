"""Force-coordinate loop in integers: `hs_force_step` of the core on computer and chip.

It is the loop of `haselab.controllers.force` with a planned reference in place of the smoothed one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from haselab import _core
from haselab.controllers.chip.c_text import c_file
from haselab.controllers.chip.loop import chip_setting
from haselab.controllers.chip.motion_record import (
    as_q,
    motion_record,
    require_square_law,
    sensed_strain,
    set_lag,
)
from haselab.controllers.force import ForceDemands, design_force
from haselab.controllers.kind import ControllerKind, Parameter
from haselab.controllers.protocol import ControllerSetting, Measurement

__all__ = ["CHIP_FORCE", "ChipForceController"]

_GAIN, _RESERVE = 1e6, 0.15
_DEMANDS = ForceDemands(
    moved=1.5, shaken=0.04, changed=1.0, slower=(-1.4, -2.1, -2.8), filtered=1.0
)


class ChipForceController:
    """PID in the force of the field, with the bits of the microcontroller.

    Args:
        kp: proportional gain, in N per strain.
        ki: integral gain, in N/s per strain.
        kd: derivative gain, in N s per strain.
        filter_s: time constant of the derivative's filter, in s.
        reserve: share of the force's range that a plan leaves to the feedback.
    """

    def __init__(self, kp: float, ki: float, kd: float, filter_s: float, reserve: float) -> None:
        self._gains, self._filter_s, self._reserve = (kp, ki, kd), filter_s, reserve

    def start(self, setting: ControllerSetting) -> None:
        """See `Controller`."""
        assert setting.actuator is not None, "the kind needs it"
        self._known = setting.actuator
        self._loop = _core.Force(*self._records(setting))

    def step(self, reference: float, measurement: Measurement) -> float:
        """See `Controller`; without a valid measurement the drive is kept."""
        strain = 0.0
        if measurement.valid:
            strain = sensed_strain(self._known, measurement)
        return self._loop.step(reference, strain, measurement.voltage_v, measurement.valid)

    def c_text(self, setting: ControllerSetting) -> str:
        """See `ChipController`."""
        return c_file("force", *self._records(setting))

    def _records(self, setting: ControllerSetting) -> tuple[NDArray[np.void], NDArray[np.void]]:
        motion = motion_record(setting, self._reserve)
        assert setting.actuator is not None
        unit_s, period_s = motion.unit_s, setting.period_s
        scale = unit_s**2 / (motion.inertia_kg * setting.actuator.zero_length_m)
        kp, ki, kd = (scale * gain for gain in self._gains)
        share = 1.0 - math.exp(-period_s / max(self._filter_s, 1e-9))
        gains = np.zeros((), _core.FORCE)
        gains["kp"] = as_q(kp, 10, "kp")
        gains["kd"] = as_q(kd * share / period_s, 10, "kd")
        gains["ki"] = as_q(ki * period_s, 13, "ki")
        gains["filter"] = min(round(share * 2.0**16), 65535)
        set_lag(gains, motion, setting)
        return motion.numbers, gains


def _design(setting: ControllerSetting) -> Mapping[str, float]:
    """Choose the gains of the force loop that reject a change of load best.

    As for `force`: over three strains of the reachable range, with the stiffness 10 % lower and
    higher and the delay 2 ms longer, the peak sensitivity is at most 1.8. Noise moves the actuator
    by at most 1.5 times the noise of the sensed length, the drive by at most 4 % of its range and
    from one update to the next by at most what the loop allows (standard deviations).

    Args:
        setting: timing of the loop, and the actuator.
    Returns:
        The parameters of `ChipForceController`.
    """
    assert setting.actuator is not None, "the kind needs it"
    require_square_law(setting.actuator)  # before a search of a minute
    found = dict(design_force(setting, _DEMANDS))
    del found["reference_s"]
    return {**found, "reserve": _RESERVE}


CHIP_FORCE = ControllerKind(
    "chip-force",
    ChipForceController,
    (
        Parameter("kp", "N", None, 0.0, _GAIN),
        Parameter("ki", "N/s", None, 0.0, _GAIN),
        Parameter("kd", "N s", None, 0.0, _GAIN),
        Parameter("filter_s", "s", None, 1e-6, 1.0),
        Parameter("reserve", "", _RESERVE, 0.0, 0.9),
    ),
    output="voltage",
    needs_actuator=True,
    design=_design,
    loop=chip_setting,
)
