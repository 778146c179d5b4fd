"""The protocols of a bench and of its devices, which every back end implements."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from haselab.base import Limits

__all__ = [
    "PLANAR_HASEL",
    "Acquisition",
    "BuiltInController",
    "Camera",
    "Frames",
    "FunctionGenerator",
    "GaplessAcquisition",
    "Gate",
    "HighVoltageSupply",
    "ImagePart",
    "LoadStand",
    "MonitorCalibration",
    "PartialImage",
    "PreloadsOutputs",
    "ReferenceFixture",
    "Reopens",
    "ReportsOutput",
    "ReportsOutputState",
    "Rig",
    "RigDescription",
    "VoltageSource",
]

PLANAR_HASEL = "planar-hasel"  # the kind of the reference study

# Rows, and spans of their columns; each is the first one and the one after the last.
ImagePart = tuple[tuple[int, int], Sequence[tuple[int, int]]]
_T = TypeVar("_T")


@dataclass(frozen=True)
class MonitorCalibration:
    """What turns the monitors' readings into admittance, as `haselab calibrate` found it.

    Args:
        scale_s: admittance for equal readings, real and imaginary part, in S.
        stray_s: admittance beside the actuator, real and imaginary part, in S.
        offsets_v: readings of both monitors at 0 V and 0 A.
    """

    scale_s: tuple[float, float]
    stray_s: tuple[float, float]
    offsets_v: tuple[float, float]


@dataclass(frozen=True)
class RigDescription:
    """Nominal values of a bench, from data sheets and calipers.

    Args:
        name: of the rig, for the record.
        rate_hz: samples per second and channel.
        block_samples: samples per channel in one block; each block has one new output.
        switch_sample: samples from the start of a block until the output requested before it takes
            effect; more than `block_samples` if outputs are queued.
        skew_s: time from the voltage sample to the current sample.
        volt_per_code: of both channels.
        amplifier_gain: V per V.
        v_monitor_v_per_v: volts of the voltage monitor per volt of output.
        i_monitor_v_per_a: volts of the current monitor per ampere of output.
        drive_limits: limits of the drive output, in V.
        shell_area_m2: cross-section of the unstretched shell, width times thickness.
        lateral_stretch: fixed by the clamps.
        scale_m_per_px: of the camera.
        mass_kg: mass hung on the lower clamp when a study begins.
        amplifier: make and number; a calibration of the monitors is valid only for this one.
        calibration: of the monitors; None: by the nominal gains.
        exposure_s: of one frame; 0 if it is not known.
        actuator_kind: of the actuator, as in its actuator file.
        top_code: largest code of the converter; a code of this magnitude or more is clipped.
    """

    name: str
    rate_hz: float
    block_samples: int
    switch_sample: int
    skew_s: float
    volt_per_code: float
    amplifier_gain: float
    v_monitor_v_per_v: float
    i_monitor_v_per_a: float
    drive_limits: Limits
    shell_area_m2: float
    lateral_stretch: float
    scale_m_per_px: float
    mass_kg: float
    amplifier: str = ""
    calibration: MonitorCalibration | None = None
    exposure_s: float = 0.0
    actuator_kind: str = PLANAR_HASEL
    top_code: int = 2**15 - 1

    @property
    def block_s(self) -> float:
        """Duration of one block, in s."""
        return self.block_samples / self.rate_hz

    @property
    def drive_reach_v(self) -> float:
        """Largest drive of either sign, in V."""
        return max(abs(self.drive_limits.low), abs(self.drive_limits.high))

    @property
    def monitor_v_per_drive_v(self) -> float:
        """Volts of the voltage monitor per volt of drive."""
        return self.v_monitor_v_per_v * self.amplifier_gain

    @property
    def switch_in_block(self) -> int:
        """Last sample of every block that shows the old output; the output changes after it."""
        return self.switch_sample % self.block_samples

    @property
    def queued_blocks(self) -> int:
        """Outputs that are queued in the device and not in force yet."""
        return self.switch_sample // self.block_samples


class Frames:
    """Images with the middle of each exposure on the acquisition's clock.

    Args:
        images: grey levels, shape `(frames, height, width)`.
        time_s: shape `(frames,)`.
    """

    def __init__(self, images: NDArray[np.uint8], time_s: NDArray[np.float64]) -> None:
        self._images = images
        self.time_s = time_s

    @property
    def images(self) -> NDArray[np.uint8]:
        """Grey levels, shape `(frames, height, width)`."""
        return self._images

    def image(self, index: int) -> NDArray[np.uint8]:
        """One image, shape `(height, width)`."""
        return np.asarray(self.images[index])

    def view(self, index: int) -> NDArray[np.uint8] | PartialImage:
        """One image for somebody who may need only some of its rows."""
        return self.image(index)


class PartialImage(Protocol):
    """An image of a simulated camera, of which only the parts that are needed are drawn."""

    def whole(self) -> NDArray[np.uint8]:
        """Draw all of it."""

    def with_parts(self, parts: Sequence[ImagePart]) -> NDArray[np.uint8]:
        """Draw parts of it; the other pixels of the result are undefined."""


class VoltageSource(Protocol):
    """The drive output at the amplifier's input."""

    def write(self, voltage_v: float) -> None:
        """Request an output; it takes effect at `switch_sample` of the next block.

        Raises:
            LimitError: The voltage is outside the drive limits; the output is unchanged.
        """

    def zero(self) -> None:
        """Go to 0 V at once and discard all earlier requests. Never raises.

        No later call may put out a value that was requested before this one.
        """


