"""Tables of STUDY.toml: the settings of haselab's own experiments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, field_validator, model_validator

from haselab.store.toml import Section

__all__ = [
    "LEAST_LOADS",
    "Chirp",
    "Control",
    "FreeResponse",
    "ModelControl",
    "OperatingPoint",
    "Sensing",
    "StaticLoad",
    "StepTimes",
    "StepTrials",
    "Steps",
    "Triangle",
]

LEAST_LOADS = 7  # of the static test: the fit needs six besides the lightest, its reference
_DAY_S = 86400.0


def _frames(examples: float) -> Any:
    return Field(gt=0, le=1e5, description="frames per second of the camera", examples=[examples])


class Sensing(Section):
    """The sensing signal, and the scales of eqs. 2 and 3 (row D11b)."""

    carrier_hz: float = Field(2000.0, gt=0, le=1e6, description="frequency of the carrier")
    carrier_v: float = Field(
        0.02, gt=0, le=1, description="amplitude of the carrier at the amplifier's input"
    )
    reactance_scale: float = Field(
        2.5e3, gt=0, description="factor of eq. 2, for relative capacitances"
    )
    capacitance_scale: float = Field(
        10.0, gt=0, description="factor of eq. 3, for relative capacitances"
    )


class OperatingPoint(Section):
    """Baseline voltage; the hung mass is the rig's (row S18)."""

    baseline_v: float | None = Field(
        None,
        ge=-100,
        le=100,
        description="drive of zero strain; if left out, the voltage at which the stretch is in the "
        "middle of the longest linear region of the load curve, or else the middle of the triangle",
    )


class Triangle(Section):
    """Slow triangles of voltage (rows S13 to S15)."""

    former_names: ClassVar[Mapping[str, str]] = {"left_out_cycles": "skipped_cycles"}

    low_v: float = Field(ge=-100, le=100, description="lowest drive", examples=[0.0])
    high_v: float = Field(ge=-100, le=100, description="highest drive", examples=[2.0])
    frequency_hz: float = Field(ge=1e-4, le=25, description="triangles per second", examples=[0.25])
    cycles: int = Field(ge=2, le=1000, description="number of triangles", examples=[5])
    skipped_cycles: int = Field(
        ge=0,
        le=1000,
        description="triangles at the start that the fits of the maps leave out",
        examples=[1],
    )
    frame_rate_hz: float = _frames(100.0)

    @model_validator(mode="after")
    def _lasts(self) -> Self:
        if self.cycles / self.frequency_hz > _DAY_S:
            raise ValueError("cycles / frequency_hz must not exceed a day")
        if not self.low_v < self.high_v:
            raise ValueError(f"low_v = {self.low_v:g} must be below high_v = {self.high_v:g}")
        if self.skipped_cycles >= self.cycles:
            raise ValueError(
                f"skipped_cycles = {self.skipped_cycles} must be below cycles = {self.cycles}"
            )
        return self


class StaticLoad(Section):
    """Masses hung at 0 V (rows S16 and S17)."""

    former_names: ClassVar[Mapping[str, str]] = {"pieces": "segments"}

    masses_kg: tuple[float, ...] = Field(
        max_length=1000,
        description="masses in the order in which they are hung, at least "
        f"{LEAST_LOADS} different ones",
        examples=[[0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6]],
    )
    settle_s: float = Field(
        gt=0, le=_DAY_S, description="wait after each mass, before its frames", examples=[60.0]
    )
    frame_rate_hz: float = _frames(100.0)
    segments: int | None = Field(
        None,
        ge=1,
        le=6,
        description="straight segments of the load curve; if left out, chosen by BIC",
    )

    @field_validator("masses_kg", mode="after")
    @classmethod
    def _suffice(cls, masses_kg: tuple[float, ...]) -> tuple[float, ...]:
        if (different := len(set(masses_kg))) < LEAST_LOADS:
            raise ValueError(f"has {different} different masses, but needs at least {LEAST_LOADS}")
        return masses_kg


