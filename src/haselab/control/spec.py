"""Specification of a controller's performance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from haselab.base import InputError, check_fields

__all__ = ["DesignSpec"]

_SMALLEST_STEP, _LARGEST_STEP = 1e-12, 1e12
_LARGEST = 1e30  # NaN and infinity are not valid either


@dataclass(frozen=True)
class DesignSpec:
    """Demands on a loop. All except a target rise time apply over the frequency spread.

    Args:
        rise_time_s: 10 to 90 % rise time, with ringing averaged out, in s; None: not specified.
        rise_time_tolerance: None: `rise_time_s` is an upper limit, and the largest integral gain
            within all demands is sought. A number: the rise time has to be within this relative
            tolerance, and the most robust such loop is sought.
        overshoot: largest overshoot, including ringing, relative to the step; None: not specified.
        steady_state_error: largest error at the end of the simulated step (a few of the
            plant's slowest time constants), relative to the step.
        phase_margin_deg: smallest phase margin over all crossovers, in degrees.
        gain_margin_db: smallest gain margin, in dB.
        peak_sensitivity: largest peak sensitivity.
        noise_gain: largest change of the controller's output when one measurement changes by 1, in
            the plant's input unit per output unit; None: 15, divided by the magnitude of the
            plant's static gain if that is below 0.1.
        frequency_spread: relative uncertainty of the natural frequency, up and down.
        keep_crossover: whether the highest crossover must be at least the plant's own.
        step: reference step of the simulated experiments, in the unit of the plant's output,
            negative for a contraction; None: 0.04, or where the limits do not allow that, half of
            the larger step that they allow.
    Raises:
        InputError: a demand out of range.
    Example:
        >>> DesignSpec.from_mapping({"rise_time_s": 0.8}).phase_margin_deg
        50.0
    """

    rise_time_s: float | None = None
    rise_time_tolerance: float | None = None
    overshoot: float | None = 0.08
    steady_state_error: float = 0.02
    phase_margin_deg: float = 50.0
    gain_margin_db: float = 6.0
    peak_sensitivity: float = 2.0
    noise_gain: float | None = None
    frequency_spread: float = 0.15
    keep_crossover: bool = False
    step: float | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        ranges = {
            "rise_time_s": (1e-4, 1e4),
            "rise_time_tolerance": (1e-4, 1.0),
            "overshoot": (0.0, 10.0),
            "steady_state_error": (1e-6, 1.0),
            "phase_margin_deg": (0.0, 90.0),
            "gain_margin_db": (0.0, 60.0),
            "peak_sensitivity": (1.0, 1e3),
            "noise_gain": (0.0, _LARGEST),
            "frequency_spread": (0.0, 0.9),
        }
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise InputError(f"{name} = {value:g}; it must be within [{low:g}, {high:g}].")
        if self.step is not None and not _SMALLEST_STEP <= abs(self.step) <= _LARGEST_STEP:
            raise InputError(
                f"step = {self.step:g}; its magnitude must be within [{_SMALLEST_STEP:g}, "
                f"{_LARGEST_STEP:g}]."
            )
        if self.rise_time_tolerance is not None and self.rise_time_s is None:
            raise InputError("rise_time_tolerance is given without rise_time_s. Add rise_time_s.")

    @classmethod
    def from_mapping(cls, data: Mapping[str, Any]) -> DesignSpec:
        """Create a specification from names and values, for example of a TOML file.

        Raises:
            InputError: an unknown name, or a value of the wrong type.
        """
        known = {item.name for item in fields(cls)}
        for name, value in data.items():
            if name not in known:
                raise InputError(
                    f"The specification has the unknown key {name!r}. The keys are "
                    f"{', '.join(sorted(known))}."
                )
            flag = name == "keep_crossover"
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not (isinstance(value, bool) if flag else number and abs(value) <= _LARGEST):
                raise InputError(
                    f"{name} = {value!r}; it must be {'true or false' if flag else 'a number'}."
                )
        values: dict[str, Any] = {
            name: value if isinstance(value, bool) else float(value) for name, value in data.items()
        }
        return cls(**values)
