"""A closed loop's settings, and any registered controller running in it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from haselab.base import InputError, SafetyError, described, is_real, shown
from haselab.base.exits import no_exit
from haselab.control import Saturation
from haselab.controllers import ChosenController, ControllerSetting, Measurement
from haselab.models.actuator.strain_map import StrainMap
from haselab.models.maps import VoltageMap

__all__ = ["LoopSettings", "RunningController"]


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
    """

    controller: ChosenController
    saturation: Saturation
    voltage_map: VoltageMap
    strain_map: StrainMap
    video_zero_px: float | None = None
    printed_chain: bool = False
    extra_delay_blocks: int = 0
    carrier_v: float | None = None


class RunningController:
    """A controller running in a loop, with its drive limited and its failures reported.

    Args:
        loop: settings with the controller and its saturation.
        period_s: time between two steps, in s.
    Raises:
        InputError: The controller does not start.
    """

    def __init__(self, loop: LoopSettings, period_s: float) -> None:
        self._name, limits = loop.controller.kind.name, loop.saturation
        self._low, self._high = limits.low, limits.high
        try:
            with no_exit():
                self._controller = loop.controller.make()
                self._controller.start(ControllerSetting(period_s, limits.low, limits.high))
        except Exception as error:  # code of another package may raise anything
            raise InputError(
                f"Controller {self._name!r} does not start: {described(error)}. "
                "Fix the controller, or change its parameters."
            ) from error

    def step(self, reference: float, measurement: Measurement) -> float | None:
        """Compute the next drive.

        Args:
            reference: desired strain.
            measurement: of the block that has just ended.
        Returns:
            The drive within the saturation, in strain; None: keep the output, because the
            measurement is not valid.
        Raises:
            SafetyError: The controller failed, or returned something other than a finite number.
        """
        try:
            with no_exit():
                drive: object = self._controller.step(reference, measurement)
        except Exception as error:
            raise SafetyError(
                f"Controller {self._name!r} failed: {described(error)}. Fix it and test it on the "
                "twin."
            ) from error
        if not measurement.valid:
            return None
        if not is_real(drive) or not math.isfinite(drive):
            raise SafetyError(
                f"Controller {self._name!r} returned {shown(drive)} for a strain of "
                f"{measurement.strain:.6g}, but a step must return one finite number. Fix it and "
                "test it on the twin."
            )
        return min(max(float(drive), self._low), self._high)
