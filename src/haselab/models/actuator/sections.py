"""Schema of actuator.toml: names, types and ranges of the keys of each section.

Every section and every key is optional: a file grows step by step. Keys that are
not listed here are kept unchanged.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from haselab.base import InputError
from haselab.base.numbers_only import numbers_only, switches_only
from haselab.models.actuator.model_tables import CovarianceTable, Number
from haselab.models.actuator.strain_map import LARGEST_FEEDTHROUGH, StrainMap
from haselab.models.maps import VoltageMap
from haselab.models.plant import Plant

__all__ = [
    "ActuatorSection",
    "ActuatorTables",
    "ControllerSection",
    "DriveSection",
    "Geometry",
    "Limits",
    "LoopTable",
    "ModelSection",
    "PhysicalCovariance",
    "PhysicalRecords",
    "PhysicalTable",
    "ResidualTable",
    "SensingSection",
    "StrainMapTable",
    "VoltageMapTable",
    "missing",
]

_ROUNDED = 1e-3  # of a correlation, by the rounding of an ill-conditioned fit
_SAME = 1e-9  # largest relative difference by writing and reading a number
_Positive = Annotated[float, Field(strict=True, gt=0, le=1e12, allow_inf_nan=False)]
_Length = Annotated[float, Field(strict=True, gt=0, le=10, allow_inf_nan=False)]
_Share = Annotated[float, Field(strict=True, gt=0, lt=1, allow_inf_nan=False)]
_Margin = Annotated[float, Field(strict=True)]  # infinite without a crossover
# products of two numbers: 1/F^2 squared is large
_Variance = Annotated[float, Field(strict=True, ge=-1e120, le=1e120, allow_inf_nan=False)]


def _ordered(ends: tuple[float, float]) -> tuple[float, float]:
    if not ends[0] <= ends[1]:
        raise ValueError(f"[{ends[0]:g}, {ends[1]:g}] must have the lower end first")
    return ends


_Range = Annotated[tuple[Number, Number], AfterValidator(_ordered)]


def _four_by_four(rows: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
    """A covariance of the four coefficients of a map."""
    lengths = [len(row) for row in rows]
    if lengths != [4] * 4:
        raise PydanticCustomError(
            "square", "must be 4 rows of 4 numbers, not rows of {lengths}",
            {"lengths": str(lengths)},
        )  # fmt: skip
    return rows


def _by_table(values: Any) -> Any:
    """`shell.length_m = [0.06, 0.065]` is a table in TOML."""
    found: dict[str, Any] = {}
    for name, value in values.items() if isinstance(values, dict) else ():
        inner = _by_table(value) if isinstance(value, dict) else {"": value}
        found |= {f"{name}.{key}" if key else name: part for key, part in inner.items()}
    return found if isinstance(values, dict) else values


_Covariance = Annotated[tuple[tuple[_Variance, ...], ...], AfterValidator(_four_by_four)]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True)

    _numbers = field_validator("*", mode="before")(classmethod(numbers_only))

    _ends: ClassVar[tuple[str, ...]] = ()  # keys of a lower and an upper limit

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        ends = {key: getattr(self, key) for key in self._ends}
        if ends and None not in ends.values() and not operator.lt(*ends.values()):
            found = " must be below ".join(f"{key} = {value:g}" for key, value in ends.items())
            raise ValueError(found)
        return self


class Geometry(_Section):
    """Dimensions of the actuator, in m."""

    zero_length_m: _Length | None = None  # between the fiducials at zero strain
    sensor_zero_m: _Length | None = None  # at which a displacement sensor reads 0; none: the above
    width_m: _Length | None = None
    gap_m: _Length | None = None  # thickness of the dielectric


def _by_full_name(values: Any) -> Any:
    """`shell.length_m = 0.06` is a table in TOML, and a list has one value per branch."""
    if isinstance(values, dict):
        found: dict[str, Any] = {}
        for name, value in values.items():
            parts = _by_full_name(value)
            if isinstance(parts, dict):
                dot = "." if isinstance(value, dict) else ""
                found |= {f"{name}{dot}{key}": part for key, part in parts.items()}
            else:
                found[name] = value
        return found
    if isinstance(values, list) and not values:
        raise ValueError("a list is empty; for no branch, state one with a share of 0")
    return {f"[{k}]": part for k, part in enumerate(values)} if isinstance(values, list) else values


class ActuatorSection(_Section):
    """Kind and geometry of the actuator."""

    name: str = ""
    kind: str = "planar-hasel"
    mass_kg: Annotated[Number, Field(ge=0, le=1e4)] | None = None
    geometry: Geometry = Geometry()
    # of the kind's law, by the names of TWIN.toml
    parameters: Annotated[dict[str, Number], BeforeValidator(_by_full_name)] = {}
    # where a parameter lies that was not identified
    distribution: Annotated[dict[str, _Range], BeforeValidator(_by_table)] = {}


class StrainMapTable(_Section):
    """`[sensing.strain_map]`: capacitance in F to strain, see `StrainMap`."""

    slope_per_f: Number = Field(description="strain per capacitance", examples=[1.07e9])
    offset: Number = Field(description="strain at a capacitance of 0 F", examples=[-0.43])
    curvature_per_f2: Number = 0.0
    cubic_per_f3: Number = 0.0
    covariance: _Covariance | None = None
    range_f: _Range | None = None
    limits_f: _Range | None = None
    band: _Range | None = None
    coverage: _Share = 0.95
    held_out_coverage: Annotated[Number, Field(ge=0, le=1)] | None = None
    hysteresis_strain: Annotated[Number, Field(ge=0)] | None = None
    residual_std: Annotated[Number, Field(ge=0)] | None = None
    feedthrough: (
        Annotated[Number, Field(ge=-LARGEST_FEEDTHROUGH, le=LARGEST_FEEDTHROUGH)] | None
    ) = None
    feedthrough_std: Annotated[Number, Field(ge=0)] | None = None

    def map(self) -> StrainMap:
        """The map with these coefficients.

        Raises:
            InputError: a range or a band whose ends are in the wrong order.
        """
        known = {name: value for name, value in self if value is not None}
        return StrainMap(**known)


class SensingSection(_Section):
    """Conversion of monitor readings to capacitance and of capacitance to strain.

    The calibration of the monitors is in the same section; `haselab calibrate` writes and reads
    its keys.
    """

    carrier_hz: Annotated[Number, Field(gt=0, le=1e9)] | None = None
    scale_s: tuple[Number, Number] | None = None  # admittance for equal readings, in S
    strain_map: StrainMapTable | None = None

    @property
    def is_calibrated(self) -> bool:
        """Whether the section contains a calibration."""
        return self.scale_s is not None


class VoltageMapTable(_Section):
    """`[drive.voltage_map]`: strain to drive voltage, see `VoltageMap`."""

    _ends = ("strain_low", "strain_high")

    a1_v: Number = Field(description="factor of the first exponential, eq. 4", examples=[1.8])
    b1: Number = Field(description="exponent of the first, per unit of strain", examples=[0.78])
    a2_v: Number = Field(description="factor of the second exponential", examples=[-0.81])
    b2: Number = Field(description="exponent of the second, per unit of strain", examples=[-18.7])
    strain_low: Number = -0.1
    strain_high: Number = 0.2
    covariance: _Covariance | None = None

    @property
    def coefficients(self) -> tuple[float, float, float, float]:
        """Coefficients of the map: a1_v, b1, a2_v, b2."""
        return self.a1_v, self.b1, self.a2_v, self.b2

    def map(self) -> VoltageMap:
        """The map with these coefficients.

        Raises:
            InputError: an empty range of strains.
        """
        return VoltageMap(self.a1_v, self.b1, self.a2_v, self.b2, self.strain_low, self.strain_high)


class DriveSection(_Section):
    """The amplifier, the limits of the voltage, and the map from strain to voltage."""

    _ends = ("low_v", "high_v")

    low_v: Number | None = None  # of the drive, before the amplifier
    high_v: Number | None = None
    amplifier: str = ""
    gain_v_per_v: _Positive | None = None
    highest_field_v_per_m: _Positive | None = None
    voltage_map: VoltageMapTable | None = None


def _covariance_fault(matrix: NDArray[np.float64]) -> str:
    """Say why a matrix is not a covariance; empty if it may be one.

    The variance of a parameter that is not identifiable may be infinite.
    """
    variances = np.diag(matrix)
    if (variances < 0.0).any():
        return f"has a negative variance ({variances.min():.3g})"
    if (variances == 0.0).any():
        return "has a variance of 0"
    known = np.isfinite(variances)
    finite = matrix[np.ix_(known, known)]
    std = np.sqrt(variances[known])
    correlations = finite / np.outer(std, std)
    if not np.isfinite(correlations).all():
        return "has a covariance that is not finite beside finite variances"
    if (np.abs(correlations - correlations.T) > _ROUNDED).any():
        return "is not symmetric"
    least = float(np.linalg.eigvalsh(correlations).min()) if len(correlations) else 0.0
    return f"has a negative eigenvalue ({least:.3g})" if least < -_ROUNDED * len(std) else ""


class PhysicalCovariance(_Section):
    """`[model.physical.covariance]`."""

    names: tuple[str, ...] = Field(
        description="parameters of rows and columns, in order",
        examples=[["dielectric.permittivity"]],
    )
    matrix: tuple[tuple[float, ...], ...] = Field(
        description="covariance of their values", examples=[[[1e-6]]]
    )
    widening: tuple[_Positive, ...] = ()  # of the standard deviations, by a model error

    @model_validator(mode="after")
    def _square(self) -> Self:
        sizes = [len(row) for row in self.matrix]
        if sizes != [len(self.names)] * len(self.names):
            raise ValueError(f"{len(self.names)} names need as many rows of as many numbers")
        if self.widening and len(self.widening) != len(self.names):
            raise ValueError(f"{len(self.names)} names need as many values of widening")
        matrix = np.array(self.matrix, dtype=np.float64).reshape(len(sizes), len(sizes))
        if fault := _covariance_fault(matrix):
            raise ValueError(
                f"the matrix {fault}, so it is not a covariance. Restore it, or identify the "
                "actuator again"
            )
        return self


class ResidualTable(_Section):
    """`[model.physical.residuals]`: noise of the records of the fit, and what the model left."""

    length_noise_m: Annotated[Number, Field(ge=0)] | None = None
    length_rms_m: Annotated[Number, Field(ge=0)] | None = None
    length_worst_m: Annotated[Number, Field(ge=0)] | None = None  # of the worst experiment
    length_factor: _Positive | None = None  # true over stated standard deviation of the noise
    capacitance_noise_f: Annotated[Number, Field(ge=0)] | None = None
    capacitance_rms_f: Annotated[Number, Field(ge=0)] | None = None
    capacitance_worst_f: Annotated[Number, Field(ge=0)] | None = None
    capacitance_factor: _Positive | None = None
    # of the parameters by the hidden part of a model error, over that by the noise
    hidden_variance: Annotated[Number, Field(ge=0)] | None = None


class PhysicalRecords(_Section):
    """`[model.physical.records]`: what the physical model was fitted to.

    The covariance of the model is the information of these records; with the noise stated here,
    that of a further experiment can be computed and added.
    """

    experiments: tuple[str, ...] = ()
    duration_s: Annotated[Number, Field(ge=0)] = 0.0
    gain_v_per_v: _Positive = Field(description="gain of the amplifier", examples=[5000.0])
    highest_drive_v: Annotated[Number, Field(ge=0)] = 0.0  # before the amplifier
    heaviest_kg: Annotated[Number, Field(ge=0, le=1e4)] = 0.0
    carrier_v: Annotated[Number, Field(ge=0)] = 0.0  # peak at the actuator
    length_std_m: _Positive | None = None  # None: no lengths were seen
    capacitance_std_f: _Positive | None = None
    exposure_s: Annotated[Number, Field(ge=0)] = 0.0
    pixel_m: Annotated[Number, Field(ge=0)] = 0.0
    lengths_m: _Range | None = None  # shortest and longest that was seen; None: not known
    excess_variance: Annotated[Number, Field(ge=1)] = 1.0  # over that with white residuals


class PhysicalTable(_Section):
    """`[model.physical]`: the physical model that `identify actuator` writes."""

    kind: str = Field(description="of the actuator", examples=["planar-hasel"])
    status: str = "ok"
    mass_kg: Annotated[Number, Field(gt=0, le=1e4)] | None = None  # hung mass of the records
    parameters: Annotated[dict[str, Number], BeforeValidator(_by_full_name)] = Field(
        description="values by the names of TWIN.toml", examples=[{"dielectric.permittivity": 3.0}]
    )
    # parameters that were not fitted, at the time of the fit; empty in files of older versions
    measured: Annotated[dict[str, Number], BeforeValidator(_by_full_name)] = {}
    std: Annotated[dict[str, float], BeforeValidator(_by_full_name)] = {}
    not_identifiable: tuple[str, ...] = ()
    # experiments and channels that determine each parameter
    determined_by: Annotated[dict[str, tuple[str, ...]], BeforeValidator(_by_table)] = {}
    covariance: PhysicalCovariance | None = None
    residuals: ResidualTable = ResidualTable()
    records: PhysicalRecords | None = None

    def check_measured(self, present: Mapping[str, float]) -> None:
        """Refuse parameters that were changed after the identification that used them.

        Args:
            present: parameters that were not fitted, by name.
        Raises:
            InputError: One of them differs from its value at the identification.
        """
        for name, value in self.measured.items():
            if not math.isclose(value, present.get(name, value), rel_tol=_SAME):
                raise InputError(
                    f"{name} is {present[name]:g} in [actuator.parameters], but was {value:g} when "
                    "[model.physical] was identified. Restore it, or identify the actuator again."
                )


class ModelSection(_Section):
    """The linear model; its keys are kept unchanged.

    The keys are those of `PlantTable`, `PolesTable` or `RationalTable`, the same as in a
    model.json.
    """

    model_config = ConfigDict(frozen=True, extra="allow")

    rate_hz: Annotated[Number, Field(ge=1e-3, le=1e6)] | None = None
    loop_delay_s: Annotated[Number, Field(gt=0, le=1e3)] | None = None
    residual_std: Annotated[Number, Field(ge=0)] | None = None
    covariance: CovarianceTable | None = None
    physical: PhysicalTable | None = None

    def plant(self) -> Plant:
        """The model as one resonance with slow branches.

        Raises:
            InputError: the section contains another kind of model.
        """
        return Plant.from_dict(self.model_dump())


class Limits(_Section):
    """Range of the controller's output, in the unit of the model's input."""

    _ends = ("low", "high")

    low: Number = Field(description="lowest output, in the unit of the input", examples=[-0.05])
    high: Number = Field(description="highest output, in the unit of the input", examples=[0.1])


class LoopTable(_Section):
    """Rate and delay of the loop that a controller was designed for."""

    rate_hz: Annotated[Number, Field(ge=1e-3, le=1e6)] | None = None
    measurement_delay_s: Annotated[Number, Field(ge=0, le=1e3)] | None = None


class ControllerSection(_Section):
    """A controller: kind, parameters by name and limits, with alternative controllers.

    A name distinguishes two controllers of one kind; without one, the kind is the name.
    """

    kind: str = "pid"
    name: str = ""
    parameters: dict[str, Number] = {}
    limits: Limits | None = None
    loop: LoopTable | None = None
    margins: Annotated[dict[str, _Margin | bool], AfterValidator(switches_only("stable"))] = {}
    demands: Annotated[
        dict[str, Number | bool], AfterValidator(switches_only("keep_crossover"))
    ] = {}
    alternatives: tuple[ControllerSection, ...] = ()

    @property
    def is_known(self) -> bool:
        """Whether the section defines a controller: PI and PID need gains, other kinds may not."""
        return bool(self.parameters) or self.kind not in ("pi", "pid")

    @property
    def all_kinds(self) -> dict[str, ControllerSection]:
        """This controller and the alternatives, by name or kind."""
        known = [one for one in (self, *self.alternatives) if one.is_known]
        return {one.name or one.kind: one for one in reversed(known)}

    def of_kind(self, kind: str) -> ControllerSection:
        """The controller of a kind or name: this one, or one of the alternatives.

        Raises:
            InputError: there is none of this kind.
        """
        if kind in self.all_kinds:
            return self.all_kinds[kind]
        kinds = ", ".join(reversed(self.all_kinds))
        raise InputError(
            f"[controller] has no controller of kind {kind!r}, only {kinds or 'none'}. "
            "Design one with: haselab design ACTUATOR.toml"
        )


class ActuatorTables(_Section):
    """All sections of one actuator.toml."""

    actuator: ActuatorSection = ActuatorSection()
    sensing: SensingSection = SensingSection()
    drive: DriveSection = DriveSection()
    model: ModelSection | None = None
    controller: ControllerSection | None = None

    def strain_map(self) -> StrainMap:
        """The map from capacitance to strain.

        Raises:
            InputError: there is none yet.
        """
        if self.sensing.strain_map is None:
            raise missing("sensing.strain_map", "haselab identify capacitance-map FILE")
        return self.sensing.strain_map.map()

    def voltage_map(self) -> VoltageMap:
        """The map from strain to voltage.

        Raises:
            InputError: there is none yet.
        """
        if self.drive.voltage_map is None:
            raise missing("drive.voltage_map", "haselab identify voltage-map FILE")
        return self.drive.voltage_map.map()

    def plant(self) -> Plant:
        """The plant of `[model]`.

        Raises:
            InputError: there is no model yet, or one of another kind.
        """
        if self.model is None or not self.model.model_extra:
            raise missing("model", "haselab identify transfer FILE")
        return self.model.plant()

    def designed(self, kind: str | None = None) -> ControllerSection:
        """The controller of a kind or name; None: the one of `[controller]` itself.

        Raises:
            InputError: there is none yet.
        """
        if self.controller is None or not self.controller.all_kinds:
            raise missing("controller", "haselab design")
        if kind is None and self.controller.is_known:
            return self.controller
        return self.controller.of_kind(kind or "pid")

    def drive_ends_v(self, gain_v_per_v: float | None = None) -> tuple[float | None, float | None]:
        """Lowest and highest drive: `[drive]` low_v and high_v, and what the highest field allows.

        Args:
            gain_v_per_v: of the amplifier; None: that of `[drive]`.
        Returns:
            Both in V ahead of the amplifier; None: no limit.
        Raises:
            InputError: a highest field, but no gap or no gain to compute the voltage from.
        """
        drive, gap_m = self.drive, self.actuator.geometry.gap_m
        field, gain = drive.highest_field_v_per_m, gain_v_per_v or drive.gain_v_per_v
        if field is None:
            return drive.low_v, drive.high_v
        if gap_m is None or gain is None:
            lacks = "actuator.geometry.gap_m" if gap_m is None else "drive.gain_v_per_v"
            raise InputError(
                f"drive.highest_field_v_per_m is {field:g} V/m, but {lacks} is missing, so the "
                f"highest voltage is not known. Add {lacks}, or replace the field by high_v."
            )
        most_v = field * gap_m / gain
        low_v = -most_v if drive.low_v is None else max(drive.low_v, -most_v)
        return low_v, most_v if drive.high_v is None else min(drive.high_v, most_v)


def missing(section: str, command: str) -> InputError:
    """The error for a section that a command needs and a file lacks."""
    how = f"{command} --actuator A.toml" if "FILE" in command else f"{command} A.toml"
    return InputError(
        f"The actuator file has no [{section}]. Add it by hand, or with this command: {how}."
    )
