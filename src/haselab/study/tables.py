"""Tables of STUDY.toml: the settings of haselab's own experiments."""

from __future__ import annotations

from typing import Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from haselab.store.toml import Section

__all__ = [
    "LEAST_LOADS",
    "Chirp",
    "Control",
    "FreeResponse",
    "OperatingPoint",
    "Sensing",
    "StaticLoad",
    "StepTrials",
    "Steps",
    "Triangle",
]

LEAST_LOADS = 7  # of the static test: the fit needs six besides the lightest, its reference
_DAY_S = 86400.0
_volt = Field(ge=-100, le=100)
_frames = Field(gt=0, le=1e5)


class Sensing(Section):
    """The sensing signal, and the scales of eqs. 2 and 3 (row D11b)."""

    carrier_hz: float = Field(2000.0, gt=0, le=1e6)
    carrier_v: float = Field(0.02, gt=0, le=1)
    reactance_scale: float = Field(2.5e3, gt=0)
    capacitance_scale: float = Field(10.0, gt=0)


class OperatingPoint(Section):
    """Row S18; the hung mass is the rig's."""

    baseline_v: float | None = Field(
        None,
        ge=-100,
        le=100,
        description="drive voltage of zero strain, in V at the DAQ output; default: the one that "
        "centres the strain in the longest linear region",
    )


class Triangle(Section):
    """Rows S13 to S15."""

    low_v: float = _volt
    high_v: float = _volt
    frequency_hz: float = Field(ge=1e-4, le=25)
    cycles: int = Field(ge=2, le=1000)
    left_out_cycles: int = Field(ge=0, le=1000)
    frame_rate_hz: float = _frames

    @model_validator(mode="after")
    def _lasts(self) -> Self:
        if self.cycles / self.frequency_hz > _DAY_S:
            raise ValueError("cycles / frequency_hz must not exceed a day")
        if self.left_out_cycles >= self.cycles:
            raise ValueError(
                f"left_out_cycles = {self.left_out_cycles} must be below cycles = {self.cycles}"
            )
        return self


class StaticLoad(Section):
    """Rows S16 and S17."""

    masses_kg: tuple[float, ...] = Field(max_length=1000)
    settle_s: float = Field(gt=0, le=_DAY_S)
    frame_rate_hz: float = _frames
    pieces: int | None = Field(
        None,
        ge=1,
        le=6,
        description="straight segments of the load curve; default: chosen by BIC",
    )

    @field_validator("masses_kg", mode="after")
    @classmethod
    def _suffice(cls, masses_kg: tuple[float, ...]) -> tuple[float, ...]:
        if (different := len(set(masses_kg))) < LEAST_LOADS:
            raise ValueError(f"has {different} different masses, but needs at least {LEAST_LOADS}")
        return masses_kg


class FreeResponse(Section):
    """Row S19."""

    trials: int = Field(ge=1, le=1000)
    settle_s: float = Field(gt=0, le=_DAY_S)
    record_s: float = Field(gt=0, le=_DAY_S)
    frame_rate_hz: float = _frames


class Chirp(Section):
    """Row S20."""

    amplitude_v: float = Field(gt=0, le=100)
    start_hz: float = Field(gt=0, le=1e4)
    stop_hz: float = Field(gt=0, le=1e4)
    duration_s: float = Field(ge=0.01, le=_DAY_S)
    hold_s: float = Field(gt=0, le=_DAY_S)
    frame_rate_hz: float = _frames


class Steps(Section):
    """Rows S21 to S25."""

    step: float = Field(description="desired strain")
    zero_s: float = Field(gt=1, le=_DAY_S)
    step_s: float = Field(gt=1, le=_DAY_S)
    rest_s: float = Field(ge=0, le=_DAY_S)
    frame_rate_hz: float = _frames
    open_trials: int = Field(ge=1, le=1000)
    pi_trials: int = Field(ge=0, le=1000)
    pid_trials: int = Field(ge=0, le=1000)
    printed_chain_trials: int = Field(
        0, ge=0, le=100, description="with the PI and the paper's sensing chain"
    )
    printed_chain_carrier_v: float = Field(
        0.1, gt=0, le=1, description="of these trials; steps of the output leak into the carrier"
    )
    extra_delay_trials: int = Field(
        0,
        ge=0,
        le=100,
        description="with a PI for outputs delayed by extra_delay_blocks",
    )
    extra_delay_blocks: int = Field(1, ge=1, le=10)
    saturating_trials: int = Field(
        0, ge=0, le=100, description="with the PI, to saturating_step first, then to step"
    )
    saturating_step: float = Field(0.2, ge=-1, le=1, description="desired strain")
    own_trials: int = Field(
        2, ge=1, le=1000, description="with the controller of [control] kind, if there is one"
    )
    feedback: Literal["capacitance", "video"] = Field(
        "capacitance", description="source of the strain for the closed loops"
    )


_LOOP_KEYS = {"kind", "parameters", "saturation_low", "saturation_high"}


class Control(Section):
    """Rows S21, S22, S25; `kind` adds a controller of any registered kind to the paper's.

    With `kind`, the other keys of the table are the parameters of that kind.
    """

    kind: str | None = Field(
        None,
        min_length=1,
        max_length=64,
        description="registered kind of the controller for own_trials",
    )
    parameters: dict[str, float] = Field({}, description="of that controller")
    kp: float = Field(0.85, ge=0, description="printed, for the printed plant gain")
    ki: float = Field(1.5, ge=0)
    plant_gain: float = Field(0.5, gt=0, description="printed static gain, eq. 8")
    saturation_low: float = -0.05
    saturation_high: float = 0.1

    @model_validator(mode="before")
    @classmethod
    def _own_parameters(cls, data: Any) -> Any:
        if not isinstance(data, dict) or data.get("kind") is None or "parameters" in data:
            return data
        parameters = {key: value for key, value in data.items() if key not in _LOOP_KEYS}
        rest = {key: value for key, value in data.items() if key in _LOOP_KEYS}
        return rest | {"parameters": parameters}


class StepTrials(Section):
    """Step trials with a controller that is already designed: row S24, on the chip."""

    step: float = Field(ge=-0.5, le=0.5, description="desired strain, not 0")
    zero_s: float = Field(gt=1, le=3600)
    step_s: float = Field(gt=1, le=3600)
    rest_s: float = Field(ge=0, le=86400)
    frame_rate_hz: float = Field(gt=0, le=1e4)
    trials: int = Field(ge=1, le=1000)

    @model_validator(mode="after")
    def _is_a_step(self) -> Self:
        if self.step == 0.0:
            raise ValueError("step must not be 0")
        return self
