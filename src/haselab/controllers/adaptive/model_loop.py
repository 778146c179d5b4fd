"""Plays a controller on its own model of the actuator: what its design predicts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from haselab.controllers.motion_model import MotionModel
from haselab.controllers.protocol import (
    Controller,
    ControllerSetting,
    Measurement,
    waiting_drives,
)

__all__ = ["play_on_model"]

Floats = NDArray[np.float64]


def play_on_model(
    controller: Controller, setting: ControllerSetting, wanted: Floats, ahead: int,
    other: tuple[float, float] = (1.0, 0.0),
) -> Floats:  # fmt: skip
    """Strains that follow a reference, without noise, from rest at its first value.

    Args:
        controller: whose output is a voltage.
        setting: of the loop, with the actuator.
        wanted: desired strain of each update. Shape `(N,)`.
        ahead: number of desired strains that the controller sees in advance; the last one stays.
        other: stiffness of the actuator over the identified one; delay beyond the stated one, s.
    Returns:
        Measured strains. Shape `(N,)`.
    """
    known, period_s = setting.actuator, setting.period_s
    assert known is not None
    length_m, drive_v = known.length_m(float(wanted[0])), known.static_drive_v(float(wanted[0]))
    model = MotionModel(known).stiffened(length_m, other[0])
    delay_s = (0.5 * period_s if setting.delay_s is None else setting.delay_s) + other[1]
    whole = int(delay_s / period_s + 1e-9)
    late_s = delay_s - whole * period_s
    past_v, state = [drive_v] * (whole + 2), model.at_rest(length_m, drive_v)
    waiting = waiting_drives(setting)
    controller.start(replace(setting, drive_start=drive_v))
    values = [*wanted.tolist(), *[float(wanted[-1])] * ahead]
    found = np.empty(wanted.size)
    for k in range(wanted.size):
        found[k] = known.strain(state[0])
        measured = Measurement(
            float(found[k]), float("nan"), past_v[waiting], (k + 1.0) * period_s,
            preview=tuple(values[k + 1 : k + 1 + ahead]),
        )  # fmt: skip
        past_v = [controller.step(values[k], measured), *past_v[:-1]]
        state = model.moved(state, past_v[whole + 1], late_s)
        state = model.moved(state, past_v[whole], period_s - late_s)
    return found
