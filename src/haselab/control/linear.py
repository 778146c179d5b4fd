"""A linear controller that is no PID, as far as stability needs it: its feedback in z."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import InputError

__all__ = ["LinearController"]

_ON_CIRCLE = 1e-9  # of a pole's size from 1: on the unit circle within rounding


@dataclass(frozen=True)
class LinearController:
    r"""Feedback from the measurement, its sign reversed, to the drive: $B(z)/A(z)$.

    Args:
        numerator: B, falling powers of z.
        denominator: A, falling powers of z; at least as many as B.
        rate_hz: steps a second.
    Raises:
        InputError: numbers that are not finite, no leading denominator, a controller that looks
            ahead, or another rate than that of the loop.
    Example:
        >>> integral = LinearController((0.01, 0.0), (1.0, -1.0), 100.0)  # 1/s at 100 Hz
        >>> round(abs(complex(integral.sampled_response(1.0, 100.0))), 3)
        1.0
    """

    numerator: tuple[float, ...]
    denominator: tuple[float, ...]
    rate_hz: float

    def __post_init__(self) -> None:
        numbers = (*self.numerator, *self.denominator)
        good = bool(self.numerator) and bool(self.denominator) and np.isfinite(numbers).all()
        if not good or self.denominator[0] == 0.0 or len(self.numerator) > len(self.denominator):
            raise InputError(
                f"The controller's feedback is {self.numerator} over {self.denominator}. It needs "
                "finite numbers, a first denominator other than 0, and at most as many numbers "
                "above as below. Correct its method linear_feedback."
            )

    def sampled_response(self, omega_rad_s: ArrayLike, rate_hz: float) -> NDArray[np.complex128]:
        """Response at angular frequencies in (0, pi * rate_hz], in rad/s. Shape `(...)`."""
        if not math.isclose(rate_hz, self.rate_hz, rel_tol=1e-9):
            raise InputError(
                f"The controller is linearised for {self.rate_hz:g} Hz, but the loop runs at "
                f"{rate_hz:g} Hz. Use one rate."
            )
        z = np.exp(1j * np.asarray(omega_rad_s, dtype=float) / rate_hz)
        return np.asarray(np.polyval(self.numerator, z) / np.polyval(self.denominator, z))

    def frequency_response(self, omega_rad_s: ArrayLike) -> NDArray[np.complex128]:
        """The same at its own rate."""
        return self.sampled_response(omega_rad_s, self.rate_hz)

    @property
    def corners_rad_s(self) -> NDArray[np.complex128]:
        """Poles and zeros other than 0 and 1, as those of continuous time."""
        roots = np.concatenate([np.roots(self.numerator), np.roots(self.denominator)])
        roots = roots[(np.abs(roots) > 0.0) & (np.abs(roots - 1.0) > _ON_CIRCLE)]
        return np.asarray(np.log(roots.astype(complex)) * self.rate_hz)

    @property
    def open_loop_poles(self) -> tuple[int, NDArray[np.complex128]]:
        """How many poles lie outside the unit circle; and those on it, as of continuous time."""
        poles = np.roots(self.denominator).astype(complex)
        on_circle = np.abs(np.abs(poles) - 1.0) <= _ON_CIRCLE
        axis = np.log(poles[on_circle]) * self.rate_hz
        return int((np.abs(poles[~on_circle]) > 1.0).sum()), np.asarray(1j * axis.imag)
