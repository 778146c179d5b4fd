"""Base sections of RIG.toml for each kind of instrument, to which drivers add their keys."""

from __future__ import annotations

from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from haselab.rig.cameras.source import ExposureLine
from haselab.store.toml import PrintableSection

__all__ = [
    "CameraConfig",
    "DaqConfig",
    "ExposureConfig",
    "GeneratorConfig",
    "InstrumentConfig",
    "SupplyConfig",
]


class InstrumentConfig(PrintableSection):
    """A section that describes one instrument; its key `kind` chooses the driver."""

    kind: str = Field(description="driver; `haselab doctor` lists those that are installed")


class ExposureConfig(PrintableSection):
    """Section `exposure`: the line on which a camera signals its exposures."""

    input: str = Field(min_length=1, description="terminal of the board", examples=["PFI0"])
    counter: str = Field("ctr1", min_length=1, description="a free counter")
    edge: Literal["rising", "falling"] = Field("rising", description="edge that begins an exposure")
    duration_s: float = Field(
        gt=0,
        le=10,
        description="duration of an exposure; the same as camera.exposure_s",
        examples=[0.001],
    )
    line: str | None = Field(
        None, min_length=1, description="output of an aravis camera for the signal, such as Line2"
    )
    inverted: bool | None = Field(None, description="LineInverter of that output; omit: unchanged")

    @property
    def camera_line(self) -> ExposureLine:
        """Settings for the camera."""
        return ExposureLine(self.duration_s, self.line, self.inverted)


class DaqConfig(InstrumentConfig):
    """Section `daq`: two inputs, and one output synchronised with the blocks."""

    range_v: float = Field(10.0, gt=0, le=10)
    bits: int = Field(16, ge=8, le=16)
    rate_hz: float = Field(200e3, ge=1e3, le=1e6)
    block_samples: int = Field(2000, ge=200, le=65520, multiple_of=40)
    skew_s: float = Field(2.5e-6, ge=0, description="from the voltage to the current sample")
    output_delay_s: float = Field(2e-3, gt=0, description="from a block's end to the new output")
    ahead_blocks: int = Field(1, ge=0, le=10, description="outputs queued in the device")
    drive_low_v: float = Field(0.0, ge=-10)
    drive_high_v: float = Field(2.0, le=10)

    @model_validator(mode="after")
    def _times(self) -> Self:
        if self.output_delay_s * self.rate_hz > 0.5 * self.block_samples:
            raise ValueError("output_delay_s must not exceed half a block")
        if self.output_delay_s * self.rate_hz < 2.0:
            raise ValueError("output_delay_s must be at least two samples, for the counter")
        if not self.drive_low_v <= 0.0 <= self.drive_high_v:
            raise ValueError("drive_low_v must not be above 0 V, and drive_high_v not below 0 V")
        if self.drive_low_v == self.drive_high_v:
            raise ValueError("drive_low_v and drive_high_v must not both be 0 V")
        return self

    def check_exposure(self, line: ExposureConfig) -> None:
        """Refuse an exposure signal that this device cannot record.

        Args:
            line: section `exposure` of the same file.
        Raises:
            ValueError: The device cannot record it; by default no device can.
        """
        raise ValueError(f"a daq of kind {self.kind!r} cannot record the exposure signal {line}")

    @property
    def switch_in_block(self) -> int:
        """Last sample of a block that shows the old output; the output changes after it."""
        return round(self.output_delay_s * self.rate_hz)

    @property
    def volt_per_code(self) -> float:
        """Of the recorded codes."""
        return 2.0 * self.range_v / 2.0**self.bits

    @property
    def top_code(self) -> int:
        """Largest code; the smallest is `-top_code - 1`."""
        return (1 << (self.bits - 1)) - 1


class GeneratorConfig(InstrumentConfig):
    """Section `generator`: the sensing signal."""

    highest_v: float = Field(1.0, gt=0, le=5, description="peak, at the amplifier's input")
    highest_hz: float = Field(80e3, gt=0)


class SupplyConfig(InstrumentConfig):
    """Section `supply`: a high-voltage supply."""

    highest_v: float = Field(gt=0, le=10e3, description="highest output", examples=[3000.0])
    tolerance_v: float = Field(
        50.0, gt=0, description="largest reading of the supply's own meter while it is off"
    )


class CameraConfig(InstrumentConfig):
    """Section `camera`."""

    sets_exposure: ClassVar[bool] = False  # whether the driver sets exposure time and output line

    @property
    def is_timed_by_exposures(self) -> bool:
        """Whether a recorded exposure signal can time its frames."""
        return False
