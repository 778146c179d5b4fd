"""RIG.toml of a real bench: every device with its address, serial number and limits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

from pydantic import Field, SerializeAsAny, model_validator

from haselab.base import Limits
from haselab.rig.cameras.source import ExposureLine
from haselab.rig.instruments.instrument import Instrument, OutputInstrument
from haselab.rig.instruments.registry import ByKind, config_class, instrument_of
from haselab.rig.instruments.sections import (
    CameraConfig,
    DaqConfig,
    ExposureConfig,
    GeneratorConfig,
    InstrumentConfig,
    SupplyConfig,
)
from haselab.rig.protocols import PLANAR_HASEL, RigDescription
from haselab.store.toml import PrintableSection

__all__ = [
    "AmplifierConfig",
    "BenchConfig",
    "BenchOutputs",
    "CameraField",
    "DaqField",
    "GeneratorField",
    "InstrumentOfFile",
    "SpecimenConfig",
    "StandConfig",
    "SupplyField",
]

_EXPOSURE_SHARE = 0.05  # exposures are multiples of the camera's line time

DaqField = Annotated[SerializeAsAny[DaqConfig], ByKind("daq")]
GeneratorField = Annotated[SerializeAsAny[GeneratorConfig], ByKind("generator")]
SupplyField = Annotated[SerializeAsAny[SupplyConfig] | None, ByKind("supply")]
CameraField = Annotated[SerializeAsAny[CameraConfig] | None, ByKind("camera")]


@dataclass(frozen=True)
class InstrumentOfFile:
    """One instrument of a rig file.

    Args:
        section: its section in the file.
        instrument: its driver.
        config: the section.
    """

    section: str
    instrument: Instrument[Any]
    config: InstrumentConfig


@dataclass(frozen=True)
class BenchOutputs:
    """What has to be shut down on a bench: every instrument of it whose driver can be used.

    Args:
        found: the instruments.
    """

    found: tuple[InstrumentOfFile, ...]

    def instruments(self) -> Iterator[InstrumentOfFile]:
        """As `BenchConfig.instruments`."""
        yield from self.found

    @property
    def shared_instruments(self) -> tuple[str, ...]:
        """Addresses of what another rig file could name beside another board."""
        return tuple(
            address
            for each in self.found
            if isinstance(each.instrument, OutputInstrument)
            for address in each.instrument.addresses(each.config)
        )


class AmplifierConfig(PrintableSection):
    """High-voltage amplifier, which has only analogue inputs and outputs."""

    name: str = Field(
        min_length=1,
        description="make and number; calibrations are valid only for this one",
        examples=["TREK 50/12 no. 1"],
    )
    gain: float = Field(5000.0, gt=0)
    volt_per_monitor_volt: float = Field(5000.0, gt=0)
    ampere_per_monitor_volt: float = Field(2e-3, gt=0)


class StandConfig(PrintableSection):
    """Who hangs masses: a person, or a served twin."""

    kind: Literal["operator", "twin"] = "operator"
    address: str | None = Field(None, description="host:port of the twin")
    lock_step: bool = Field(
        False, description="the twin's time advances only when samples are read, so nothing is late"
    )

    @model_validator(mode="after")
    def _address(self) -> Self:
        if (self.kind == "twin") != (self.address is not None):
            raise ValueError("give an address if kind = 'twin', and only then")
        if self.lock_step and self.kind != "twin":
            raise ValueError("lock_step can be set only if kind = 'twin'")
        return self


class SpecimenConfig(PrintableSection):
    """The actuator in the bench, measured with calipers and a balance."""

    kind: str = Field(PLANAR_HASEL, description="of actuator; the shell is that of a planar-hasel")
    shell_width_m: float = Field(gt=0, description="width without load", examples=[0.05])
    shell_thickness_m: float = Field(
        gt=0, description="thickness without load and liquid", examples=[0.0012]
    )
    lateral_stretch: float = Field(1.0, gt=0)
    mass_kg: float = Field(ge=0, le=20, description="hung mass", examples=[0.25])


class BenchConfig(PrintableSection):
    """The whole file."""

    kind: Literal["bench"]
    name: str = "bench"
    daq: DaqField
    amplifier: AmplifierConfig
    generator: GeneratorField
    supply: SupplyField = None
    specimen: SpecimenConfig
    stand: StandConfig = StandConfig()
    camera: CameraField = Field(None, description="omit: no camera")
    exposure: ExposureConfig | None = Field(
        None, description="omit: frames are timed by the computer's clock"
    )
    scale_m_per_px: float = Field(1e-4, gt=0)
    rating: dict[str, object] = Field(
        default_factory=dict,
        description="what amplifier and actuator withstand; empty: not checked",
    )
    safety: dict[str, object] = Field(
        default_factory=dict, description="limits of the safety chain that differ from the defaults"
    )

    @model_validator(mode="before")
    @classmethod
    def _exposure_of_camera(cls, data: Any) -> Any:
        """Use the camera's exposure time for the exposure line unless the file sets one."""
        if not isinstance(data, dict):
            return data
        camera, line = data.get("camera"), data.get("exposure")
        if not isinstance(camera, dict) or not isinstance(line, dict):
            return data
        model = config_class("camera", camera)
        sets_exposure = model is not None and getattr(model, "sets_exposure", False)
        if "duration_s" in line or not sets_exposure:
            return data
        if camera.get("exposure_s") is None:
            raise ValueError(
                "exposure.duration_s is unknown. Set camera.exposure_s, which is also written to "
                "the camera"
            )
        return data | {"exposure": line | {"duration_s": camera["exposure_s"]}}

    @model_validator(mode="after")
    def _exposed(self) -> Self:
        if self.exposure is None:
            return self
        if self.camera is None:
            raise ValueError("there is a section exposure, but no camera")
        if not self.camera.is_timed_by_exposures:
            raise ValueError(
                f"a camera of kind {self.camera.kind!r} cannot have a section exposure"
            )
        self._check_exposure(self.exposure, self.camera)
        self.daq.check_exposure(self.exposure)
        return self

    def _check_exposure(self, line: ExposureConfig, camera: CameraConfig) -> None:
        if not camera.sets_exposure:
            if line.line is not None or line.inverted is not None:
                raise ValueError("exposure.line and inverted need a camera of kind 'aravis'")
            return
        exposure_s = getattr(camera, "exposure_s", None)
        if exposure_s is not None and abs(line.duration_s / exposure_s - 1.0) > _EXPOSURE_SHARE:
            raise ValueError(
                f"exposure.duration_s is {line.duration_s:g} s and camera.exposure_s "
                f"{exposure_s:g} s. Remove exposure.duration_s"
            )
        if line.inverted is not None and line.line is None:
            raise ValueError("exposure.inverted needs exposure.line")

    @property
    def exposure_line(self) -> ExposureLine | None:
        """Settings of the camera's exposure line; None if it is not wired."""
        return None if self.exposure is None else self.exposure.camera_line

    @property
    def shared_instruments(self) -> tuple[str, ...]:
        """See `BenchOutputs`."""
        return BenchOutputs(tuple(self.instruments())).shared_instruments

    def instruments(self) -> Iterator[InstrumentOfFile]:
        """Every instrument of the file: daq, generator, supply, camera.

        Raises:
            DeviceError: A driver cannot be used.
        """
        for section in ("daq", "generator", "supply", "camera"):
            config = getattr(self, section)
            if config is not None:
                yield InstrumentOfFile(section, instrument_of(section, config), config)

    def describe(self) -> RigDescription:
        """Nominal values of this bench."""
        daq, amplifier = self.daq, self.amplifier
        return RigDescription(
            name=self.name,
            rate_hz=daq.rate_hz,
            block_samples=daq.block_samples,
            switch_sample=daq.switch_in_block + daq.ahead_blocks * daq.block_samples,
            skew_s=daq.skew_s,
            volt_per_code=daq.volt_per_code,
            top_code=daq.top_code,
            amplifier_gain=amplifier.gain,
            v_monitor_v_per_v=1.0 / amplifier.volt_per_monitor_volt,
            i_monitor_v_per_a=1.0 / amplifier.ampere_per_monitor_volt,
            drive_limits=Limits("drive voltage", daq.drive_low_v, daq.drive_high_v, "V"),
            shell_area_m2=self.specimen.shell_width_m * self.specimen.shell_thickness_m,
            lateral_stretch=self.specimen.lateral_stretch,
            scale_m_per_px=self.scale_m_per_px,
            mass_kg=self.specimen.mass_kg,
            amplifier=amplifier.name,
            exposure_s=getattr(self.camera, "exposure_s", None) or 0.0,
            actuator_kind=self.specimen.kind,
        )
