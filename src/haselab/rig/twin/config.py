"""TWIN.toml: all physical parameters of the twin."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, Self

from pydantic import Field, model_validator

from haselab.base import InputError
from haselab.rig.protocols import PLANAR_HASEL
from haselab.rig.twin.camera import TwinCameraConfig
from haselab.store.toml import Section, validated

if TYPE_CHECKING:
    from haselab.actuators import ActuatorLaw, PlanarHasel

__all__ = [
    "HIGHEST_GAIN_ERROR",
    "HIGHEST_LOAD_KG",
    "PLANAR_SECTIONS",
    "READINGS",
    "SETTLE_S",
    "AcquisitionConfig",
    "Amplifier",
    "Dielectric",
    "Electrodes",
    "Hysteresis",
    "Load",
    "Mullins",
    "Origin",
    "Shell",
    "TwinConfig",
    "Unmodelled",
    "Viscosity",
    "twin_of_reading",
]

HIGHEST_LOAD_KG = 20.0
HIGHEST_GAIN_ERROR = 0.5  # of the current monitor
SETTLE_S = 120.0  # how long the mass has hung when a study begins
PLANAR_SECTIONS = ("shell", "electrodes", "viscosity", "mullins", "hysteresis", "dielectric")


class Shell(Section):
    """The elastomer shell: Arruda-Boyce, 5 terms, under a fixed lateral stretch."""

    shear_modulus_pa: float = Field(15.6e3, gt=0, lt=1e7)
    locking_stretch: float = Field(3.92, gt=1.5, lt=50)
    length_m: float = Field(0.0624, gt=0.01, lt=0.2, description="between clamps, unstretched")
    width_m: float = Field(0.0498, gt=0.005, lt=0.3, description="unstretched")
    thickness_m: float = Field(1.2e-3, gt=1e-4, lt=1e-2, description="unstretched, without oil")
    lateral_stretch: float = Field(3.0, ge=1, le=5)


class Electrodes(Section):
    """Gel electrodes and their encapsulation, cast on the pre-stretched, unloaded sheet."""

    stiffness_n_per_m: float = Field(150.0, ge=0, lt=1e5)
    stiffening: float = Field(0.1, ge=0, lt=100, description="cubic term over the linear one")


class Viscosity(Section):
    """Prony branches on the elastic force and a linear damper."""

    share: tuple[float, ...] = Field((0.02, 0.02, 0.5), max_length=4)
    relaxation_s: tuple[float, ...] = Field((0.1, 1.0, 3.2), max_length=4)
    damping_n_s_per_m: float = Field(1.85, gt=0, lt=1e4)

    @model_validator(mode="after")
    def _branches(self) -> Self:
        if len(self.share) != len(self.relaxation_s):
            raise ValueError("share and relaxation_s each need one number per branch")
        if any(not 0 <= g < 10 for g in self.share) or any(t <= 1e-3 for t in self.relaxation_s):
            raise ValueError("a branch needs 0 <= share < 10 and relaxation_s > 0.001 s")
        return self


class Mullins(Section):
    """Extra stiffness of a new shell, lost permanently up to the largest stretch reached."""

    share: float = Field(0.06, ge=0, lt=2)
    stretch: float = Field(1.45, gt=1, lt=5, description="where half of it is lost, over free")
    width: float = Field(0.02, gt=0.001, lt=1)


class Hysteresis(Section):
    """Rate-independent hysteresis: a force that follows each reversal of the length."""

    force_n: float = Field(0.0, ge=0, lt=1e3, description="largest force of it, 0: off")
    width: float = Field(0.02, gt=1e-4, lt=1, description="stretch within which it reverses")


class Unmodelled(Section):
    """Effects that no actuator law has; each is off by default. Times count from the start."""

    capacitance_rise: float = Field(
        0.0, gt=-0.5, lt=0.5, description="relative rise of the permittivity as the bench warms up"
    )
    warming_s: float = Field(600.0, gt=0, description="time constant of that")
    stiffness_loss: float = Field(
        0.0, gt=-0.5, lt=0.5, description="share of the elastic force that ageing takes away"
    )
    ageing_s: float = Field(600.0, gt=0, description="time constant of that")
    begins_s: float = Field(0.0, ge=0, description="when both begin, s after the start of the twin")
    resonance_mass_kg: float = Field(
        0.0, ge=0, lt=20, description="mass on a spring at the moving end, 0: off"
    )
    resonance_hz: float = Field(12.0, gt=0.1, lt=200, description="its natural frequency")
    resonance_damping_ratio: float = Field(0.05, gt=0, lt=1)


class Load(Section):
    """Load on the moving end."""

    mass_kg: float = Field(0.25, gt=0, lt=HIGHEST_LOAD_KG)
    added_inertia_kg: float = Field(
        0.0, ge=0, lt=1000, description="inertia without weight: clamp, oil, linkage"
    )


class Dielectric(Section):
    """Dielectric between the electrodes: oil and silicone."""

    oil_volume_m3: float = Field(0.6e-6, ge=0, lt=1e-4)
    permittivity: float = Field(3.0, gt=1, lt=100, description="relative, of the stack")
    capacitance_exponent: float = Field(
        3.33, ge=1, le=4, description="d ln C / d ln length: 2 pure shear, 4 equal biaxial"
    )
    series_ohm: float = Field(5e3, gt=0, lt=1e8)
    leakage_ohm: float = Field(2e10, gt=1e6)
    relaxation_share: float = Field(0.0, ge=0, lt=1, description="Maxwell-Wagner, 0: off")
    relaxation_s: float = Field(5.7, gt=0.01, lt=1e4)
    breakdown_v_per_m: float = Field(40e6, gt=1e5)


class Amplifier(Section):
    """High-voltage amplifier: second order, gain error, limits, two monitors."""

    name: str = Field("twin amplifier", description="a calibration is valid only for this one")
    gain: float = Field(5000.0, gt=0, description="nominal, V/V")
    gain_error: float = Field(0.0, gt=-0.5, lt=0.5)
    bandwidth_hz: float = Field(6000.0, gt=100, lt=1e5)
    damping_ratio: float = Field(0.6, gt=0.01, lt=0.999)
    slew_v_per_s: float = Field(350e6, gt=1e3)
    current_limit_a: float = Field(12e-3, gt=1e-6)
    stray_f: float = Field(
        0.0, ge=0, lt=1e-8, description="cable and fixture, in parallel with the actuator"
    )
    volt_per_monitor_volt: float = Field(5000.0, gt=0)
    ampere_per_monitor_volt: float = Field(2e-3, gt=0)
    v_monitor_gain_error: float = Field(0.0, gt=-0.5, lt=0.5)
    i_monitor_gain_error: float = Field(0.0, gt=-HIGHEST_GAIN_ERROR, lt=HIGHEST_GAIN_ERROR)
    v_monitor_lag_s: float = Field(
        0.0, ge=0, lt=1e-3, description="first order: 1 / (2 pi bandwidth)"
    )
    i_monitor_lag_s: float = Field(
        0.0, ge=0, lt=1e-3, description="the same for the current monitor"
    )
    v_monitor_offset_v: float = Field(0.0, gt=-1, lt=1, description="reading at 0 V of output")
    i_monitor_offset_v: float = Field(0.0, gt=-1, lt=1, description="reading at 0 A of output")


class AcquisitionConfig(Section):
    """Multiplexed converter, and the drive output on the same clock."""

    rate_hz: float = Field(200e3, ge=1e4, le=1e6)
    block_samples: int = Field(2000, ge=200, le=65520, multiple_of=40)
    bits: int = Field(16, ge=8, le=16)
    range_v: float = Field(10.0, gt=0, le=100)
    skew_s: float = Field(2.5e-6, ge=0)
    v_noise_v: float = Field(0.3e-3, ge=0, lt=1)
    i_noise_v: float = Field(0.3e-3, ge=0, lt=1)
    output_delay_s: float = Field(2e-3, ge=0, description="from a block's end to the new output")
    drive_low_v: float = Field(0.0, ge=-10)
    drive_high_v: float = Field(2.0, le=10)

    @property
    def top_code(self) -> int:
        """Largest code; the smallest is `-top_code - 1`."""
        return (1 << (self.bits - 1)) - 1

    @model_validator(mode="after")
    def _times(self) -> Self:
        if self.skew_s > 0.5 / self.rate_hz:
            raise ValueError("skew_s must not exceed half a sample")
        if self.output_delay_s * self.rate_hz > 0.5 * self.block_samples:
            raise ValueError("output_delay_s must not exceed half a block")
        if not self.drive_low_v <= 0.0 <= self.drive_high_v:
            raise ValueError("drive_low_v must not be above 0 V, and drive_high_v not below 0 V")
        if self.drive_low_v == self.drive_high_v:
            raise ValueError("drive_low_v and drive_high_v must not both be 0 V")
        return self


class Origin(Section):
    """The identified actuator whose twin this is."""

    actuator: str = Field(description="its name", examples=["leg-7"])
    file: str = Field(description="actuator file with [model.physical]", examples=["actuator.toml"])
    sha256: str = Field("", description="of this file")
    records_sha256: tuple[str, ...] = Field((), description="recordings of the identification")
    draw: int | None = Field(None, description="seed of drawn parameters; none: the estimates")
    not_identifiable: tuple[str, ...] = Field((), description="parameters not known from records")


class TwinConfig(Section):
    """The whole bench."""

    name: str = "twin"
    kind: str = Field(PLANAR_HASEL, description="of actuator: see docs/extend/add-an-actuator.md")
    actuator: dict[str, float | tuple[float, ...]] = Field(
        {}, description="parameters of another kind than planar-hasel"
    )
    reading: Literal["rad", "hz"] = "hz"
    shell: Shell = Shell()
    electrodes: Electrodes = Electrodes()
    viscosity: Viscosity = Viscosity()
    mullins: Mullins = Mullins()
    hysteresis: Hysteresis = Hysteresis()
    load: Load = Load()
    dielectric: Dielectric = Dielectric()
    amplifier: Amplifier = Amplifier()
    acquisition: AcquisitionConfig = AcquisitionConfig()
    camera: TwinCameraConfig = TwinCameraConfig()
    unmodelled: Unmodelled = Unmodelled()
    origin: Origin | None = None

    @model_validator(mode="after")
    def _one_actuator(self) -> Self:
        if self.kind == PLANAR_HASEL:
            if self.actuator:
                raise ValueError(
                    f"the table actuator has no effect with kind = {PLANAR_HASEL!r}, whose "
                    f"parameters are in {', '.join(PLANAR_SECTIONS)}; set kind, or remove it"
                )
            return self
        for name in PLANAR_SECTIONS:
            section = getattr(self, name)
            if section != type(section)():
                raise ValueError(
                    f"the table {name} describes a {PLANAR_HASEL} and has no effect with kind = "
                    f"{self.kind!r}; remove it, and a reading other than 'hz'"
                )
        if self.reading != "hz":
            raise ValueError(
                f"reading = {self.reading!r} chooses parameters of a {PLANAR_HASEL} and has no "
                f"effect with kind = {self.kind!r}; remove it"
            )
        try:
            _ = self.law
        except InputError as error:
            raise ValueError(str(error).rstrip(".")) from None
        return self

    @property
    def law(self) -> ActuatorLaw:
        """The physics of the actuator, see `haselab.actuators`."""
        if self.kind == PLANAR_HASEL:
            return self.planar_hasel
        from haselab.actuators import actuator_law  # imported here so that guardians load faster

        return actuator_law(self.kind, self.actuator)

    @property
    def planar_hasel(self) -> PlanarHasel:
        """The built-in law with the numbers of the tables."""
        from haselab.actuators import PlanarHasel  # imported here so that guardians load faster

        values: dict[str, Any] = {}
        for about in PlanarHasel.described():
            section, _, name = about.key.partition(".")
            values[about.name] = getattr(getattr(self, section), name)
        return PlanarHasel(**values)

    @property
    def free_length_m(self) -> float:
        """Length of the actuator with neither load nor voltage."""
        return self.law.free_length_m


# Parameters for the two interpretations of the paper's frequency axis (ADR 3).
READINGS: dict[str, dict[str, dict[str, float]]] = {
    "rad": {"load": {"added_inertia_kg": 9.3}, "viscosity": {"damping_n_s_per_m": 7.5}},
    "hz": {"load": {"added_inertia_kg": 0.0}, "viscosity": {"damping_n_s_per_m": 1.85}},
}


def twin_of_reading(reading: str) -> TwinConfig:
    """Default bench for one interpretation of the paper's frequency axis, `rad` or `hz`."""
    return validated(TwinConfig, {"reading": reading, **READINGS[reading]}, "default twin")
