"""Data of Bode, Nyquist and Nichols charts of a frequency response, with 95 % intervals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base.estimate import Z95

__all__ = ["BodeChart", "NicholsChart", "NyquistChart"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
# |error|^2/std^2 of a complex normal is exponential.
_RADIUS95 = float(np.sqrt(-np.log(0.05)))


@dataclass(frozen=True)
class BodeChart:
    """Magnitude and phase with 95 % intervals; all `(K,)`.

    Args:
        frequency_hz: frequencies, in Hz.
        magnitude: gain, in the unit of the output per unit of the input.
        magnitude_low: lower end; zero where the magnitude may be zero.
        magnitude_high: upper end.
        phase_rad: phase without jumps, in rad.
        phase_low_rad: lower end, at most half a turn away.
        phase_high_rad: upper end.
    """

    frequency_hz: Floats
    magnitude: Floats
    magnitude_low: Floats
    magnitude_high: Floats
    phase_rad: Floats
    phase_low_rad: Floats
    phase_high_rad: Floats

    @classmethod
    def of(cls, frequency_hz: Floats, response: Complexes, std: Floats) -> BodeChart:
        """Chart of a response from the standard deviations of the complex gain."""
        magnitude, phase_rad = np.abs(response), np.unwrap(np.angle(response))
        half = Z95 * std / np.sqrt(2.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            half_rad = np.where(half < magnitude, np.arcsin(half / magnitude), np.pi)
        return cls(
            frequency_hz, magnitude, np.maximum(magnitude - half, 0.0), magnitude + half,
            phase_rad, phase_rad - half_rad, phase_rad + half_rad,
        )  # fmt: skip


@dataclass(frozen=True)
class NyquistChart:
    """The response in the complex plane; all `(K,)`.

    Args:
        frequency_hz: frequencies, in Hz.
        real: real part, in the unit of the output per unit of the input.
        imaginary: imaginary part.
        circle: radius of the circle that contains the response with 95 %, in the same unit.
    """

    frequency_hz: Floats
    real: Floats
    imaginary: Floats
    circle: Floats

    @classmethod
    def of(cls, frequency_hz: Floats, response: Complexes, std: Floats) -> NyquistChart:
        """Chart of a response from the standard deviations of the complex gain."""
        return cls(frequency_hz, response.real.copy(), response.imag.copy(), _RADIUS95 * std)


@dataclass(frozen=True)
class NicholsChart:
    """Magnitude in dB over phase in degrees, with 95 % intervals; all `(K,)`.

    Args:
        frequency_hz: frequencies, in Hz.
        phase_deg: phase without jumps, in degrees.
        phase_low_deg: lower end.
        phase_high_deg: upper end.
        magnitude_db: magnitude, in dB.
        magnitude_low_db: lower end; minus infinity where the magnitude may be zero.
        magnitude_high_db: upper end.
    """

    frequency_hz: Floats
    phase_deg: Floats
    phase_low_deg: Floats
    phase_high_deg: Floats
    magnitude_db: Floats
    magnitude_low_db: Floats
    magnitude_high_db: Floats

    @classmethod
    def of(cls, frequency_hz: Floats, response: Complexes, std: Floats) -> NicholsChart:
        """Chart of a response from the standard deviations of the complex gain."""
        bode = BodeChart.of(frequency_hz, response, std)
        phases = (bode.phase_rad, bode.phase_low_rad, bode.phase_high_rad)
        sizes = (bode.magnitude, bode.magnitude_low, bode.magnitude_high)
        with np.errstate(divide="ignore"):
            in_db = [np.asarray(20.0 * np.log10(size)) for size in sizes]
        first, low, high = (np.degrees(phase) for phase in phases)
        return cls(frequency_hz, first, low, high, *in_db)
