"""Least-squares lock-in: capacitance and series resistance from one block of both monitors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab import _core
from haselab.base import InputError
from haselab.sensing.sensed import (
    LockinConfig,
    Phasors,
    Sensed,
    check_blocks,
    sensed_from_phasors,
)

__all__ = ["Lockin"]


class Lockin:
    """Lock-in whose basis is sine, cosine, level and slope, so that a ramp leaves no error.

    Args:
        config: see `LockinConfig`.
    Raises:
        InputError: fewer than two carrier periods count, or the carrier is above a third of the
            sampling rate.
    Source: IEEE Std 1057, three-parameter sine fit, with a slope as fourth column.
    Example:
        >>> lockin = Lockin(LockinConfig(200e3, 2000, 2000.0, 0.0, 1e6))
        >>> t = np.arange(2000) / 200e3
        >>> wave = np.exp(2j * np.pi * 2000.0 * t)
        >>> block = np.stack([(1000 * wave).real, (2000j * wave).real], axis=1).round()
        >>> capacitance_f, _, valid = lockin.step(block.astype(np.int16))
        >>> round(capacitance_f * 2 * np.pi * 2000.0 * 500e3, 3), valid
        (1.0, True)
    """

    def __init__(self, config: LockinConfig) -> None:
        self.config = config
        used = config.block_samples - config.first_sample
        periods = used * config.carrier_hz / config.rate_hz
        if not (periods >= 2.0 and config.carrier_hz <= config.rate_hz / 3.0):
            raise InputError(
                f"Lock-in at {config.carrier_hz:g} Hz has {periods:g} periods in {used} samples of "
                f"{config.rate_hz:g} Hz; at least 2 periods and a carrier up to "
                f"{config.rate_hz / 3:g} Hz are needed. Lengthen the block, or sample faster."
            )
        time_s = np.arange(config.block_samples) / config.rate_hz
        angle = 2.0 * np.pi * config.carrier_hz * time_s
        middle_s = 0.5 * (config.first_sample + config.block_samples - 1) / config.rate_hz
        ramp = (time_s - middle_s) / (config.block_samples / config.rate_hz)
        basis = np.stack([np.cos(angle), np.sin(angle), np.ones_like(angle), ramp], axis=1)
        basis[: config.first_sample] = 0.0
        self._basis = basis
        self._inverse = np.linalg.inv(basis.T @ basis)
        self._weights = np.ascontiguousarray((basis @ self._inverse)[:, :2], dtype=np.float32)
        self._impedance = _core.Impedance(
            config.ohm_per_ratio,
            2.0 * np.pi * config.carrier_hz,
            config.skew_s,
            config.min_amplitude_codes,
        )

    def step(self, codes: NDArray[np.int16]) -> tuple[float, float, bool]:
        """One block in the loop, by the C core.

        Args:
            codes: shape `(block_samples, 2)`, voltage then current.
        Returns:
            Capacitance in F, series resistance in ohm, and whether the carrier was there.
        Raises:
            ValueError: the block has another length, or one that is no multiple of 8.
        """
        capacitance_f, resistance_ohm, valid = self._impedance(
            *_core.demodulate(codes, self._weights)
        )
        return capacitance_f, resistance_ohm, valid

    def sense(self, readings: NDArray[np.int16] | NDArray[np.float64]) -> Sensed:
        """Many blocks at once, with standard deviations.

        ADC codes (int16) go through the C core, bit for bit as in the loop; readings in float64,
        and blocks that the core cannot take, through the same least squares in double precision.

        Args:
            readings: shape `(blocks, block_samples, 2)`, voltage then current.
        Returns:
            Results, arrays of shape `(blocks,)`; amplitudes in the unit of the readings.
        Raises:
            InputError: the shape does not fit the configuration.
        """
        check_blocks(readings, self.config)
        numbers = np.empty((len(readings), 4))
        variance = np.empty((len(readings), 2))
        if readings.dtype == np.int16 and self.config.block_samples % 8 == 0:
            codes = np.ascontiguousarray(readings, dtype=np.int16)
            _core.demodulate_blocks(
                codes, self._weights, self._basis, self._inverse, numbers, variance
            )
        else:
            floats = np.ascontiguousarray(readings, dtype=np.float64)
            _core.demodulate_floats(floats, self._basis, self._inverse, numbers, variance)
        # Both quadratures of a phasor have variance 2 sigma^2 / samples.
        per_quadrature = 0.5 * (self._inverse[0, 0] + self._inverse[1, 1])
        std = np.sqrt(per_quadrature * variance)
        return sensed_from_phasors(
            Phasors(
                voltage=numbers[:, 0] + 1j * numbers[:, 1],
                current=numbers[:, 2] + 1j * numbers[:, 3],
                voltage_std=std[:, 0],
                current_std=std[:, 1],
                omega_rad_s=np.full(len(readings), 2.0 * np.pi * self.config.carrier_hz),
            ),
            self.config,
        )
