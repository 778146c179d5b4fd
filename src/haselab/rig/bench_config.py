"""RIG.toml of a real bench: every device with its address, its serial number and its limits."""

from __future__ import annotations

import os
from typing import Any, Literal, Self

from pydantic import Field, model_validator

from haselab.base import Limits
from haselab.rig import RigDescription
from haselab.rig.cameras.config import AravisConfig, CameraConfig, TwinCameraConfig
from haselab.rig.cameras.source import ExposureLine
from haselab.store.toml import PrintableSection as _Section

__all__ = [
    "AmplifierConfig",
    "BenchConfig",
    "DaqConfig",
    "ExposureConfig",
    "GeneratorConfig",
    "SpecimenConfig",
    "StandConfig",
    "SupplyConfig",
]

_EXPOSURE_SHARE = 0.05  # exposures come in steps of the camera's line time


class DaqConfig(_Section):
    """NI-DAQmx: two inputs, one output, and a counter that ties the output to the blocks."""

    device: str = Field("Dev1", min_length=1, description="as NI MAX or `nilsdev` names it")
    server: str | None = Field(None, description="host:port of an NI gRPC device server")
    serial_number: str | None = Field(None, description="hexadecimal, as printed on the device")
    v_monitor: str = "ai0"
    i_monitor: str = "ai1"
    output: str = "ao0"
    counter: str = "ctr0"
    wiring: Literal["RSE", "NRSE", "DIFF"] = "DIFF"
    range_v: float = Field(10.0, gt=0, le=10)
    bits: int = Field(16, ge=8, le=16)
    rate_hz: float = Field(200e3, ge=1e3, le=1e6)
    block_samples: int = Field(2000, ge=200, le=65520, multiple_of=40)
    skew_s: float = Field(2.5e-6, ge=0, description="from the voltage to the current sample")
    output_delay_s: float = Field(2e-3, gt=0, description="from a block's end to the new output")
    ahead_blocks: int = Field(1, ge=0, le=10, description="outputs that wait in the device")
    buffer_s: float = Field(10.0, ge=0.5, le=60)
    timeout_s: float = Field(1.0, gt=0, le=30, description="beyond the time a block takes")
    server_patience_s: float = Field(
        2.0, gt=0, le=30, description="for a server's answer, beyond what the call itself takes"
    )
    drive_low_v: float = Field(0.0, ge=-10)
    drive_high_v: float = Field(2.0, le=10)

    @model_validator(mode="after")
    def _times(self) -> Self:
        if self.output_delay_s * self.rate_hz > 0.5 * self.block_samples:
            raise ValueError("output_delay_s must not exceed half a block")
        if self.output_delay_s * self.rate_hz < 2.0:
            raise ValueError("output_delay_s must be two samples at least, for the counter")
        if not self.drive_low_v <= 0.0 <= self.drive_high_v:
            raise ValueError("drive_low_v and drive_high_v must hold 0 V between them")
        if self.drive_low_v == self.drive_high_v:
            raise ValueError("drive_low_v and drive_high_v leave no voltage to drive with")
        return self

    @property
    def switch_in_block(self) -> int:
        """Sample of a block at which the output changes."""
        return round(self.output_delay_s * self.rate_hz)

    @property
    def volt_per_code(self) -> float:
        """Of the recorded codes."""
        return 2.0 * self.range_v / 2.0**self.bits


class ExposureConfig(_Section):
    """The line on which a camera says that it exposes."""

    input: str = Field(min_length=1, description="terminal of the board, as PFI0")
    counter: str = Field("ctr1", min_length=1, description="one that is free")
    edge: Literal["rising", "falling"] = Field("rising", description="with which it begins")
    duration_s: float = Field(
        gt=0, le=10, description="of one: its middle is the frame's time; as camera.exposure_s"
    )
    line: str | None = Field(
        None, min_length=1, description="output of an aravis camera to put the signal on, as Line2"
    )
    inverted: bool | None = Field(None, description="LineInverter of that output; left out: as is")


class AmplifierConfig(_Section):
    """High-voltage amplifier: analogue in, analogue out, nothing to ask it."""

    name: str = Field(min_length=1, description="make and number; calibrations hold for it alone")
    gain: float = Field(5000.0, gt=0)
    volt_per_monitor_volt: float = Field(5000.0, gt=0)
    ampere_per_monitor_volt: float = Field(2e-3, gt=0)


class GeneratorConfig(_Section):
    """Keysight 33500B over VISA."""

    address: str = Field(min_length=1, description="VISA: TCPIP::host::5025::SOCKET, ...::INSTR")
    serial_number: str | None = Field(None, description="third field of *IDN?")
    channel: Literal[1, 2] = 1
    load: Literal["INF", "50"] = "INF"
    volt_per_volt: float = Field(1.0, gt=0, description="at the amplifier's input per volt set")
    highest_v: float = Field(1.0, gt=0, le=5, description="peak, at the amplifier's input")
    highest_hz: float = Field(80e3, gt=0)
    timeout_s: float = Field(1.0, gt=0, le=30)


class SupplyConfig(_Section):
    """High-voltage supply of the Peta-Pico-Voltron family on a serial port."""

    port: str = Field(min_length=1, description="/dev/ttyACM0, COM3, ...")
    serial_number: str | None = Field(None, description="what QName answers")
    highest_v: float = Field(gt=0, le=10e3)
    tolerance_v: float = Field(50.0, gt=0, description="of the supply's own meter")
    timeout_s: float = Field(1.0, gt=0, le=30)


