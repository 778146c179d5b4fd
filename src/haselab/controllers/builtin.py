"""The controllers that come with haselab: PID, PI and open loop."""

from __future__ import annotations

import math

from haselab import _core
from haselab.controllers.kind import ChosenController, ControllerKind, Parameter
from haselab.controllers.protocol import ControllerSetting, Measurement

__all__ = ["OPEN_LOOP", "PI", "PID", "OpenLoop", "PidController", "pid_controller"]

_GAIN = 1e9


class PidController:
    """The PID of the C core, with the same bits as on the microcontroller.

    Args:
        kp: proportional gain, dimensionless.
        ki: integral gain, in 1/s.
        kd: derivative gain, in s.
        derivative_filter_s: time constant of the measurement's filter, in s.
    """

    def __init__(
        self, kp: float, ki: float, kd: float = 0.0, derivative_filter_s: float = 0.0
    ) -> None:
        self._gains = (kp, ki, kd)
        self._filter_s = derivative_filter_s
        self._pid: _core.Pid | None = None

    def start(self, setting: ControllerSetting) -> None:
        """See `Controller`."""
        self._pid = _core.Pid(
            *self._gains,
            setting.period_s,
            self._filter_s,
            setting.drive_low,
            setting.drive_high,
        )
        self._pid.reset(setting.drive_start)

    def step(self, reference: float, measurement: Measurement) -> float:
        """See `Controller`; without a valid measurement nothing is integrated."""
        assert self._pid is not None, "start() comes first"
        return self._pid.step(reference, measurement.strain if measurement.valid else math.nan)


class OpenLoop:
    """The reference is the drive: the voltage map alone, without feedback."""

    def start(self, setting: ControllerSetting) -> None:
        """See `Controller`."""

    def step(self, reference: float, measurement: Measurement) -> float:
        """See `Controller`."""
        return reference


_PI = (Parameter("kp", "", None, 0.0, _GAIN), Parameter("ki", "1/s", None, 0.0, _GAIN))
_PID = (
    *_PI,
    Parameter("kd", "s", 0.0, 0.0, _GAIN),
    Parameter("derivative_filter_s", "s", 0.0, 0.0, _GAIN),
)
PID = ControllerKind("pid", PidController, _PID)
PI = ControllerKind("pi", PidController, _PI)
OPEN_LOOP = ControllerKind("open-loop", OpenLoop)


def pid_controller(
    kp: float, ki: float, kd: float = 0.0, derivative_filter_s: float = 0.0
) -> ChosenController:
    """Create a PID with its gains.

    Args:
        kp: proportional gain, dimensionless.
        ki: integral gain, in 1/s.
        kd: derivative gain, in s.
        derivative_filter_s: time constant of the measurement's filter, in s.
    Returns:
        The controller, ready to be started.
    Raises:
        InputError: A gain is negative or not finite.
    """
    gains = {"kp": kp, "ki": ki, "kd": kd, "derivative_filter_s": derivative_filter_s}
    return PID.choose(gains)
