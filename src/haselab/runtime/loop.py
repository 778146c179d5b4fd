"""A closed loop's settings, and any registered controller running in it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from haselab.base import InputError, LimitError, SafetyError, described, is_real, shown
from haselab.base.exits import TooLongError, no_exit
from haselab.control import Saturation
from haselab.controllers import (
    ChosenController,
    Controller,
    ControllerSetting,
    KnownActuator,
    Measurement,
)
from haselab.models.actuator.strain_map import StrainMap
from haselab.models.maps import VoltageMap
from haselab.runtime.call_limit import CallLimit

__all__ = ["LoopSettings", "RunningController"]

_REACH_POINTS = 1001  # strains at which the voltage map is checked


@dataclass(frozen=True)
class LoopSettings:
    """A closed loop: S10 of the reference study.

    Args:
        controller: a controller of any registered kind.
        saturation: of the corrected strain.
        voltage_map: corrected strain to drive voltage.
        strain_map: capacitance to strain.
        video_zero_px: length between the rows of fiducials at zero strain, in px, to use the camera
            as the sensor; None: use the capacitance.
        printed_chain: capacitance by the reference study's own chain instead of the lock-in.
        extra_delay_blocks: blocks by which each output is delayed beyond the rig's own delay.
        carrier_v: peak amplitude of the sensing signal for this loop; None: that of the run.
        actuator: the identified actuator, for controllers that use its physics; None: not known.
    """

    controller: ChosenController
    saturation: Saturation
    voltage_map: VoltageMap
    strain_map: StrainMap
    video_zero_px: float | None = None
    printed_chain: bool = False
    extra_delay_blocks: int = 0
    carrier_v: float | None = None
    actuator: KnownActuator | None = None

    def setting(
        self,
        period_s: float,
        delay_s: float | None,
        drive_limits_v: tuple[float, float],
        sensed_before_s: float | None = None,
    ) -> ControllerSetting:
        """Timing and limits of the loop, for the controller.

        Args:
            period_s: time between two steps, in s.
            delay_s: see `ControllerSetting`.
            drive_limits_v: lowest and highest voltage of the rig.
            sensed_before_s: see `ControllerSetting`.
        Raises:
            InputError: The kind of the controller needs the identified actuator.
        """
        low, high, start = self.saturation.low, self.saturation.high, 0.0
        if self.controller.kind.output == "voltage":
            low, high = self._voltages(drive_limits_v)
            start = float(self.voltage_map.voltage_v(self.saturation.start))
        found = ControllerSetting(
            period_s, low, high, start, delay_s, self.actuator, sensed_before_s
        )
        self.controller.kind.check(found)
        return found

    def within(self, low_v: float, high_v: float) -> LoopSettings:
        """Narrow the saturation to the strains whose voltage is within limits.

        The voltage is that of the voltage map; for a controller that puts out a voltage, it is that
        of the physical model, if there is one.

        Args:
            low_v: lowest voltage of the drive, in V.
            high_v: highest one.
        Returns:
            The narrowed settings.
        Raises:
            LimitError: No range of strains is within these limits.
        """
        ends = self.saturation.low, self.saturation.high
        if self.controller.kind.output == "voltage":
            return self._within_reach(low_v, high_v)
        found = self.voltage_map.reach(ends, low_v, high_v)
        if found is None or not found[0] < found[1]:
            volts = self.voltage_map.voltage_v(ends)
            raise LimitError(
                f"By the voltage map, the strains of the controller ({100.0 * ends[0]:.6g} to "
                f"{100.0 * ends[1]:.6g} %) need {volts.min():.4g} to {volts.max():.4g} V, but the "
                f"drive is limited to {low_v:g} to {high_v:g} V. Change the limit of the drive, or "
                "the limits of the controller."
            )
        return replace(self, saturation=Saturation(*found))

    def _within_reach(self, low_v: float, high_v: float) -> LoopSettings:
        """Narrow the saturation to what the actuator reaches by its physical model."""
        known, limits = self.actuator, self.saturation
        if known is None:
            return self
        ends_v = max(known.low_v, low_v), min(known.high_v, high_v)
        low, high = replace(known, low_v=ends_v[0], high_v=ends_v[1]).reachable()
        found = max(limits.low, low), min(limits.high, high)
        if not found[0] < found[1]:
            raise LimitError(
                f"By the physical model, a drive of {ends_v[0]:g} to {ends_v[1]:g} V reaches "
                f"{100.0 * low:.6g} to {100.0 * high:.6g} %, but the limits of the controller are "
                f"{100.0 * limits.low:.6g} to {100.0 * limits.high:.6g} %. Change the limit of the "
                "drive, or the limits of the controller."
            )
        return replace(self, saturation=Saturation(*found))

    def largest_v(self, low_v: float, high_v: float) -> float:
        """Largest drive, in magnitude, that the loop may put out.

        Args:
            low_v: lowest voltage of the drive, in V.
            high_v: highest one.
        Raises:
            LimitError: See `within`.
        """
        limits = self.within(low_v, high_v).saturation
        if self.controller.kind.output == "voltage":  # limited at each step, not by the map
            return max(map(abs, self._voltages((low_v, high_v))))
        strains = np.linspace(limits.low, limits.high, _REACH_POINTS)
        return float(np.abs(self.voltage_map.voltage_v(strains)).max())

    def _voltages(self, drive_limits_v: tuple[float, float]) -> tuple[float, float]:
        """Limits of the rig that are also those of the actuator."""
        (low, high), known = drive_limits_v, self.actuator
        if known is not None:
            low, high = max(low, known.low_v), min(high, known.high_v)
        return low, high


class RunningController:
    """A controller running in a loop, with its drive limited and its failures reported.

    Args:
        chosen: the controller with its parameters.
        setting: of the loop.
        start_limit_s: longest time until it has started, in s; None: there is no limit.
        step_limit_s: longest time of a step, in s; None: there is no limit.
    Raises:
        InputError: The controller does not start, or the setting lacks what its kind needs.
    """

    def __init__(
        self,
        chosen: ChosenController,
        setting: ControllerSetting,
        start_limit_s: float | None = None,
        step_limit_s: float | None = None,
    ) -> None:
        kind = chosen.kind
        kind.check(setting)
        self._name, self._voltage = kind.name, kind.output == "voltage"
        self._low, self._high = setting.drive_low, setting.drive_high
        self._step_limit_s = step_limit_s
        try:
            with CallLimit(start_limit_s), no_exit():
                self._controller = chosen.make()
                self._controller.start(setting)
        except TooLongError as error:
            raise InputError(
                f"Controller {self._name!r} has not started within {start_limit_s:g} s. Shorten "
                "its start, or compute what takes so long when the package is imported."
            ) from error
        except Exception as error:  # code of another package may raise anything
            raise InputError(
                f"Controller {self._name!r} does not start: {described(error)}. "
                "Fix the controller, or change its parameters."
            ) from error

    @property
    def controller(self) -> Controller:
        """The controller itself."""
        return self._controller

    def step(self, reference: float, measurement: Measurement) -> float | None:
        """Compute the next drive.

        Args:
            reference: desired strain.
            measurement: of the block that has just ended.
        Returns:
            The drive, in strain within the saturation or in V within the limits; None: keep the
            output, because the measurement is not valid.
        Raises:
            SafetyError: The controller failed or did not return in time, or it returned something
                other than a finite number or a voltage outside the limits.
        """
        try:
            with CallLimit(self._step_limit_s), no_exit():
                drive: object = self._controller.step(reference, measurement)
                value = float(drive) if is_real(drive) else math.nan
        except TooLongError as error:
            raise SafetyError(
                f"Controller {self._name!r} did not return from its step within "
                f"{self._step_limit_s:g} s (safety.lease_s). Fix it and test it on the twin."
            ) from error
        except (Exception, GeneratorExit) as error:
            raise SafetyError(
                f"Controller {self._name!r} failed: {described(error)}. Fix it and test it on the "
                "twin."
            ) from error
        if not measurement.valid:
            return None
        if not math.isfinite(value):
            raise SafetyError(
                f"Controller {self._name!r} returned {shown(drive)} for a strain of "
                f"{measurement.strain:.6g}, but a step must return one finite number. Fix it and "
                "test it on the twin."
            )
        if self._voltage and not self._low <= value <= self._high:
            raise SafetyError(
                f"Controller {self._name!r} returned {value:.12g} V, outside its limits of "
                f"{self._low:.12g} to {self._high:.12g} V. Limit the voltage in the controller."
            )
        return min(max(value, self._low), self._high)