class FreeResponse(Section):
    """The mass lifted and dropped at the baseline voltage (row S19)."""

    trials: int = Field(ge=1, le=1000, description="number of drops", examples=[2])
    settle_s: float = Field(
        gt=0, le=_DAY_S, description="time for which the mass is held up", examples=[40.0]
    )
    record_s: float = Field(
        gt=0, le=_DAY_S, description="recorded time after the drop", examples=[8.0]
    )
    frame_rate_hz: float = _frames(200.0)


class Chirp(Section):
    """A chirp about the baseline voltage (row S20)."""

    amplitude_v: float = Field(
        gt=0, le=100, description="amplitude about the baseline voltage", examples=[0.6]
    )
    start_hz: float = Field(gt=0, le=1e4, description="first frequency", examples=[0.1])
    stop_hz: float = Field(gt=0, le=1e4, description="last frequency", examples=[10.0])
    duration_s: float = Field(
        ge=0.01, le=_DAY_S, description="duration of the chirp", examples=[10.0]
    )
    hold_s: float = Field(
        gt=0, le=_DAY_S, description="wait at the baseline voltage before it", examples=[40.0]
    )
    frame_rate_hz: float = _frames(200.0)


class Steps(Section):
    """Steps of strain in open loop and, with controllers, in closed loop (rows S21 to S25)."""

    former_names: ClassVar[Mapping[str, str]] = {
        "own_trials": "custom_trials",
        "printed_chain_trials": "paper_chain_trials",
        "printed_chain_carrier_v": "paper_chain_carrier_v",
    }

    step: float = Field(description="desired strain after the step", examples=[0.04])
    zero_s: float = Field(
        gt=1, le=_DAY_S, description="time at zero strain before the step", examples=[15.0]
    )
    step_s: float = Field(gt=1, le=_DAY_S, description="time after the step", examples=[25.0])
    rest_s: float = Field(
        ge=0, le=_DAY_S, description="wait at 0 V before each trial", examples=[60.0]
    )
    frame_rate_hz: float = _frames(20.0)
    open_trials: int = Field(
        ge=0,
        le=1000,
        description="trials in open loop; at least 1 if the study has [chirp]; 0 is for a step "
        "that only the controller of custom_trials reaches",
        examples=[2],
    )
    pi_trials: int = Field(ge=0, le=1000, description="trials with the PI", examples=[2])
    pid_trials: int = Field(ge=0, le=1000, description="trials with the PID", examples=[2])
    paper_chain_trials: int = Field(
        0, ge=0, le=100, description="trials with the PI and the paper's sensing chain"
    )
    paper_chain_carrier_v: float = Field(
        0.1,
        gt=0,
        le=1,
        description="amplitude of the carrier in these trials; a smaller one is disturbed by the "
        "updates of the output",
    )
    extra_delay_trials: int = Field(
        0,
        ge=0,
        le=100,
        description="trials with a PI designed for outputs delayed by extra_delay_blocks",
    )
    extra_delay_blocks: int = Field(1, ge=1, le=10, description="delay of their outputs, in blocks")
    saturating_trials: int = Field(
        0, ge=0, le=100, description="trials with the PI, to saturating_step first, then to step"
    )
    saturating_step: float = Field(0.2, ge=-1, le=1, description="desired strain in these trials")
    custom_trials: int = Field(
        2,
        ge=1,
        le=1000,
        description="trials with the controller of [control], if it has a kind, or with that of "
        "--actuator",
    )
    feedback: Literal["capacitance", "video"] = Field(
        "capacitance", description="sensor of the closed loops: self-sensing or the camera"
    )


_LOOP_KEYS = {"kind", "parameters", "saturation_low", "saturation_high"}


