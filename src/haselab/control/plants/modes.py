"""The plant as a sum of first-order modes: exact between samples, for any delay."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.control.gains import PidGains
from haselab.control.plants.held import HeldPlants
from haselab.models.plant import Plant

__all__ = ["Modes", "SampledLoops", "split_delay"]


@dataclass(frozen=True)
class Modes:
    r"""Partial fractions of a plant without its delay: $G_0(s) = \sum_i r_i/(s - p_i)$.

    Args:
        poles: complex poles, in 1/s. Shape `(M,)`.
        residues: complex residues, in 1/s. Shape `(M,)`.
    Example:
        >>> modes = Modes.of(Plant(0.5, 5.11, 0.09))
        >>> round(float(-(modes.residues / modes.poles).sum().real), 12)
        0.5
    """

    poles: NDArray[np.complex128]
    residues: NDArray[np.complex128]

    @classmethod
    def of(cls, plant: Plant) -> Modes:
        """Partial fractions of `plant`; without its delay."""
        poles = np.array(plant.poles, dtype=complex)
        pair = plant.gain * plant.natural_frequency_rad_s**2 / (poles[0] - poles[1])
        slow = [complex(mode.gain / mode.time_constant_s) for mode in plant.slow_modes]
        return cls(poles, np.array([pair, -pair, *slow]))

    def free(self, time_s: ArrayLike) -> NDArray[np.complex128]:
        """Decay of each mode over `time_s`. Shape `(..., M)`."""
        return np.asarray(np.exp(np.asarray(time_s, dtype=float)[..., None] * self.poles))

    def held(self, time_s: ArrayLike) -> NDArray[np.complex128]:
        """State of each mode after a unit input held for `time_s`. Shape `(..., M)`."""
        exponent = np.asarray(time_s, dtype=float)[..., None] * self.poles
        return np.asarray(np.expm1(exponent) / self.poles)

    def sampled_response(
        self, omega_rad_s: ArrayLike, rate_hz: float, delay_s: float
    ) -> NDArray[np.complex128]:
        r"""Exact response of the plant between a zero-order hold and a delayed sampler.

        With $D = nT - a$, $0 \le a < T$:
        $G_d(z) = z^{-n}\sum_i r_i\left[e^{p_i a}\frac{(e^{p_i T}-1)/p_i}{z-e^{p_i T}}
        + \frac{e^{p_i a}-1}{p_i}\right]$ (the modified z-transform; all aliases included).

        Args:
            omega_rad_s: angular frequencies in (0, pi * rate_hz], in rad/s. Shape `(...)`.
            rate_hz: sampling rate, in Hz.
            delay_s: delay of plant and measurement together, in s.
        Returns:
            Complex response of the same shape.
        """
        period_s = 1.0 / rate_hz
        samples, lead_s = split_delay(delay_s, period_s)
        z = np.exp(1j * np.asarray(omega_rad_s, dtype=float) * period_s)
        step = self.free(lead_s) * self.held(period_s)
        terms = step / (z[..., None] - self.free(period_s)) + self.held(lead_s)
        return np.asarray(z**-samples * (terms @ self.residues))


@dataclass(frozen=True)
class SampledLoops:
    """Coefficients of many sampled loops: one step of plant and controller each.

    A loop's state consists of the states of its plant, delay line, integrator and
    measurement filter.

    Args:
        plant: plants including all delays.
        kp: proportional gains. Shape `(B,)`.
        ki: integral gains times the period. Shape `(B,)`.
        kd: derivative gains over the period. Shape `(B,)`.
        weight: share of a new measurement in the filter. Shape `(B,)`.
    """

    plant: HeldPlants
    kp: NDArray[np.float64]
    ki: NDArray[np.float64]
    kd: NDArray[np.float64]
    weight: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        plants: Sequence[Plant],
        gains: Sequence[PidGains],
        *,
        period_s: float,
        measurement_delay_s: float,
        feedthrough: float = 0.0,
    ) -> SampledLoops:
        """Compute the coefficients from one plant and one controller per loop."""
        kp, ki, kd, tau = np.array([(g.kp, g.ki, g.kd, g.derivative_filter_s) for g in gains]).T
        return cls(
            plant=HeldPlants.of(
                plants,
                period_s=period_s,
                measurement_delay_s=measurement_delay_s,
                feedthrough=feedthrough,
            ),
            kp=kp,
            ki=ki * period_s,
            kd=kd / period_s,
            weight=period_s / (period_s + tau),
        )

    def poles(self) -> NDArray[np.complex128]:
        """Poles of the closed loops in the z-plane, without saturation. Shape `(B, states)`.

        A loop with a shorter delay than the longest has poles at 0 for the difference.
        """
        plant = self.plant
        loops, longest = self.kp.size, int(plant.samples.max())
        modes = 2 + plant.slow_decay.shape[1]
        size = modes + longest + 2
        x = np.broadcast_to(np.eye(size), (loops, size, size))
        state, line = x[:, :modes], x[:, modes : modes + longest]
        integral, filtered = x[:, -2], x[:, -1]
        measured = line[:, 0]
        change = self.weight[:, None] * (measured - filtered)
        increment = -self.ki[:, None] * measured
        u = integral + increment - self.kp[:, None] * measured - self.kd[:, None] * change
        after = np.zeros_like(x)
        free = plant.free.reshape(-1, 2, 2)
        after[:, :2] = free @ state[:, :2] + plant.push[..., None] * u[:, None]
        after[:, 2:modes] = plant.slow_decay[..., None] * state[:, 2:]
        after[:, 2:modes] += plant.slow_push[..., None] * u[:, None]
        after[:, modes : modes + longest - 1] = line[:, 1:]
        arriving = state[:, 0] + state[:, 2:].sum(axis=1) + plant.feed[:, None] * u
        after[np.arange(loops), modes + plant.samples - 1] = arriving
        after[:, -2] = integral + increment
        after[:, -1] = filtered + change
        return np.asarray(np.linalg.eigvals(after), dtype=complex)


def split_delay(delay_s: float, period_s: float) -> tuple[int, float]:
    """Split a delay into whole samples `n` and lead `a`: `delay_s = n * period_s - a`, `a >= 0`.

    A delay within 1e-9 of a period of a whole number counts as whole.

    Example:
        >>> split_delay(0.75, 1.0)
        (1, 0.25)
    """
    samples = math.ceil(delay_s / period_s - 1e-9)
    return samples, max(0.0, samples * period_s - delay_s)
