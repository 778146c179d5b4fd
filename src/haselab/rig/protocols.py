"""The protocols of a bench and of its devices, which every back end implements."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from haselab.base import Limits

__all__ = [
    "Acquisition",
    "Camera",
    "ClosesLoop",
    "Frames",
    "FunctionGenerator",
    "GaplessAcquisition",
    "Gate",
    "HighVoltageSupply",
    "LoadStand",
    "MonitorCalibration",
    "PreloadsOutputs",
    "ReferenceFixture",
    "ReportsOutput",
    "ReportsOutputState",
    "Rig",
    "RigDescription",
    "VoltageSource",
]


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
    """What a user of the bench knows about it: nominal values from data sheets and calipers.

    Args:
        name: of the rig, for the record.
        rate_hz: samples per second and channel.
        block_samples: samples per channel in one block; one new output a block.
        switch_sample: samples from the start of a block to the moment at which the output asked for
            before it takes effect; more than `block_samples` where outputs are queued ahead.
        skew_s: time from the voltage sample to the current sample.
        volt_per_code: of both channels.
        amplifier_gain: V per V.
        v_monitor_v_per_v: volts of the voltage monitor per volt of output.
        i_monitor_v_per_a: volts of the current monitor per ampere of output.
        drive_limits: what the drive output may be asked for, in V.
        shell_area_m2: cross-section of the unstretched shell, width times thickness.
        lateral_stretch: fixed by the clamps.
        scale_m_per_px: of the camera.
        mass_kg: the weight that hangs on the lower clamp when a study begins.
        amplifier: its make and number: a calibration of the monitors holds for this one alone.
        calibration: of the monitors; None: by the nominal gains.
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
        """Sample of every block at which an output changes, whichever block asked for it."""
        return self.switch_sample % self.block_samples


@dataclass(frozen=True)
class Frames:
    """Pictures with the middle of each exposure on the acquisition's clock.

    Args:
        images: grey levels, shape `(frames, height, width)`.
        time_s: shape `(frames,)`.
    """

    images: NDArray[np.uint8]
    time_s: NDArray[np.float64]


class VoltageSource(Protocol):
    """The drive output ahead of the amplifier."""

    def write(self, voltage_v: float) -> None:
        """Ask for an output; it takes effect at `switch_sample` of the next block.

        Raises:
            LimitError: outside the drive limits; the output stays as it was.
        """

    def zero(self) -> None:
        """Go to 0 V now, whatever else is going on, and forget every earlier request. Never raises.

        No later call may put out a value that was requested before this one.
        """


class Acquisition(Protocol):
    """Both monitors, continuously sampled."""

    def read(self) -> NDArray[np.int16]:
        """The next block: ADC codes, shape `(block_samples, 2)`, voltage then current.

        Raises:
            DeviceError: the block did not arrive.
            SafetyError: the bench protected itself.
        """

    @property
    def time_s(self) -> float:
        """Clock at the end of the last block."""


class FunctionGenerator(Protocol):
    """The sensing signal, summed to the drive."""

    def sine(self, frequency_hz: float, amplitude_v: float) -> None:
        """Put out a sine of this frequency and peak amplitude."""

    def off(self) -> None:
        """Put out nothing and forget every earlier request. Never raises."""


class HighVoltageSupply(Protocol):
    """A supply with a rail of its own."""

    def set_voltage(self, voltage_v: float) -> None:
        """Ask for a voltage, in V.

        Raises:
            LimitError: outside what the rig file allows; the supply stays as it was.
            DeviceError: the supply does not confirm it.
        """

    def read_voltage(self) -> float:
        """What the supply measures at its output, in V.

        Raises:
            DeviceError: no answer, or none that is a number.
        """

    def off(self) -> None:
        """0 V, output switched off, every earlier request forgotten. Never raises."""


@runtime_checkable
class GaplessAcquisition(Protocol):
    """An acquisition that goes on by itself: blocks that nobody reads are passed over, or kept."""

    def keep(self, on: bool) -> None:
        """From now on no block may be lost: one that comes too late raises; or no longer so.

        While a camera takes frames it is on, since they are timed by the blocks.

        Raises:
            DeviceError: the instrument does not answer.
        """


