"""A study as data: STUDY.toml, checked all at once."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from haselab.base import InputError
from haselab.controllers import controller_kind
from haselab.store.toml import Section as _Section
from haselab.store.toml import read_toml, validated

__all__ = [
    "LEAST_LOADS",
    "Chirp",
    "Control",
    "FreeResponse",
    "OperatingPoint",
    "Sensing",
    "StaticLoad",
    "StepStudy",
    "StepTrials",
    "Steps",
    "Study",
    "Triangle",
    "builtin_study",
    "load_step_study",
    "load_study",
    "step_study_of",
]


LEAST_LOADS = 7  # of the static test: the fit needs six beside the lightest, its reference
_DAY_S = 86400.0
_volt = Field(ge=-100, le=100)
_frames = Field(gt=0, le=1e5)


class Sensing(_Section):
    """The sensing signal, and the calibration data of eqs. 2 and 3 (row D11b)."""

    carrier_hz: float = Field(gt=0, le=1e6)
    carrier_v: float = Field(gt=0, le=1)
    reactance_scale: float = Field(gt=0)
    capacitance_scale: float = Field(gt=0)


class OperatingPoint(_Section):
    """Row S18; the weight is the rig's."""

    baseline_v: float | None = Field(
        None,
        ge=-100,
        le=100,
        description="drive voltage of zero strain, DAQ volts; left out: the one that centres the "
        "strain in the longest linear region",
    )


class Triangle(_Section):
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
        return self


class StaticLoad(_Section):
    """Rows S16 and S17."""

    masses_kg: tuple[float, ...] = Field(max_length=1000)
    settle_s: float = Field(gt=0, le=_DAY_S)
    frame_rate_hz: float = _frames
    pieces: int | None = Field(
        None,
        ge=1,
        le=6,
        description="straight segments of the load curve; left out: as many as BIC prefers",
    )

    @field_validator("masses_kg", mode="after")
    @classmethod
    def _suffice(cls, masses_kg: tuple[float, ...]) -> tuple[float, ...]:
        if (different := len(set(masses_kg))) < LEAST_LOADS:
            raise ValueError(f"{different} different masses; allowed are {LEAST_LOADS} or more")
        return masses_kg


class FreeResponse(_Section):
    """Row S19."""

    trials: int = Field(ge=1, le=1000)
    settle_s: float = Field(gt=0, le=_DAY_S)
    record_s: float = Field(gt=0, le=_DAY_S)
    frame_rate_hz: float = _frames


class Chirp(_Section):
    """Row S20."""

    amplitude_v: float = Field(gt=0, le=100)
    start_hz: float = Field(gt=0, le=1e4)
    stop_hz: float = Field(gt=0, le=1e4)
    duration_s: float = Field(ge=0.01, le=_DAY_S)
    hold_s: float = Field(gt=0, le=_DAY_S)
    frame_rate_hz: float = _frames


class Steps(_Section):
    """Rows S21 to S25."""

    step: float = Field(description="desired strain")
    zero_s: float = Field(gt=1, le=_DAY_S)
    step_s: float = Field(gt=1, le=_DAY_S)
    rest_s: float = Field(ge=0, le=_DAY_S)
    frame_rate_hz: float = _frames
    open_trials: int = Field(ge=1, le=1000)
    pi_trials: int = Field(ge=1, le=1000)
    pid_trials: int = Field(ge=0, le=1000)
    printed_chain_trials: int = Field(
        0, ge=0, le=100, description="with the PI, closed by the paper's sensing chain"
    )
    printed_chain_carrier_v: float = Field(
        0.1, gt=0, le=1, description="of these trials, whose outputs' steps leak into the carrier"
    )
    extra_delay_trials: int = Field(
        0,
        ge=0,
        le=100,
        description="with a PI for outputs that are held back by extra_delay_blocks",
    )
    extra_delay_blocks: int = Field(1, ge=1, le=10)
    saturating_trials: int = Field(
        0, ge=0, le=100, description="with the PI, to saturating_step first, then to step"
    )
    saturating_step: float = Field(0.2, ge=-1, le=1, description="desired strain")
    own_trials: int = Field(
        2, ge=1, le=1000, description="with the controller of [control] kind, where there is one"
    )
    feedback: Literal["capacitance", "video"] = Field(
        "capacitance", description="what the closed loops take their strain from"
    )