class Control(Section):
    """Gains of the PI and limits of all controllers (rows S21, S22, S25).

    With `kind`, which adds a controller of any registered kind, the other keys of the table are the
    parameters of that kind.
    """

    kind: str | None = Field(
        None,
        min_length=1,
        max_length=64,
        description="registered kind of a controller for custom_trials",
    )
    parameters: dict[str, float] = Field({}, description="parameters of that controller, by name")
    kp: float = Field(0.85, ge=0, description="proportional gain for a plant of gain plant_gain")
    ki: float = Field(1.5, ge=0, description="integral gain for a plant of gain plant_gain, in 1/s")
    plant_gain: float = Field(
        0.5, gt=0, description="static gain of the plant that kp and ki belong to"
    )
    saturation_low: float = Field(
        -0.05, description="lowest output of the controllers, as a strain"
    )
    saturation_high: float = Field(
        0.1, description="highest output of the controllers, as a strain"
    )

    @model_validator(mode="before")
    @classmethod
    def _own_parameters(cls, data: Any) -> Any:
        if not isinstance(data, dict) or data.get("kind") is None or "parameters" in data:
            return data
        parameters = {key: value for key, value in data.items() if key not in _LOOP_KEYS}
        rest = {key: value for key, value in data.items() if key in _LOOP_KEYS}
        return rest | {"parameters": parameters}


class StepTrials(Section):
    """Steps by a controller that is already on the microcontroller (row S26)."""

    step: float = Field(
        ge=-0.5, le=0.5, description="desired strain after the step, not 0", examples=[0.04]
    )
    zero_s: float = Field(
        gt=1, le=3600, description="time at zero strain before the step", examples=[6.0]
    )
    step_s: float = Field(gt=1, le=3600, description="time after the step", examples=[6.0])
    rest_s: float = Field(
        ge=0, le=86400, description="wait at 0 V before each trial", examples=[2.0]
    )
    frame_rate_hz: float = Field(
        gt=0, le=1e4, description="frames per second of the camera", examples=[100.0]
    )
    trials: int = Field(ge=1, le=1000, description="number of trials", examples=[3])

    @model_validator(mode="after")
    def _is_a_step(self) -> Self:
        if self.step == 0.0:
            raise ValueError("step must not be 0")
        return self


class ModelControl(Section):
    """Closed loops with controllers that use the physical model (rows S25, S27 and S30)."""

    step: float = Field(description="desired strain after the step", examples=[0.04])
    zero_s: float = Field(
        gt=1, le=3600, description="time at zero strain before the step", examples=[2.0]
    )
    step_s: float = Field(gt=1, le=3600, description="time after the step", examples=[2.0])
    rest_s: float = Field(
        ge=0, le=_DAY_S, description="wait at 0 V before each trial", examples=[10.0]
    )
    frame_rate_hz: float = _frames(100.0)
    trials: int = Field(
        ge=1, le=100, description="step trials with observer, and with hybrid for each mass",
        examples=[2],
    )  # fmt: skip
    other_mass_kg: float = Field(
        gt=0, le=1000, description="mass that is hung in place of the rig's own, to be weighed",
        examples=[0.2],
    )  # fmt: skip
    outer_mass_kg: float | None = Field(
        None,
        gt=0,
        le=1000,
        description="mass that stretches the actuator beyond its linear region at 0 V; if left "
        "out, no trial is made there",
    )
    hold_s: float = Field(
        gt=1, le=3600, description="time at each strain beyond the linear region", examples=[2.0]
    )
    linear_high: float = Field(
        description="strain at the upper end of the linear region", examples=[0.18]
    )
    highest_field_v_per_m: float = Field(
        gt=0, description="highest field that the controllers may use", examples=[34e6]
    )
    parameters: dict[str, float] = Field(
        {},
        description="parameters of observer and hybrid, which are the same; designed if left out",
    )

    @model_validator(mode="after")
    def _is_complete(self) -> Self:
        if self.step == 0.0:
            raise ValueError("step must not be 0")
        return self


StepTimes = Steps | StepTrials | ModelControl  # tables with a step and its times