class Acquisition(Protocol):
    """Both monitors, continuously sampled."""

    def read(self) -> NDArray[np.int16]:
        """Read the next block: ADC codes, shape `(block_samples, 2)`, voltage then current.

        Raises:
            DeviceError: The block did not arrive.
            SafetyError: The bench tripped.
        """

    @property
    def time_s(self) -> float:
        """Time at the end of the last block, in s."""


class FunctionGenerator(Protocol):
    """The sensing signal, which is added to the drive."""

    def sine(self, frequency_hz: float, amplitude_v: float) -> None:
        """Put out a sine of this frequency and peak amplitude; an amplitude of 0 is `off`.

        Raises:
            LimitError: Frequency or amplitude outside the limits, or NaN; the output is unchanged.
        """

    def off(self) -> None:
        """Switch the output off and discard all earlier requests. Never raises."""


class HighVoltageSupply(Protocol):
    """A separate high-voltage supply."""

    def set_voltage(self, voltage_v: float) -> None:
        """Set a voltage, in V.

        Raises:
            LimitError: The voltage is outside the limits of the rig file; the supply is unchanged.
            DeviceError: The supply does not confirm it.
        """

    def read_voltage(self) -> float:
        """Voltage that the supply measures at its output, in V.

        Raises:
            DeviceError: There is no reply, or it is not a number.
        """

    def off(self) -> None:
        """Go to 0 V, switch the output off and discard all earlier requests. Never raises."""


@runtime_checkable
class GaplessAcquisition(Protocol):
    """An acquisition that runs by itself and keeps or skips blocks that are not read."""

    def keep(self, on: bool) -> None:
        """Choose whether every block is kept, so that a lost one raises an error.

        It is on while a camera takes frames, since the blocks time them.

        Raises:
            DeviceError: The instrument does not reply.
        """


@runtime_checkable
class Reopens(Protocol):
    """An acquisition that can be opened again after another program has reset its device."""

    def reopen(self) -> None:
        """Open the device again at 0 V, without any earlier request; its clock begins at 0 s.

        It is only called while the bench is not armed, and must not apply a voltage.

        Raises:
            DeviceError: The device does not reply, or another program uses it.
        """


@runtime_checkable
class PreloadsOutputs(Protocol):
    """A source that queues outputs and puts them out by its own clock."""

    missed_outputs: int  # outputs since opening that came too late and were skipped

    def preload(self, voltages_v: NDArray[np.float64]) -> int:
        """Queue the values of the coming writes, one per block, in the device.

        Any other call on the output discards them.

        Args:
            voltages_v: in V, shape `(B,)`.
        Returns:
            Number of blocks for which they can be queued; 0 if blocks may be skipped.
        Raises:
            LimitError: A value is outside the drive limits; nothing is queued.
        """


@runtime_checkable
class ReportsOutput(Protocol):
    """A source whose output can be measured independently."""

    def read_back(self) -> float:
        """Measure the output now, in V at the amplifier's input.

        Raises:
            DeviceError: The measurement failed.
        """


