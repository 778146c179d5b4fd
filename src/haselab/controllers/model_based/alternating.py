"""Alternating polarity: an `observer` whose voltage changes its sign, so that no charge builds up.

The force of the field depends on the square of the voltage, so its sign is free on a bipolar drive.
Charge that is retained in the dielectric follows the mean voltage slowly, and pulls on when the
voltage has gone. If the sign changes much faster than that, the mean is zero and nothing is
retained. The block in which the sign changes is not used for sensing: the voltage passes through
zero in it. The observer goes on alone there, with the drive that it asked for.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from haselab.base import InputError
from haselab.controllers.kind import ControllerKind, Parameter
from haselab.controllers.observer import ObserverController
from haselab.controllers.observer_design import OBSERVER, design_observer
from haselab.controllers.protocol import ControllerSetting, Measurement

__all__ = ["ALTERNATING", "AlternatingController", "design_alternating"]

_HALF_S = 0.05  # between two changes of the sign
_OF_RELAXATION = 0.02  # of the charge's time constant, at most
_LEAST_BLOCKS = 5  # of which one is not sensed


class AlternatingController:
    """An `observer` for the magnitude of a voltage whose sign alternates.

    Args:
        bandwidth_rad_s: see `ObserverController`.
        load_n: see there.
        shake_m_s2: see there.
        reserve: see there.
        half_period_s: between two changes of the sign.
    """

    def __init__(
        self, bandwidth_rad_s: float, load_n: float, shake_m_s2: float, reserve: float,
        half_period_s: float,
    ) -> None:  # fmt: skip
        self._inner = ObserverController(bandwidth_rad_s, load_n, shake_m_s2, reserve)
        self._half_s = half_period_s

    def start(self, setting: ControllerSetting) -> None:
        """See `Controller`.

        Raises:
            InputError: The drive has one sign, or changes too slowly.
        """
        inner = _one_sign(setting)
        self._blocks = max(round(self._half_s / setting.period_s), _LEAST_BLOCKS)
        self._count, self._sign = 0, 1.0 if setting.drive_start >= 0.0 else -1.0
        self._before_v = setting.drive_start
        self._inner.start(inner)

    @property
    def estimated_load_kg(self) -> float:
        """Hung mass, by the inner observer."""
        return self._inner.estimated_load_kg

    def step(self, reference: float, measurement: Measurement) -> float:
        """See `Controller`; the block in which the sign changed counts as one without sensing."""
        changed = measurement.voltage_v * self._before_v < 0.0
        self._before_v = measurement.voltage_v
        seen = replace(
            measurement, voltage_v=abs(measurement.voltage_v),
            valid=measurement.valid and not changed,
        )  # fmt: skip
        drive_v = self._inner.step(reference, seen)
        if measurement.valid:
            self._inner.put_out(drive_v)  # in the block that is not sensed, too
        self._count += 1
        if self._count >= self._blocks:
            self._count, self._sign = 0, -self._sign
        return self._sign * drive_v


def _one_sign(setting: ControllerSetting) -> ControllerSetting:
    """The setting of the magnitude.

    Raises:
        InputError: The drive has one sign, or changes too slowly.
    """
    known = setting.actuator
    assert known is not None, "the kind needs it"
    high_v = min(setting.drive_high, -setting.drive_low)
    if high_v <= 0.0:
        raise InputError(
            f"Controller 'alternating' needs both signs of the voltage, but the drive is limited "
            f"to {setting.drive_low:g} to {setting.drive_high:g} V. Set drive.low_v below 0 V if "
            "the amplifier is bipolar, or use the controller observer."
        )
    if setting.highest_rate_per_s * setting.period_s < 2.0 * high_v:
        raise InputError(
            f"Controller 'alternating' changes the drive by up to {2.0 * high_v:g} V in one "
            f"update, but the rate limit of the drive permits "
            f"{setting.highest_rate_per_s * setting.period_s:g} V. Use the controller observer."
        )
    return replace(
        setting, drive_low=0.0, drive_high=high_v, drive_start=abs(setting.drive_start),
        actuator=replace(known, low_v=0.0, high_v=min(high_v, known.high_v)),
    )  # fmt: skip


def design_alternating(setting: ControllerSetting) -> Mapping[str, float]:
    """Take the design of `observer`, and change the sign every 0.05 s.

    The sign changes at least fifty times within the time constant of the retained charge, if the
    model has one. The peak sensitivity of the inner loop is at most 2.5 with the stiffness 10 %
    higher, and with it 10 % lower and the delay a fifth longer; at most 5 with the delay longer by
    half. One block of a half period is not sensed.

    Args:
        setting: timing and limits of the loop, and the actuator.
    Returns:
        The parameters of `AlternatingController`.
    Raises:
        InputError: The drive has one sign, or changes too slowly.
        ResultError: No parameters keep the loop stable.
    """
    ALTERNATING.check(setting)
    inner = _one_sign(setting)
    assert inner.actuator is not None
    losses, half_s = inner.actuator.law.losses, _HALF_S
    if losses.charge_share > 0.0:
        half_s = min(half_s, _OF_RELAXATION * losses.charge_relaxation_s)
    blocks = max(math.floor(half_s / setting.period_s + 1e-9), _LEAST_BLOCKS)
    return {**design_observer(inner), "half_period_s": float(f"{blocks * setting.period_s:.4g}")}


ALTERNATING = ControllerKind(
    "alternating",
    AlternatingController,
    (*OBSERVER.parameters, Parameter("half_period_s", "s", _HALF_S, 1e-3, 1e3)),
    output="voltage",
    needs_actuator=True,
    design=design_alternating,
    preview_s=OBSERVER.preview_s,
    alternates=True,
)