@runtime_checkable
class PreloadsOutputs(Protocol):
    """A source that puts outputs out by its own clock, and accepts them early."""

    missed_outputs: int  # since the bench was opened: came too late, and were left out

    def preload(self, voltages_v: NDArray[np.float64]) -> int:
        """The values of the coming writes, one a block: they wait in the device for their time.

        Anything else that is done to the output forgets them.

        Args:
            voltages_v: in V, shape `(B,)`.
        Returns:
            How many blocks ahead they will wait; 0 where blocks may be passed over.
        Raises:
            LimitError: outside the drive limits; nothing is preloaded.
        """


@runtime_checkable
class ReportsOutput(Protocol):
    """A source whose output can be measured by another way than the one that set it."""

    def read_back(self) -> float:
        """The output now, in V ahead of the amplifier, as a meter sees it.

        Raises:
            DeviceError: no measurement.
        """


@runtime_checkable
class ReportsOutputState(Protocol):
    """An instrument that says whether its output is off."""

    def is_off(self) -> bool:
        """The instrument's own word, asked for now.

        Raises:
            DeviceError: no answer.
        """


class ClosesLoop(Protocol):
    """A controller of the rig's own: the program asks for strains, the rig finds the outputs.

    It watches over itself; its trips come as `SafetyError` from `Acquisition.read`.
    """

    strain_limits: Limits

    def follow(self, strain: float) -> None:
        """The desired strain from now on; closes the loop where it is open.

        Raises:
            LimitError: outside `strain_limits`; the desired strain stays as it was.
            DeviceError: the controller refuses.
        """

    @property
    def output_v(self) -> float:
        """The drive at the end of the last block, in V."""


class Camera(Protocol):
    """Frames on the acquisition's clock."""

    def start(self, rate_hz: float) -> None:
        """Take frames from now on."""

    def take(self) -> Frames | None:
        """The frames that have come in since the last call, `None` if there are none."""

    def stop(self) -> None:
        """Take no more frames."""


class LoadStand(Protocol):
    """What hangs on the lower clamp: a person on a real bench."""

    def hang(self, mass_kg: float) -> None:
        """Hang this mass, smoothly, and let it hang."""

    def lift(self) -> None:
        """Take the weight off the actuator by hand."""

    def drop(self) -> None:
        """Let go, at once."""

    def wait(self, duration_s: float) -> None:
        """Let time pass at 0 V drive or at the output that stands."""


class ReferenceFixture(Protocol):
    """Where reference capacitors take the actuator's place: a person on a real bench."""

    def connect(self, capacitance_f: float | None, series_ohm: float = 0.0) -> None:
        """Put this capacitor where the actuator is, `None` puts the actuator back.

        Cable and fixture stay connected, in parallel with it.

        Args:
            capacitance_f: of the reference, in F.
            series_ohm: of the reference, in ohm: its loss, or a resistor in series.
        Raises:
            LimitError: no such reference, or the output is not at 0 V with the carrier off.
        """


class Gate(Protocol):
    """What stands in front of every driver; `haselab.safety.gate` has the one implementation.

    A bench is opened with one. Whoever needs an instrument gets what `instrument` returns, so that
    no call reaches a driver without a valid permission.
    """

    def claim(self, key: str, call_s: float, shared: Collection[str] = ()) -> bool:
        """Be the only program that uses this output device, and these shared instruments.

        Returns:
            Whether the last program that used it has vanished.
        Raises:
            DeviceError: another program uses it.
        """

    def release(self) -> None:
        """Leave the device to other programs."""

    def instrument(self, driver: _T) -> _T:
        """The driver behind the gate."""


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
        fixture: for reference capacitors; None where a person has to be asked.
        supply: high-voltage rail; None where the amplifier has its own.
        controller: closes the loop; None where the program does.
        gate: in front of the drivers above; None: `safety.guard` puts one there.
        simulated: physics or a recording in this process, which can put out no voltage. Only such
            a bench may be run without being armed by its user.
    """

    description: RigDescription
    source: VoltageSource
    acquisition: Acquisition
    generator: FunctionGenerator
    camera: Camera
    stand: LoadStand
    fixture: ReferenceFixture | None = None
    supply: HighVoltageSupply | None = None
    controller: ClosesLoop | None = None
    gate: Gate | None = None
    simulated: bool = False

    def safe(self) -> None:
        """0 V, supply off, no sensing signal: every exit path of a run ends here. Never raises."""
        self.source.zero()
        if self.supply is not None:
            self.supply.off()
        self.generator.off()
        self.camera.stop()