_LOOP_KEYS = {"kind", "parameters", "saturation_low", "saturation_high"}


class Control(_Section):
    """Rows S21, S22, S25; with `kind`, a controller of any registered kind beside the paper's.

    With `kind`, the other keys of the table are the parameters of that kind.
    """

    kind: str | None = Field(
        None, min_length=1, max_length=64, description="registered kind that plays own_trials"
    )
    parameters: dict[str, float] = Field({}, description="of that kind")
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


class Study(_Section):
    """Everything that a run needs to know besides the rig."""

    name: str
    sensing: Sensing
    operating_point: OperatingPoint
    triangle: Triangle
    static_load: StaticLoad
    free_response: FreeResponse
    chirp: Chirp
    steps: Steps
    control: Control

    @property
    def nominal_baseline_v(self) -> float:
        """The baseline that is given, or the middle of the triangle, about which one is found."""
        given = self.operating_point.baseline_v
        return 0.5 * (self.triangle.low_v + self.triangle.high_v) if given is None else given


class StepTrials(_Section):
    """Steps by a controller that is ready: row S24, on the chip."""

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


class StepStudy(_Section):
    """Step trials alone, for a rig that closes its own loop."""

    name: str
    step_trials: StepTrials


def _merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in changes.items():
        old = merged.get(key)
        both = isinstance(value, dict) and isinstance(old, dict)
        merged[key] = _merged(old, value) if both and isinstance(old, dict) else value
    return merged


def load_study(path: Path, *, quick: bool = False) -> Study:
    """Read STUDY.toml; every fault is told at once, with its path in the file.

    Args:
        path: of the TOML file; its table `quick` holds the changes of a quick run.
        quick: apply those changes.
    Returns:
        The checked study.
    Raises:
        InputError: no such file, no TOML, an unknown key or a value out of range.
    """
    data = _read(path, quick)
    if "step_trials" in data:
        raise InputError(
            "The study holds a table [step_trials], which a rig of kind 'mega' plays alone. Name "
            f"such a rig, or a study of all experiments. {path}"
        )
    return _with_all_parameters(validated(Study, data, path), path)


def _with_all_parameters(study: Study, path: Path) -> Study:
    """The study with the default of each parameter that its own controller leaves out.

    Raises:
        InputError: the kind is not registered, or does not accept the parameters.
    """
    control = study.control
    if control.kind is None:
        return study
    values = dict(controller_kind(control.kind).choose(control.parameters, path).values)
    return study.model_copy(update={"control": control.model_copy(update={"parameters": values})})


def load_step_study(path: Path, *, quick: bool = False) -> StepStudy:
    """The same for a study of step trials alone.

    Args:
        path: of the TOML file.
        quick: apply its table `quick`.
    Returns:
        The checked study.
    Raises:
        InputError: as of `load_study`.
    """
    data = _read(path, quick)
    if "step_trials" not in data:
        raise InputError(
            "The study holds no table [step_trials], which is all that a chip plays (step, zero_s, "
            f"step_s, rest_s, frame_rate_hz, trials). Give one, or name another rig. {path}"
        )
    return validated(StepStudy, data, path)


def step_study_of(study: Study, *, quick: bool = False) -> StepStudy:
    """The study's step as step trials for a chip, row S26.

    Args:
        study: whose step it is.
        quick: one short trial.
    """
    path = Path(__file__).parent / "studies" / "chip-steps.toml"
    steps = load_step_study(path, quick=quick)
    trials = steps.step_trials.model_copy(update={"step": study.steps.step})
    return steps.model_copy(update={"step_trials": trials})


def _read(path: Path, quick: bool) -> dict[str, Any]:
    data = read_toml(path, "study")
    changes = data.pop("quick", {})
    return _merged(data, changes) if quick else data


def builtin_study(*, quick: bool = False) -> Study:
    """The reference study that comes with the package."""
    return load_study(Path(__file__).parent / "studies" / "hasel-iros2018.toml", quick=quick)
