"""Sine fit with the frequency as an unknown: for a carrier whose frequency is not known exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.sensing.sensed import (
    LockinConfig,
    Phasors,
    Sensed,
    check_blocks,
    sensed_from_phasors,
)

__all__ = ["SineFit"]

_MAX_ITERATIONS = 12
_TOLERANCE_RAD = 1e-9  # change of the phase at a block's end: far below any converter's noise


@dataclass(frozen=True)
class _Channel:
    """One channel at one trial frequency: phasor, its variance, and the frequency's correction."""

    phasor: complex
    quadrature_variance: float
    step_rad_s: float
    step_variance: float


class SineFit:
    r"""Four-parameter sine fit of both monitors with one common frequency, block by block.

    $x = a\cos\omega t + b\sin\omega t + c + d\,t$, with $\omega$ refined by Gauss-Newton from
    the nominal carrier. Each channel gives a correction of $\omega$; the two are averaged with
    the weights of their variances. The slope $d$ takes the drive's ramp out. A block whose
    frequency leaves the main lobe ($\pm 1$ period a block), or does not settle, is not valid.

    Args:
        config: see `LockinConfig`; `carrier_hz` is where the search starts.
    Raises:
        InputError: fewer than two carrier periods count, or the carrier is above a third of the
            sampling rate.
    Source: IEEE Std 1057, four-parameter sine fit, with a slope and over two channels.
    Example:
        >>> angle = 2 * np.pi * 2003.0 * np.arange(2000) / 200e3  # 3 Hz beside the nominal
        >>> block = np.stack([np.cos(angle), 2 * np.cos(angle + np.pi / 2)], axis=1)
        >>> fit = SineFit(LockinConfig(200e3, 2000, 2000.0, 0.0, 1e6, min_amplitude_codes=0.1))
        >>> round(float(fit.sense(block[np.newaxis]).capacitance_f[0]) * 2 * np.pi * 2003 * 5e5, 6)
        1.0
        >>> round(float(fit.frequencies_hz(block[np.newaxis])[0]), 6)
        2003.0
    """

    def __init__(self, config: LockinConfig) -> None:
        self.config = config
        used = config.block_samples - config.first_sample
        periods = used * config.carrier_hz / config.rate_hz
        if not (periods >= 2.0 and config.carrier_hz <= config.rate_hz / 3.0 and used >= 8):
            raise InputError(
                f"Sine fit at {config.carrier_hz:g} Hz has {periods:g} periods in {used} samples "
                f"of {config.rate_hz:g} Hz; at least 2 periods and a carrier up to "
                f"{config.rate_hz / 3:g} Hz are needed. Lengthen the block, or sample faster."
            )
        self._time_s = (np.arange(used) - 0.5 * (used - 1)) / config.rate_hz
        self._used_s = used / config.rate_hz

    def sense(self, readings: NDArray[np.int16] | NDArray[np.float64]) -> Sensed:
        """Capacitance and resistance of many blocks.

        Args:
            readings: shape `(blocks, block_samples, 2)`, voltage then current.
        Returns:
            Results, arrays of shape `(blocks,)`; amplitudes in the unit of the readings.
        Raises:
            InputError: the shape does not fit the configuration.
        """
        return sensed_from_phasors(self._fit(readings), self.config)

    def frequencies_hz(
        self, readings: NDArray[np.int16] | NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """The refined frequency of each block.

        Args:
            readings: shape `(blocks, block_samples, 2)`, voltage then current.
        Returns:
            Frequencies in Hz, shape `(blocks,)`; NaN where the fit did not settle.
        Raises:
            InputError: the shape does not fit the configuration.
        """
        return self._fit(readings).omega_rad_s / (2.0 * np.pi)

    def _fit(self, readings: NDArray[np.int16] | NDArray[np.float64]) -> Phasors:
        check_blocks(readings, self.config)
        rows = np.full((len(readings), 5), np.nan, dtype=np.complex128)
        for row, block in zip(rows, readings, strict=True):
            row[:] = self._fit_block(block[self.config.first_sample :].astype(np.float64))
        return Phasors(rows[:, 0], rows[:, 1], rows[:, 2].real, rows[:, 3].real, rows[:, 4].real)

    def _fit_block(
        self, block: NDArray[np.float64]
    ) -> tuple[complex, complex, float, float, float]:
        nominal_rad_s = omega_rad_s = 2.0 * np.pi * self.config.carrier_hz
        reach_rad_s = 2.0 * np.pi / self._used_s
        for _ in range(_MAX_ITERATIONS):
            voltage, current = self._channels(block, omega_rad_s)
            step_rad_s = _combine(voltage, current)
            if abs(step_rad_s) * self._used_s < _TOLERANCE_RAD:
                return (
                    voltage.phasor,
                    current.phasor,
                    voltage.quadrature_variance**0.5,
                    current.quadrature_variance**0.5,
                    omega_rad_s,
                )
            omega_rad_s += step_rad_s
            if not abs(omega_rad_s - nominal_rad_s) < reach_rad_s:
                break
        return np.nan, np.nan, np.nan, np.nan, np.nan

    def _channels(
        self, block: NDArray[np.float64], omega_rad_s: float
    ) -> tuple[_Channel, _Channel]:
        cosine, sine = np.cos(omega_rad_s * self._time_s), np.sin(omega_rad_s * self._time_s)
        level, ramp = np.ones_like(cosine), self._time_s / self._used_s
        basis = np.stack([cosine, sine, level, ramp], axis=1)
        inverse = np.linalg.inv(basis.T @ basis)
        parameters = inverse @ (basis.T @ block)
        residual = block - basis @ parameters
        variance = (residual**2).sum(axis=0) / (len(block) - 5)
        # d x / d omega, without what the basis takes: then omega is one more column.
        slopes = ramp[:, np.newaxis] * (cosine[:, np.newaxis] * parameters[1])
        slopes -= ramp[:, np.newaxis] * (sine[:, np.newaxis] * parameters[0])
        slopes -= basis @ (inverse @ (basis.T @ slopes))
        energy = (slopes**2).sum(axis=0)
        step = (slopes * residual).sum(axis=0) / np.where(energy > 0.0, energy, np.inf)
        spread = variance / np.where(energy > 0.0, energy, np.nan)
        per_quadrature = 0.5 * (inverse[0, 0] + inverse[1, 1])
        voltage, current = (
            _Channel(
                complex(parameters[0, k], -parameters[1, k]),
                float(per_quadrature * variance[k]),
                float(step[k] / self._used_s),
                float(spread[k]),
            )
            for k in (0, 1)
        )
        return voltage, current


def _combine(voltage: _Channel, current: _Channel) -> float:
    """Correction of the common frequency; NaN where a channel carries nothing at all."""
    total = voltage.step_variance + current.step_variance
    if total == 0.0:  # both channels without noise: equally good
        return 0.5 * (voltage.step_rad_s + current.step_rad_s)
    return (
        voltage.step_rad_s * current.step_variance + current.step_rad_s * voltage.step_variance
    ) / total
