"""A linear difference equation: a discrete-time model of a sampled record (ARX)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import logm

from haselab.base import InputError, ResultError
from haselab.models.filters import lfilter

__all__ = ["ArxModel"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]


@dataclass(frozen=True)
class ArxModel:
    r"""Difference equation of an input and an output, both relative to their operating point.

    $y_k + a_1 y_{k-1} + \dots + a_{n_a} y_{k-n_a} = b_1 u_{k-n_k} + \dots
    + b_{n_b} u_{k-n_k-n_b+1}$

    Args:
        a: `a_1` to `a_na`. Shape `(na,)`.
        b: `b_1` to `b_nb`. Shape `(nb,)`.
        nk: delay in samples from an input to the first output that depends on it; 1 for a plant
            with a held input, sampled at the update times.
        rate_hz: sampling rate, in Hz.
    Raises:
        InputError: coefficients that are not finite, a negative `nk`, a rate not above zero.
    Source: Ljung, System Identification (1999), eq. 4.7, with its count of `nk`.
    Example:
        >>> model = ArxModel(np.array([-0.5]), np.array([1.0]), 1, 10.0)
        >>> model.static_gain, model.simulate([1.0, 1.0, 1.0]).tolist()
        (2.0, [0.0, 1.0, 1.5])
    """

    a: Floats
    b: Floats
    nk: int
    rate_hz: float

    def __post_init__(self) -> None:
        for name in ("a", "b"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        if not (np.isfinite(self.a).all() and np.isfinite(self.b).all() and self.b.size):
            raise InputError(
                f"The difference equation has a = {self.a.tolist()}, b = {self.b.tolist()}; "
                "all must be finite, with at least one b. Fit the model again."
            )
        if self.nk < 0 or not 0.0 < self.rate_hz < float("inf"):
            raise InputError(
                f"nk = {self.nk}, rate_hz = {self.rate_hz:g} Hz; nk must be 0 or above and "
                "rate_hz above 0 Hz."
            )

    @property
    def denominator(self) -> Floats:
        """`1, a_1, ..., a_na`, in rising powers of the one-sample delay."""
        return np.concatenate([[1.0], self.a])

    @property
    def numerator(self) -> Floats:
        """`nk` zeros, then `b`, in rising powers of the one-sample delay."""
        return np.concatenate([np.zeros(self.nk), self.b])

    @property
    def static_gain(self) -> float:
        """Static gain: output per input in steady state."""
        return float(self.b.sum() / self.denominator.sum())

    @property
    def poles(self) -> Complexes:
        """Roots of the denominator in the z-plane. Shape `(na,)`."""
        return np.asarray(np.roots(self.denominator), dtype=np.complex128)

    @property
    def is_stable(self) -> bool:
        """Whether all poles are inside the unit circle."""
        return bool((np.abs(self.poles) < 1.0).all())

    @property
    def has_continuous(self) -> bool:
        """Whether a continuous model of the same order exists: no pole at z <= 0."""
        z = self.poles
        return not bool(((np.abs(z.imag) < 1e-12) & (z.real <= 0.0)).any())

    def simulate(self, u: ArrayLike) -> Floats:
        """Simulate the output from rest; the input before the first sample is zero.

        Args:
            u: input. Shape `(N,)`.
        Returns:
            Output. Shape `(N,)`.
        """
        return np.asarray(lfilter(self.numerator, self.denominator, np.asarray(u, np.float64)))

    def frequency_response(self, omega_rad_s: ArrayLike) -> Complexes:
        """Complex gain. Shape of `omega_rad_s`, in rad/s."""
        back = np.exp(-1j * np.asarray(omega_rad_s, dtype=np.float64) / self.rate_hz)
        top = np.polynomial.polynomial.polyval(back, self.numerator)
        return np.asarray(top / np.polynomial.polynomial.polyval(back, self.denominator))

    def continuous(self) -> tuple[Floats, Floats, float]:
        """Continuous transfer function with the same samples for a held input.

        Returns:
            Numerator and denominator in falling powers of s, and the delay in s: `nk - 1` samples,
            or none when the output responds to the input at once.
        Raises:
            ResultError: a pole at z <= 0 has no continuous counterpart.
        Source: matrix logarithm of the held state equations; Franklin, Powell and Workman,
            Digital Control of Dynamic Systems (1998), section 4.3.
        Example:
            >>> share = np.exp(-0.2)
            >>> top, bottom, delay_s = ArxModel([-share], [1 - share], 3, 10.0).continuous()
            >>> np.round(top, 9).tolist(), np.round(bottom, 9).tolist(), delay_s
            ([0.0, 2.0], [1.0, 2.0], 0.2)
        """
        if not self.has_continuous:
            raise ResultError(
                f"The difference equation has the poles {np.round(self.poles, 4).tolist()}; one at "
                "z <= 0 has no continuous counterpart. Lower na, or keep the difference equation."
            )
        shift = max(self.nk - 1, 0)
        top = self.numerator[shift:]
        size = max(self.a.size, top.size - 1)
        extra = size - self.a.size
        if extra:
            raise ResultError(
                f"na = {self.a.size} and nb = {self.b.size}: the equation uses more inputs "
                f"than outputs, so {extra} of its poles are at z = 0 and have no continuous "
                "counterpart. Raise na, raise nk, or keep the difference equation."
            )
        return _continuous(top, self.denominator, self.rate_hz, shift)


def _continuous(
    top: Floats, bottom: Floats, rate_hz: float, shift: int
) -> tuple[Floats, Floats, float]:
    """Continuous transfer function by the matrix logarithm of the controller form."""
    size = bottom.size - 1
    padded = np.concatenate([top, np.zeros(size + 1 - top.size)])
    through = float(padded[0])
    held = np.zeros((size + 1, size + 1))
    held[0, :size] = -bottom[1:]
    held[1:size, : size - 1] = np.eye(size - 1)
    held[0, size] = held[size, size] = 1.0
    rates = np.real(logm(held)) * rate_hz
    a, b = rates[:size, :size], rates[:size, size:]
    c = (padded[1:] - through * bottom[1:])[None, :]
    below = np.poly(a)
    above = np.poly(a - b @ c) + (through - 1.0) * below
    above[np.abs(above) < 1e-12 * np.abs(above).max()] = 0.0
    return np.asarray(above, dtype=np.float64), np.asarray(below, dtype=np.float64), shift / rate_hz
