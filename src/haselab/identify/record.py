"""One recorded experiment: input with its hold, output with its sample times."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import Estimate, InputError, check_fields, checked, real_array

__all__ = ["HOLDS", "Record", "finite_vector", "record_notes"]

Floats = NDArray[np.float64]
HOLDS = ("zero", "first", "band-limited")
_LARGEST_GAP = 50.0  # typical sampling intervals of the output
_LARGEST_SHARE = 0.05  # of the record


def finite_vector(name: str, values: object, least: int) -> Floats:
    """`values` as a finite vector of at least `least` numbers, or an `InputError`."""
    vector = real_array(name, values)
    if vector.ndim != 1:
        raise InputError(f"{name} has shape {vector.shape}; it must be a vector.")
    if vector.size < least:
        raise InputError(
            f"{name} has {vector.size} values, but at least {least} are needed. Record longer, or "
            "name the right column."
        )
    if not np.isfinite(vector).all():
        row = int(np.flatnonzero(~np.isfinite(vector))[0])
        raise InputError(
            f"{name} is {vector[row]} at index {row}; it must be finite. "
            "Remove rows without a value."
        )
    return vector


@dataclass(frozen=True)
class Record:
    """One experiment.

    Args:
        u: input, updated at `input_rate_hz` from `t = 0`. Shape `(N,)`.
        input_rate_hz: update rate of the input, in Hz.
        y: output. Shape `(M,)`.
        output_time_s: rising times of the output on the clock of the input, in s. Shape `(M,)`.
        input_before: input before `t = 0`, at which the plant was settled. None: not known; the
            fit takes 0 or `u[0]`, whichever explains the record better.
        hold: interpolation of the input between its updates: "zero" (held, as a converter does),
            "first" (straight lines), or "band-limited" (a measured signal without content above
            half its rate).
        hold_assumed: whether `hold` was not stated; a fit then notes what depends on it.
        notes: how the record was made, for example of uneven times; a fit repeats them.
    Raises:
        InputError: wrong shapes, NaN, times that do not rise or that have a gap, a constant input
            or output.
    """

    u: Floats
    input_rate_hz: float
    y: Floats
    output_time_s: Floats
    input_before: float | None = 0.0
    hold: str = "zero"
    hold_assumed: bool = False
    notes: tuple[str, ...] = ()
    made_by: ClassVar[str] = (
        "Make records of two arrays with haselab.records({'u': u, 'y': y}, rate_hz=100), or of a "
        "file with haselab.records(path, input, output)."
    )

    def __post_init__(self) -> None:
        check_fields(self)
        for name, least in (("u", 1), ("y", 8), ("output_time_s", 8)):
            object.__setattr__(self, name, finite_vector(name, getattr(self, name), least))
        if self.y.size != self.output_time_s.size:
            raise InputError(
                f"y has {self.y.size} values and output_time_s {self.output_time_s.size}; they "
                "must be equally long. Give one time for each output."
            )
        _check_times(self.output_time_s)
        if not 0.0 < self.input_rate_hz < math.inf:
            raise InputError(
                f"input_rate_hz = {self.input_rate_hz:g} Hz; it must be above 0 Hz and finite. "
                "Give the rate at which the input was updated."
            )
        if self.hold not in HOLDS:
            raise InputError(f"hold = {self.hold}; it must be one of {', '.join(HOLDS)}.")
        before = self.u[0] if self.input_before is None else self.input_before
        if np.ptp(self.u) == 0.0 and self.u[0] == before and self.input_before is not None:
            raise InputError(
                f"The input is {self.u[0]:g} throughout, so it excites nothing. It "
                "must change. Name the right column, or record a chirp or a step."
            )
        if np.ptp(self.y) == 0.0:
            raise InputError(
                f"The output is {self.y[0]:g} throughout; it must change. "
                "Name the right column, or check the sensor."
            )

    @property
    def duration_s(self) -> float:
        """Time from the first input to the last output, in s."""
        return float(self.output_time_s[-1])

    @cached_property
    def output_step_s(self) -> float:
        """Median time between two outputs, in s."""
        return float(np.median(np.diff(self.output_time_s)))

    @classmethod
    @checked
    def sampled(
        cls,
        u: ArrayLike,
        y: ArrayLike,
        rate_hz: float,
        input_before: float | None = None,
        *,
        hold: str = "zero",
        held_at_hz: float | None = None,
    ) -> Record:
        """Create a record whose input and output were sampled at the same times.

        Args:
            u: input. Shape `(N,)`.
            y: output. Shape `(N,)`.
            rate_hz: sampling rate, in Hz.
            input_before: as in the class.
            hold: as in the class.
            held_at_hz: actual update rate of the input, a whole fraction of `rate_hz`,
                if the command was recorded faster than the converter updates. None: `rate_hz`.
        """
        if not 0.0 < rate_hz < math.inf:
            raise InputError(
                f"rate_hz = {rate_hz:g} Hz; it must be above 0 Hz and finite. Give the "
                "sampling rate."
            )
        source, output = finite_vector("u", u, 8), finite_vector("y", y, 8)
        if source.size != output.size:
            raise InputError(
                f"u has {source.size} values and y {output.size}, but they must be equally long. "
                "Give both at the same times, or name the right columns."
            )
        times = np.arange(output.size) / rate_hz
        every = 1
        if held_at_hz is not None:
            every = round(rate_hz / held_at_hz) if held_at_hz > 0.0 else 0
            if every < 1 or abs(every * held_at_hz - rate_hz) > 1e-6 * rate_hz:
                raise InputError(
                    f"held_at_hz = {held_at_hz:g} Hz; it must be {rate_hz:g} Hz divided by a whole "
                    "number. Give the update rate of the converter."
                )
        return cls(source[::every], rate_hz / every, output, times, input_before, hold)


def _check_times(time_s: Floats) -> None:
    """Require rising times without a gap; single missing samples are allowed."""
    steps = np.diff(time_s)
    if not (steps > 0.0).all():
        raise InputError(
            "output_time_s does not rise everywhere. Sort the record, or remove repeated frames."
        )
    widest = int(np.argmax(steps))
    usual_s = float(np.median(steps))
    if steps[widest] > max(_LARGEST_GAP * usual_s, _LARGEST_SHARE * float(time_s[-1] - time_s[0])):
        raise InputError(
            f"output_time_s has a gap of {steps[widest]:g} s after {time_s[widest]:g} s; samples "
            f"are {usual_s:g} s apart. Cut the record there and give two records."
        )


def record_notes(records: Sequence[Record], delay: Estimate | None) -> tuple[str, ...]:
    """Notes of a fit on its records: how they were made, and what depends on an assumed hold.

    Args:
        records: that were fitted.
        delay: that was estimated; None: the model has none.
    Returns:
        The notes, without duplicates.
    """
    notes = [note for record in records for note in record.notes]
    assumed = [record for record in records if record.hold_assumed]
    sample_s = 1.0 / assumed[0].input_rate_hz if assumed else 0.0
    # Not where the interval is wider than half a sample, or the delay was not estimated.
    if assumed and delay is not None and 0.0 < 4.0 * delay.std < sample_s:
        notes.append(
            "The input is assumed to be held from sample to sample. If it was measured, such as a "
            "monitor voltage, use --hold band-limited (Python: hold='band-limited'); otherwise "
            f"the delay is too short by half a sample, {sample_s / 2:.3g} s."
        )
    return tuple(dict.fromkeys(notes))
