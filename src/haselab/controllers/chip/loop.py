"""The loop that the microcontroller closes, for controllers that are designed for it."""

from __future__ import annotations

import math
from dataclasses import replace

from haselab.controllers.known_actuator import KnownActuator
from haselab.controllers.protocol import ControllerSetting
from haselab.firmware import (
    CAPACITANCE_NOISE,
    HIGHEST_DRIVE_V,
    MOTION_RISE_V_PER_S,
    RATE_HZ,
    UPDATE_AGE_S,
    UPDATE_DELAY_S,
)

__all__ = ["chip_setting"]


def chip_setting(
    known: KnownActuator,
    highest_v: float = HIGHEST_DRIVE_V,
    rise_v_per_s: float = MOTION_RISE_V_PER_S,
) -> ControllerSetting:
    """Timing, noise and limits of the firmware's loop.

    Args:
        known: identified actuator, in whose place one with the noise of the firmware's sensing is
            put.
        highest_v: highest drive.
        rise_v_per_s: fastest change of the drive.
    Returns:
        The setting.
    """
    farad = known.sensing_scale * float(known.law.capacitance_f(known.zero_length_m))
    noisy = replace(known, capacitance_noise_f=CAPACITANCE_NOISE * math.fabs(farad))
    low_v, high_v = max(known.low_v, 0.0), min(known.high_v, highest_v)
    return ControllerSetting(
        1.0 / RATE_HZ, low_v, high_v, low_v, UPDATE_DELAY_S, noisy, UPDATE_AGE_S, rise_v_per_s
    )
