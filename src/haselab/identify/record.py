"""One recorded experiment: an input that was held, an output with its own clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError

__all__ = ["Record", "finite_vector"]

Floats = NDArray[np.float64]


def finite_vector(name: str, values: object, least: int) -> Floats:
    """`values` as a finite vector of at least `least` numbers, or an `InputError`."""
    vector = np.asarray(values, dtype=np.float64)
    if vector.ndim != 1 or vector.size < least:
        raise InputError(
            f"{name} has shape {vector.shape}; allowed is a vector of at least {least} values. "
            "Record longer, or name the right column."
        )
    if not np.isfinite(vector).all():
        row = int(np.flatnonzero(~np.isfinite(vector))[0])
        raise InputError(
            f"{name} holds {vector[row]} at index {row}; allowed are finite numbers. "
            "Remove the rows without a value."
        )
    return vector


@dataclass(frozen=True)
class Record:
    """One experiment.

    Args:
        u: input, held at `input_rate_hz` from `t = 0`. Shape `(N,)`.
        input_rate_hz: updates of the input a second, in Hz.
        y: output. Shape `(M,)`.
        output_time_s: rising times of the output on the clock of the input, in s. Shape `(M,)`.
        input_before: input before `t = 0`, at which the plant had settled. None: not known; the
            fit takes 0 or `u[0]`, whichever explains the record better.
    Raises:
        InputError: wrong shapes, NaN, times that do not rise, an input or output without change.
    """

    u: Floats
    input_rate_hz: float
    y: Floats
    output_time_s: Floats
    input_before: float | None = 0.0

    def __post_init__(self) -> None:
        for name, least in (("u", 1), ("y", 8), ("output_time_s", 8)):
            object.__setattr__(self, name, finite_vector(name, getattr(self, name), least))
        if self.y.size != self.output_time_s.size:
            raise InputError(
                f"y has {self.y.size} values and output_time_s {self.output_time_s.size}; allowed "
                "are equal lengths. Give one time for each output."
            )
        if not (np.diff(self.output_time_s) > 0.0).all():
            raise InputError(
                "output_time_s does not rise everywhere; allowed are rising times. "
                "Sort the record, or remove repeated frames."
            )
        if not self.input_rate_hz > 0.0:
            raise InputError(
                f"input_rate_hz = {self.input_rate_hz:g} Hz; allowed is above 0 Hz. "
                "Give the rate at which the input was updated."
            )
        before = self.u[0] if self.input_before is None else self.input_before
        if np.ptp(self.u) == 0.0 and self.u[0] == before and self.input_before is not None:
            raise InputError(
                f"The input is {self.u[0]:g} throughout, so it excites nothing; allowed is an "
                "input that changes. Name the right column, or record a chirp or a step."
            )
        if np.ptp(self.y) == 0.0:
            raise InputError(
                f"The output is {self.y[0]:g} throughout; allowed is an output that changes. "
                "Name the right column, or check the sensor."
            )

    @property
    def duration_s(self) -> float:
        """Time of the last output since the first input, in s."""
        return float(self.output_time_s[-1])

    @classmethod
    def sampled(
        cls, u: object, y: object, rate_hz: float, input_before: float | None = None
    ) -> Record:
        """Record whose output was read at the moments of the input's updates.

        Args:
            u: input. Shape `(N,)`.
            y: output. Shape `(N,)`.
            rate_hz: samples a second, in Hz.
            input_before: as in the class.
        """
        if not rate_hz > 0.0:
            raise InputError(
                f"rate_hz = {rate_hz:g} Hz; allowed is above 0 Hz. Give the sampling rate."
            )
        output = finite_vector("y", y, 8)
        times = np.arange(output.size) / rate_hz
        return cls(finite_vector("u", u, 1), rate_hz, output, times, input_before)
