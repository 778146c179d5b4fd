"""The protocol of a controller, which is called once per block."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from haselab.controllers.known_actuator import KnownActuator

__all__ = [
    "ChipController",
    "Controller",
    "ControllerSetting",
    "LinearisableController",
    "Measurement",
    "waiting_drives",
]


@dataclass(frozen=True)
class ControllerSetting:
    """Timing and limits of the loop in which a controller is started, and what is known of it.

    The drives are strains, or voltages of a kind with `output = "voltage"`.

    Args:
        period_s: time between two steps, in s.
        drive_low: lowest drive that the loop puts out.
        drive_high: highest one. The loop limits a strain to this range; a controller with an
            integrator needs it against windup. A voltage outside stops the run.
        drive_start: drive before the first step.
        delay_s: age of a measurement when the output computed from it takes effect, in s, without
            the hold of the output; None: not known.
        actuator: the identified actuator; None: its file has no physical model. A kind with
            `needs_actuator` always gets it.
        sensed_before_s: age of a measurement at the end of its block, in s; None: not known.
        highest_rate_per_s: fastest change of the drive that the loop puts out, per s.
    """

    period_s: float
    drive_low: float
    drive_high: float
    drive_start: float = 0.0
    delay_s: float | None = None
    actuator: KnownActuator | None = None
    sensed_before_s: float | None = None
    highest_rate_per_s: float = math.inf


@dataclass(frozen=True, slots=True)
class Measurement:
    """Measurement at the end of a block.

    Args:
        strain: measured strain; NaN where `valid` is False.
        capacitance_f: from which the strain was computed, in F; NaN with the camera as sensor.
        voltage_v: drive voltage in force during the block, at the amplifier's input, in V.
        time_s: end of the block on the rig's clock, in s.
        valid: whether the strain can be used. While it is False, the output is kept and the
            result of the step is ignored; five such blocks in a row stop the run.
        in_range: whether the strain map was fitted at this capacitance. While it is False, the
            strain is extrapolated and the map's band is not valid.
        preview: desired strains of the coming steps, as many as `preview_s` of the kind covers;
            the first one is that of the next step.
    """

    strain: float
    capacitance_f: float
    voltage_v: float
    time_s: float
    valid: bool = True
    in_range: bool = True
    preview: tuple[float, ...] = ()


def waiting_drives(setting: ControllerSetting) -> int:
    """Drives that a controller has put out and that do not act yet at the end of a block.

    `Measurement.voltage_v` is the drive before these.

    Args:
        setting: of the loop.
    Example:
        >>> waiting_drives(ControllerSetting(0.01, 0.0, 1.0, delay_s=0.016, sensed_before_s=0.004))
        1
    """
    period_s = setting.period_s
    delay_s = 0.5 * period_s if setting.delay_s is None else setting.delay_s
    age_s = 0.5 * period_s if setting.sensed_before_s is None else setting.sensed_before_s
    return max(int((delay_s - age_s) / period_s + 1e-9), 0)


class Controller(Protocol):
    """One controller in one loop.

    The drive is a strain: the static strain of the voltage to put out. The voltage map of the
    loop turns it into a voltage, so a controller that returns the reference is an open loop. If its
    kind has `output = "voltage"`, the drive is that voltage, before the amplifier.
    """

    def start(self, setting: ControllerSetting) -> None:
        """Begin a new experiment.

        Args:
            setting: period and limits of the loop.
        """

    def step(self, reference: float, measurement: Measurement) -> float:
        """Compute the next drive.

        Args:
            reference: desired strain.
            measurement: of the block that has just ended.
        Returns:
            The drive until the next step, in strain or in V.
        """


@runtime_checkable
class ChipController(Protocol):
    """A controller that writes its C step for the microcontroller, configuration included."""

    def c_text(self, setting: ControllerSetting) -> str:
        """C file with the two functions of `core/include/hs_controller.h`.

        Args:
            setting: of the loop on the microcontroller.
        """


@runtime_checkable
class LinearisableController(Protocol):
    """A controller that states a linear feedback, exact or linearised: margins need it."""

    def linear_feedback(self, period_s: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Transfer function in z from the measured strain, sign reversed, to the drive.

        Args:
            period_s: time between two steps, in s.
        Returns:
            Numerator and denominator, falling powers of z, within the limits of the drive.
        """
