"""Schema of model files: names, types and ranges of keys, checked before any arithmetic.

The ranges are wider than for any actuator. They keep every power and quotient of a model's values
inside double precision.
"""

from __future__ import annotations

from typing import Annotated, Any, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    field_validator,
    model_validator,
)

from haselab.base.numbers_only import numbers_only

__all__ = [
    "CovarianceTable",
    "EstimateTable",
    "LoopTable",
    "NonlinearTable",
    "Number",
    "OriginTable",
    "PlantTable",
    "PolesTable",
    "RationalTable",
    "TrainingOutputTable",
    "VoltagePlantTable",
]

_MOST_MODES, _MOST_FACTORS = 16, 64
_LARGEST, _FASTEST_RAD_S, _LONGEST_S = 1e30, 1e7, 1e7
_FINEST_CELL = 1e-100  # a smaller one is a typing error, and differences over it may overflow


def _value(item: Any) -> Any:
    """The value of an estimate; anything else unchanged."""
    return item["value"] if isinstance(item, dict) and "value" in item else item


Number = Annotated[float, Field(strict=True, ge=-_LARGEST, le=_LARGEST, allow_inf_nan=False)]
_Quantity = Annotated[Number, BeforeValidator(_value)]
_Frequency = Annotated[_Quantity, Field(gt=0, ge=1.0 / _LONGEST_S, le=_FASTEST_RAD_S)]
_Duration = Annotated[_Quantity, Field(gt=0, ge=1.0 / _FASTEST_RAD_S, le=_LONGEST_S)]
_Delay = Annotated[_Quantity, Field(ge=0, le=_LONGEST_S)]
_Damping = Annotated[_Quantity, Field(ge=0, le=1e4)]
_Pair = tuple[Number, Number]
_Factors = Annotated[list[Number], Field(min_length=1, max_length=_MOST_FACTORS)]


def _delay(item: Any) -> Any:
    """Replace a delay estimated below zero, within its error, by zero."""
    value = _value(item)
    return max(0.0, value) if isinstance(item, dict) and isinstance(value, float) else value


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True)

    _numbers = field_validator("*", mode="before")(classmethod(numbers_only))


class _SlowModeTable(_Table):
    gain: _Quantity = Field(description="static gain of the slow branch", examples=[0.7])
    time_constant_s: _Duration = Field(
        description="time constant of the slow branch", examples=[4.8]
    )


class PolesTable(_Table):
    """A model by its gain, poles and zeros, with parallel slow branches."""

    gain: _Quantity = Field(description="static gain, output over input", examples=[0.8])
    delay_s: Annotated[_Delay, BeforeValidator(_delay)] = 0.0
    slow_modes: list[_SlowModeTable] = Field([], max_length=_MOST_MODES)
    poles: list[_Pair] | None = Field(None, max_length=_MOST_FACTORS)
    zeros: list[_Pair] | None = Field(None, max_length=_MOST_FACTORS)


class PlantTable(PolesTable):
    """A resonance with parallel slow branches."""

    natural_frequency_rad_s: _Frequency = Field(
        description="natural frequency of the resonance", examples=[28.0]
    )
    damping_ratio: _Damping = Field(description="damping ratio of the resonance", examples=[0.15])


class LoopTable(_Table):
    """The loop for which a model was measured."""

    rate_hz: float | None = Field(None, strict=True, ge=1e-3, le=1e6)
    loop_delay_s: float | None = Field(None, strict=True, gt=0, le=1e3)


class RationalTable(_Table):
    """Numerator over denominator, falling powers of s."""

    numerator: _Factors
    denominator: _Factors
    delay_s: Annotated[Number, Field(ge=0, le=_LONGEST_S)] = 0.0
    input: str = "u"
    output: str = "y"


class NonlinearTable(_Table):
    """The nonlinear part of a model, with the gain of its linear part; see `NonlinearFit`.

    `gain_2` and `gain_3` are the coefficients of a Hammerstein model about `operating_input`.
    """

    kind: str
    operating_input: Number
    gain: _Quantity
    gain_2: _Quantity | None = None
    gain_3: _Quantity | None = None


class CovarianceTable(_Table):
    """Parameters of a model with their covariance, see `PlantPosterior`; null: not identifiable."""

    names: list[str] = Field(
        min_length=1,
        max_length=_MOST_FACTORS,
        description="parameters, in the order of values and matrix",
        examples=[["gain", "damping_ratio"]],
    )
    logarithmic: list[bool] = Field(
        max_length=_MOST_FACTORS,
        description="for each parameter, whether the matrix is about its logarithm",
        examples=[[False, True]],
    )
    values: list[Number | None] = Field(
        max_length=_MOST_FACTORS, description="value of each parameter", examples=[[0.8, 0.15]]
    )
    matrix: list[Annotated[list[Number | None], Field(max_length=_MOST_FACTORS)]] = Field(
        max_length=_MOST_FACTORS,
        description="covariance of the parameters, row by row",
        examples=[[[1e-4, 0.0], [0.0, 1e-3]]],
    )


class TrainingOutputTable(_Table):
    """`identify.TrainingOutput` of the outputs that a model was fitted to."""

    cell: Annotated[Number, Field(ge=0)]
    quantised: bool = False
    hashes: list[Annotated[int, Field(strict=True, ge=0, lt=1 << 32)]]

    @model_validator(mode="after")
    def _wide_enough(self) -> Self:
        if self.hashes and self.cell < _FINEST_CELL:
            raise ValueError(
                f"cell is {self.cell:g}, but hashes need cells above 0. Restore the value that "
                "was written, or remove training_output"
            )
        return self


class OriginTable(_Table):
    """Signals and records that a model was fitted to; empty where they are not known.

    Units are SI units, "1" for a pure number; `through_voltage_map` has the coefficients of the
    map that converted the recorded voltage.
    """

    input: str = ""
    output: str = ""
    input_unit: str = ""
    output_unit: str = ""
    residual_std: Annotated[Number, Field(ge=0)] | None = None
    training_output: TrainingOutputTable | None = None
    input_range: tuple[Number, Number] | None = None
    through_voltage_map: tuple[Number, Number, Number, Number] | None = None

    @property
    def is_of_strains(self) -> bool:
        """Whether input and output are strains, as after the voltage map."""
        units = self.input_unit, self.output_unit
        unnamed = units == ("", "") and self.output == "strain"  # as a study writes it
        return self.input.endswith("strain") and (unnamed or units == ("1", "1"))


class VoltagePlantTable(_Table):
    """Drive voltage to output, see `VoltagePlant`."""

    creep: str
    gains: Annotated[list[Number], Field(min_length=1, max_length=_MOST_MODES)]
    natural_frequency_rad_s: _Frequency
    damping_ratio: _Damping
    delay_s: _Delay = 0.0
    creep_share: Number = 0.0
    creep_time_constant_s: _Duration = 5.0
    second_mode: tuple[Number, Number, Number] | None = None


class EstimateTable(_Table):
    """An estimate as `--json` writes it; a value that is not identifiable is null."""

    value: Number | None
    std: Number | None
    ci95: tuple[Number | None, Number | None]
    unit: str
