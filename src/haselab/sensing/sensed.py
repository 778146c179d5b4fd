"""What every sensing method takes and gives: configuration, phasors, results block by block."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError

__all__ = ["LockinConfig", "Phasors", "Sensed", "check_blocks", "sensed_from_phasors"]

# Amplitude over the standard deviation of a quadrature. Noise alone exceeds it once in 270,000
# blocks: exp(-5^2 / 2), the tail of its Rayleigh distribution.
_CLEAR_OF_NOISE = 5.0


@dataclass(frozen=True)
class LockinConfig:
    """What a sensing method must know.

    Args:
        rate_hz: samples per second and channel.
        block_samples: samples per block; the C core takes multiples of 8.
        carrier_hz: sensing frequency.
        skew_s: time from a voltage sample to its current sample.
        ohm_per_ratio: impedance for equal readings on both channels, in ohm:
            (V per V of the amplifier output) / (A per V) of the two monitors.
        first_sample: samples before it are blanked (the output changed a known time earlier).
        min_amplitude_codes: below it the carrier counts as lost, in ADC codes; in the unit of the
            readings where they are no codes.
    """

    rate_hz: float
    block_samples: int
    carrier_hz: float
    skew_s: float
    ohm_per_ratio: float
    first_sample: int = 0
    min_amplitude_codes: float = 5.0

    @property
    def block_s(self) -> float:
        """Duration of one block, in s."""
        return self.block_samples / self.rate_hz


@dataclass(frozen=True)
class Sensed:
    """Results block by block; every array has shape `(blocks,)`.

    Args:
        time_s: middle of the samples that counted, from the first sample of the first block.
        capacitance_f: series capacitance.
        capacitance_std_f: its standard deviation, from the residual of the same block.
        resistance_ohm: series resistance.
        phase_rad: phase of current against voltage.
        v_pp: peak-to-peak carrier on the voltage monitor, in the unit of the readings.
        i_pp: the same on the current monitor.
        valid: the carrier was there: above the configured floor and clear of the noise.
    """

    time_s: NDArray[np.float64]
    capacitance_f: NDArray[np.float64]
    capacitance_std_f: NDArray[np.float64]
    resistance_ohm: NDArray[np.float64]
    phase_rad: NDArray[np.float64]
    v_pp: NDArray[np.float64]
    i_pp: NDArray[np.float64]
    valid: NDArray[np.bool_]


@dataclass(frozen=True)
class Phasors:
    """The carrier on both monitors, block by block; arrays of shape `(blocks,)`.

    Args:
        voltage: complex peak amplitude, in the unit of the readings.
        current: the same of the current monitor, at its own sampling instants.
        voltage_std: standard deviation of one quadrature of `voltage`.
        current_std: the same of `current`.
        omega_rad_s: frequency of the carrier, one number or one a block.
    """

    voltage: NDArray[np.complex128]
    current: NDArray[np.complex128]
    voltage_std: NDArray[np.float64]
    current_std: NDArray[np.float64]
    omega_rad_s: NDArray[np.float64]


def check_blocks(readings: NDArray[np.generic], config: LockinConfig) -> None:
    """Refuse readings that are not cut into the configured blocks.

    Args:
        readings: expected shape `(blocks, block_samples, 2)`.
        config: states `block_samples`.
    Raises:
        InputError: the shape differs.
    """
    if readings.ndim != 3 or readings.shape[1:] != (config.block_samples, 2):
        raise InputError(
            f"Blocks of shape {readings.shape} do not fit (blocks, {config.block_samples}, 2). "
            "Cut the record into whole blocks."
        )


def sensed_from_phasors(phasors: Phasors, config: LockinConfig) -> Sensed:
    r"""Series capacitance and resistance from the two phasors of each block.

    $Z = k\,V / (I e^{-j\omega s}),\quad C = 1 / (\omega\,|\mathrm{Im} Z|),\quad R = \mathrm{Re} Z$

    With equal, independent noise in both quadratures, $\sigma_V$ and $\sigma_I$, the relative
    standard deviation of C is $\sqrt{\sigma_V^2/|V|^2 + \sigma_I^2/|I|^2}\;|Z|/|\mathrm{Im} Z|$.

    Args:
        phasors: of each block.
        config: scale, skew and the amplitude below which the carrier is lost.
    Returns:
        Results; the numbers of a block that is not valid are NaN, but for its amplitudes.
    Example:
        >>> config = LockinConfig(200e3, 2000, 2000.0, 0.0, ohm_per_ratio=1e6)
        >>> one = np.ones(1)
        >>> sensed = sensed_from_phasors(
        ...     Phasors(10 * one + 0j, 20j * one, 0.01 * one, 0.02 * one, 2e3 * one), config)
        >>> [float(f"{x[0]:.3g}") for x in (sensed.capacitance_f, sensed.capacitance_std_f)]
        [1e-09, 1.41e-12]
    """
    voltage, omega_rad_s = phasors.voltage, phasors.omega_rad_s
    current = phasors.current * np.exp(-1j * omega_rad_s * config.skew_s)
    floor = config.min_amplitude_codes
    valid = np.abs(voltage) > np.maximum(floor, _CLEAR_OF_NOISE * phasors.voltage_std)
    valid &= np.abs(current) > np.maximum(floor, _CLEAR_OF_NOISE * phasors.current_std)
    ratio = np.divide(voltage, current, out=np.full_like(voltage, np.nan), where=valid)
    valid &= np.abs(ratio.imag) > 0.0
    ratio[~valid] = np.nan
    impedance_ohm = config.ohm_per_ratio * ratio
    capacitance_f = 1.0 / (omega_rad_s * np.abs(impedance_ohm.imag))
    noise = phasors.voltage_std**2 + (phasors.current_std * np.abs(ratio)) ** 2
    return Sensed(
        time_s=_middles_s(config, voltage.size),
        capacitance_f=capacitance_f,
        capacitance_std_f=capacitance_f
        * np.sqrt(noise)
        / np.where(valid, np.abs(voltage), np.nan)
        * np.abs(ratio)
        / np.abs(ratio.imag),
        resistance_ohm=impedance_ohm.real,
        phase_rad=-np.angle(ratio),
        v_pp=2.0 * np.abs(voltage),
        i_pp=2.0 * np.abs(current),
        valid=valid,
    )


def _middles_s(config: LockinConfig, blocks: int) -> NDArray[np.float64]:
    first_s = 0.5 * (config.first_sample + config.block_samples - 1) / config.rate_hz
    return first_s + config.block_s * np.arange(blocks, dtype=np.float64)