class StandConfig(_Section):
    """Who hangs weights: a person, or the twin behind the wire."""

    kind: Literal["operator", "twin"] = "operator"
    address: str | None = Field(None, description="host:port of the twin")
    lock_step: bool = Field(
        False, description="the twin's time passes only as readings are requested: nobody is late"
    )

    @model_validator(mode="after")
    def _address(self) -> Self:
        if (self.kind == "twin") != (self.address is not None):
            raise ValueError("an address belongs to kind = 'twin', and to it alone")
        if self.lock_step and self.kind != "twin":
            raise ValueError("lock_step belongs to kind = 'twin', and to it alone")
        return self


class SpecimenConfig(_Section):
    """What hangs in the bench, by calipers and balance."""

    shell_width_m: float = Field(gt=0)
    shell_thickness_m: float = Field(gt=0)
    lateral_stretch: float = Field(1.0, gt=0)
    mass_kg: float = Field(ge=0, le=20)


class BenchConfig(_Section):
    """The whole file."""

    kind: Literal["bench"]
    name: str = "bench"
    daq: DaqConfig
    amplifier: AmplifierConfig
    generator: GeneratorConfig
    supply: SupplyConfig | None = None
    specimen: SpecimenConfig
    stand: StandConfig = StandConfig()
    camera: CameraConfig | None = Field(None, description="left out: no camera")
    exposure: ExposureConfig | None = Field(None, description="left out: the computer's clock")
    scale_m_per_px: float = Field(1e-4, gt=0)
    rating: dict[str, object] = Field(
        default_factory=dict,
        description="limits that amplifier and actuator withstand; empty: not checked",
    )
    safety: dict[str, object] = Field(
        default_factory=dict, description="limits of the safety chain that are not the usual ones"
    )

    @model_validator(mode="before")
    @classmethod
    def _exposure_of_camera(cls, data: Any) -> Any:
        """The camera's exposure time is the line's, unless the file says otherwise."""
        if not isinstance(data, dict):
            return data
        camera, line = data.get("camera"), data.get("exposure")
        if not isinstance(camera, dict) or not isinstance(line, dict):
            return data
        if "duration_s" in line or camera.get("kind") != "aravis":
            return data
        if camera.get("exposure_s") is None:
            raise ValueError(
                "exposure.duration_s is not known: give camera.exposure_s, to which the camera is "
                "then set"
            )
        return data | {"exposure": line | {"duration_s": camera["exposure_s"]}}

    @model_validator(mode="after")
    def _exposed(self) -> Self:
        if self.exposure is not None and self.camera is None:
            raise ValueError("section exposure belongs to a camera, and there is none")
        if self.exposure is not None and self.camera is not None:
            timed = isinstance(self.camera, TwinCameraConfig) and self.camera.timed
            if self.camera.kind not in ("aravis", "v4l2") and not timed:
                raise ValueError(f"a camera of kind {self.camera.kind!r} needs no section exposure")
            self._check_exposure(self.exposure)
            if self.exposure.counter == self.daq.counter:
                raise ValueError(f"exposure.counter: {self.daq.counter} clocks the output")
        return self

    def _check_exposure(self, line: ExposureConfig) -> None:
        camera = self.camera
        if not isinstance(camera, AravisConfig):
            if line.line is not None or line.inverted is not None:
                raise ValueError("exposure.line and inverted need a camera of kind 'aravis'")
            return
        exposure_s = camera.exposure_s
        if exposure_s is not None and abs(line.duration_s / exposure_s - 1.0) > _EXPOSURE_SHARE:
            raise ValueError(
                f"exposure.duration_s is {line.duration_s:g} s and camera.exposure_s "
                f"{exposure_s:g} s: leave exposure.duration_s out"
            )
        if line.inverted is not None and line.line is None:
            raise ValueError("exposure.inverted needs exposure.line")

    @property
    def exposure_line(self) -> ExposureLine | None:
        """Settings of the camera's exposure line; None: it is not wired."""
        line = self.exposure
        return None if line is None else ExposureLine(line.duration_s, line.line, line.inverted)

    @property
    def shared_instruments(self) -> tuple[str, ...]:
        """Addresses of what another rig file could name beside another board."""
        supply = () if self.supply is None else (os.path.realpath(self.supply.port),)
        return (self.generator.address, *supply)

    def describe(self) -> RigDescription:
        """What a user of this bench knows about it."""
        daq, amplifier = self.daq, self.amplifier
        return RigDescription(
            name=self.name,
            rate_hz=daq.rate_hz,
            block_samples=daq.block_samples,
            switch_sample=daq.switch_in_block + daq.ahead_blocks * daq.block_samples,
            skew_s=daq.skew_s,
            volt_per_code=daq.volt_per_code,
            amplifier_gain=amplifier.gain,
            v_monitor_v_per_v=1.0 / amplifier.volt_per_monitor_volt,
            i_monitor_v_per_a=1.0 / amplifier.ampere_per_monitor_volt,
            drive_limits=Limits("drive voltage", daq.drive_low_v, daq.drive_high_v, "V"),
            shell_area_m2=self.specimen.shell_width_m * self.specimen.shell_thickness_m,
            lateral_stretch=self.specimen.lateral_stretch,
            scale_m_per_px=self.scale_m_per_px,
            mass_kg=self.specimen.mass_kg,
            amplifier=amplifier.name,
        )