@runtime_checkable
class ReportsOutputState(Protocol):
    """An instrument that reports whether its output is off."""

    def is_off(self) -> bool:
        """Query now whether the output is off.

        Raises:
            DeviceError: There is no reply.
        """


class BuiltInController(Protocol):
    """A built-in controller: the program requests strains, the rig computes the outputs.

    It has its own protection; `Acquisition.read` raises its trips as `SafetyError`.
    """

    strain_limits: Limits

    def follow(self, strain: float) -> None:
        """Set the desired strain; close the loop if it is open.

        Raises:
            LimitError: The strain is outside `strain_limits`; the desired strain is unchanged.
            DeviceError: The controller refuses.
        """

    def measure_capacitance_f(self) -> float:
        """Arm, and measure the capacitance with the sensing signal alone.

        The loop stays open and the drive at 0 V.

        Returns:
            The capacitance, in F.
        Raises:
            DeviceError: The controller refuses, or has closed its loop.
        """

    @property
    def output_v(self) -> float:
        """Drive at the end of the last block, in V."""


class Camera(Protocol):
    """Frames on the acquisition's clock."""

    def start(self, rate_hz: float) -> None:
        """Start taking frames."""

    def take(self) -> Frames | None:
        """Return the frames that have arrived since the last call, or `None`."""

    def stop(self) -> None:
        """Stop taking frames."""


class LoadStand(Protocol):
    """Changes the mass on the lower clamp; on a real bench a person does."""

    def hang(self, mass_kg: float) -> None:
        """Hang this mass smoothly."""

    def lift(self) -> None:
        """Lift the mass off the actuator by hand."""

    def drop(self) -> None:
        """Release the mass at once."""

    def wait(self, duration_s: float) -> None:
        """Let time pass with the present output."""


class ReferenceFixture(Protocol):
    """Connects reference capacitors in place of the actuator; on a real bench a person does."""

    def connect(self, capacitance_f: float | None, series_ohm: float = 0.0) -> None:
        """Connect this capacitor in place of the actuator; `None` reconnects the actuator.

        Cable and fixture stay connected, in parallel with it.

        Args:
            capacitance_f: of the reference, in F.
            series_ohm: series resistance of the reference, in ohm.
        Raises:
            LimitError: The reference is outside the limits, or the output is not at 0 V with the
                carrier off.
        """


class Gate(Protocol):
    """Checks the permission of every driver call; implemented in `haselab.safety.gate`.

    A bench is opened with a gate. All code gets the wrapped drivers that `instrument` returns, so
    no call energises anything without a valid permission.
    """

    def claim(self, key: str, call_s: float, shared: Collection[str] = ()) -> bool:
        """Take this output device and these shared instruments for this program alone.

        Returns:
            Whether the last program that used it crashed.
        Raises:
            DeviceError: Another program uses it.
        """

    def release(self) -> None:
        """Release the device for other programs."""

    def instrument(self, driver: _T) -> _T:
        """Wrap a driver."""


@dataclass
class Rig:
    """A whole bench.

    Args:
        description: nominal values.
        source: drive output.
        acquisition: monitors.
        generator: sensing signal.
        camera: frames.
        stand: load.
        fixture: for reference capacitors; None if a person connects them.
        supply: separate high-voltage supply; None if the amplifier has its own.
        controller: built-in controller; None if the program closes the loop.
        gate: wraps the drivers above; None: `safety.guard` adds one.
        simulated: whether it is physics or a recording in this process, which cannot put out a
            voltage. Only such a bench may run without being armed by its user.
    """

    description: RigDescription
    source: VoltageSource
    acquisition: Acquisition
    generator: FunctionGenerator
    camera: Camera
    stand: LoadStand
    fixture: ReferenceFixture | None = None
    supply: HighVoltageSupply | None = None
    controller: BuiltInController | None = None
    gate: Gate | None = None
    simulated: bool = False

    def safe(self) -> None:
        """Go to 0 V, switch supply and sensing signal off. Every run ends here. Never raises."""
        self.source.zero()
        if self.supply is not None:
            self.supply.off()
        self.generator.off()
        self.camera.stop()
