"""Exact response of one pole to the held input of a converter."""

from __future__ import annotations

import cmath
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.models.filters import lfilter

__all__ = ["HeldInput", "PoleResponse"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]


@dataclass(frozen=True)
class PoleResponse:
    """State of `x' = pole x + u` and its sensitivities, at the requested times.

    Args:
        state: `x`. Shape `(M,)`.
        by_pole: derivative of `x` with respect to the pole. Shape `(M,)`.
        by_time: derivative of `x` with respect to time: minus that with respect to the delay.
            Shape `(M,)`.
    """

    state: Complexes
    by_pole: Complexes
    by_time: Complexes


@dataclass(frozen=True)
class HeldInput:
    r"""Input of a zero-order hold: `u[k]` from `k/rate` to `(k+1)/rate`, the last one without end.

    Before `t = 0` the input is zero.

    Args:
        u: values. Shape `(N,)`.
        rate_hz: update rate, in Hz.
    Example:
        >>> response = HeldInput(np.ones(3), 100.0).response(-2.0 + 0j, np.array([0.7]))
        >>> round(float(response.state[0].real), 9), round(float(1 - np.exp(-1.4)) / 2, 9)
        (0.376701518, 0.376701518)
    """

    u: Floats
    rate_hz: float

    def __post_init__(self) -> None:
        if self.u.ndim != 1 or self.u.size == 0 or not np.isfinite(self.u).all():
            raise InputError(
                f"The held input has shape {self.u.shape} or contains NaN; it must be a finite "
                "vector of at least one value. Remove rows without a value."
            )
        if not self.rate_hz > 0.0:
            raise InputError(
                f"input_rate_hz = {self.rate_hz:g} Hz; it must be above 0 Hz. "
                "Give the rate at which the input was updated."
            )

    def response(self, pole: complex, time_s: Floats) -> PoleResponse:
        r"""State of `x' = pole x + u` from rest, exact at any time.

        $x(t) = e^{p\delta} x_k + \frac{e^{p\delta} - 1}{p} u_k,\quad
        x_{k+1} = e^{pT} x_k + \frac{e^{pT} - 1}{p} u_k$

        Args:
            pole: pole, in rad/s, not zero.
            time_s: times since the first value, in s; before it the state is zero. Shape `(M,)`.
        Returns:
            State and sensitivities. Shape `(M,)` each.
        Source: variation of constants.
        """
        period_s = 1.0 / self.rate_hz
        step = np.exp(pole * period_s)
        push_edge, slope_edge = _push(pole, period_s)
        edge = lfilter([0.0, push_edge], [1.0, -step], self.u)
        edge_by_pole = lfilter(
            [0.0, 1.0], [1.0, -step], period_s * step * edge + slope_edge * self.u
        )
        index = np.floor(time_s * self.rate_hz + 1e-9).astype(np.intp)
        before = index < 0
        index = np.clip(index, 0, self.u.size - 1)
        rest_s = np.where(before, 0.0, time_s - index * period_s)
        held = np.where(before, 0.0, self.u[index])
        decay = np.exp(pole * rest_s)
        push = (decay - 1.0) / pole
        push_by_pole = (rest_s * decay - push) / pole
        start = np.where(before, 0.0, edge[index])
        state = decay * start + push * held
        by_pole = decay * (rest_s * start + np.where(before, 0.0, edge_by_pole[index]))
        return PoleResponse(state, by_pole + push_by_pole * held, pole * state + held)


def _push(pole: complex, span_s: float) -> tuple[complex, complex]:
    """`(e^{pT} - 1)/p` and its derivative by `p`, without cancellation for small `pT`."""
    product = pole * span_s
    value = complex(np.expm1(product)) / pole
    if abs(product) < 1e-3:
        return value, span_s**2 * (0.5 + product / 3.0 + product**2 / 8.0)
    return value, (span_s * cmath.exp(product) - value) / pole
