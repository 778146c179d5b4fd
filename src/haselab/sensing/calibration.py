"""Absolute calibration against reference capacitors: complex scale and stray admittance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, ResultError
from haselab.sensing.lockin import Lockin
from haselab.sensing.sensed import (
    AMPLITUDE_LOST,
    CARRIER_OFF,
    CLIPPED,
    PHASE_OUT,
    LockinConfig,
    reason_text,
)

__all__ = [
    "Calibration",
    "Reference",
    "ReferenceReading",
    "fit_calibration",
    "read_reference",
]

Complexes = NDArray[np.complex128]
Floats = NDArray[np.float64]

_FEWEST_BLOCKS = 8  # their scatter gives the noise of the mean to 25 %
_LEAST_SHARE = 0.75  # of the blocks must be valid; occasional disturbances are allowed
_CLEAR = 5.0  # standard deviations of a significant difference
_SAME_CARRIER = 1e-6  # relative; a generator's own error is a few parts in a million
_LOOP_ROUNDS = 3  # iterations of the weights, which depend on the scale; two suffice


@dataclass(frozen=True)
class Reference:
    r"""A known capacitor: $Y = 1/(R + 1/j\omega C)$.

    Args:
        capacitance_f: its value at the carrier.
        series_ohm: its loss.
        tolerance: relative half-width of the value's tolerance; 0: exact.
    Raises:
        InputError: a capacitance that is not positive, a negative loss, a tolerance outside [0, 1).
    Example:
        >>> f"{Reference(1e-9).admittance_s(2000.0).imag:.3e}"
        '1.257e-05'
    """

    capacitance_f: float
    series_ohm: float = 0.0
    tolerance: float = 0.0

    def __post_init__(self) -> None:
        if not (
            0.0 < self.capacitance_f < 1.0
            and 0.0 <= self.series_ohm < math.inf
            and 0.0 <= self.tolerance < 1.0
        ):
            raise InputError(
                f"Reference of {self.capacitance_f:g} F, {self.series_ohm:g} ohm, tolerance "
                f"{self.tolerance:g}; they must be in (0, 1) F, 0 ohm or more, and in [0, 1). "
                "State the capacitance in F, for example 1e-9 for 1 nF."
            )

    def admittance_s(self, carrier_hz: float) -> complex:
        """Admittance at a frequency, in S."""
        omega = 2.0 * math.pi * carrier_hz
        return 1.0 / (self.series_ohm + 1.0 / (1j * omega * self.capacitance_f))

    def tolerance_s(self, carrier_hz: float) -> complex:
        r"""Change of the admittance by one standard deviation of the value, in S.

        $dY/dC = j\omega (Y/j\omega C)^2$; a half-width is $\sqrt3$ standard deviations of a
        uniform distribution.
        """
        omega = 2.0 * math.pi * carrier_hz
        per_farad = self.admittance_s(carrier_hz) ** 2 / (1j * omega * self.capacitance_f**2)
        return per_farad * self.capacitance_f * self.tolerance / math.sqrt(3.0)


@dataclass(frozen=True)
class ReferenceReading:
    """Reading of both monitors with one reference connected.

    Args:
        ratio: current over voltage reading at the carrier, complex.
        ratio_std: standard deviation of one quadrature of `ratio`.
        offsets_v: mean of both channels, drive at 0 V.
    """

    ratio: complex
    ratio_std: float
    offsets_v: tuple[float, float]


@dataclass(frozen=True)
class Calibration:
    r"""Conversion of readings to admittance: $Y = a\,I/V - Y_s$.

    $a$ includes the monitors' gains, the phase between them and the channels' skew; $Y_s$ is the
    admittance parallel to the actuator. Factors common to both monitors, such as the amplifier's
    phase and gain, are not included, because they cancel in $I/V$.

    Args:
        scale_s: $a$, in S for equal readings.
        stray_s: $Y_s$.
        offsets_v: readings of both monitors at 0 V and 0 A.
        carrier_hz: carrier for which it is valid.
        rate_hz: sampling rate of the converter; a multiplexer's skew depends on it.
        amplifier: amplifier for which it is valid.
        date: when the references were measured, ISO 8601.
        references: references that were used.
        readings: readings of the references, in the same order.
        residual: relative rms residual over the references; 0 with two references.
        scale_std_s: standard deviation of `scale_s` from noise and tolerances, along its magnitude.
    """

    scale_s: complex
    stray_s: complex
    offsets_v: tuple[float, float]
    carrier_hz: float
    rate_hz: float
    amplifier: str
    date: str
    references: tuple[Reference, ...]
    readings: tuple[ReferenceReading, ...]
    residual: float
    scale_std_s: float

    @property
    def stray_f(self) -> float:
        """The stray admittance as a capacitance."""
        return self.stray_s.imag / (2.0 * math.pi * self.carrier_hz)

    def apply(
        self, config: LockinConfig, *, amplifier: str, volt_per_reading: float = 1.0
    ) -> LockinConfig:
        """The configuration with scale, stray and offsets of this calibration.

        Args:
            config: configuration of the sensing method.
            amplifier: amplifier whose monitors are read.
            volt_per_reading: 1 for readings in volts, else volts of one ADC code.
        Returns:
            The completed configuration.
        Raises:
            InputError: another carrier, sampling rate or amplifier.
        """
        for name, here, there in (
            ("carrier", config.carrier_hz, self.carrier_hz),
            ("rate", config.rate_hz, self.rate_hz),
        ):
            if abs(here - there) > _SAME_CARRIER * there:
                raise InputError(
                    f"The calibration of {self.date} is for a {name} of {there:g} Hz, not "
                    f"{here:g} Hz. Sense at {there:g} Hz, or calibrate again."
                )
        if amplifier != self.amplifier:
            raise InputError(
                f"The calibration of {self.date} is for the amplifier {self.amplifier!r}, not "
                f"{amplifier!r}. Calibrate this amplifier."
            )
        volt_v, ampere_v = self.offsets_v
        return replace(
            config,
            scale_s=self.scale_s,
            stray_s=self.stray_s,
            offsets=(volt_v / volt_per_reading, ampere_v / volt_per_reading),
        )

    def capacitance_f(self, ratio: complex) -> float:
        """Series capacitance for a ratio of the current reading to the voltage reading."""
        impedance = 1.0 / (self.scale_s * ratio - self.stray_s)
        return -1.0 / (2.0 * math.pi * self.carrier_hz * impedance.imag)

    def capacitance_std_f(self, capacitance_f: float, series_ohm: float = 0.0) -> float:
        """Standard deviation due to the calibration: noise and tolerances of the references.

        The noise of the measurement itself is not included.

        Args:
            capacitance_f: measured capacitance.
            series_ohm: measured series resistance.
        Returns:
            Standard deviation in F, the same for all measurements with this calibration.
        """
        y = Reference(capacitance_f, series_ohm).admittance_s(self.carrier_hz)
        noise, known = self._errors((y + self.stray_s) / self.scale_s)
        turn = 1.0 / y**2  # dZ = -dY / Y^2, and C = -1 / (omega Im Z)
        variance = float(np.sum(np.imag(known * turn) ** 2))
        variance += float(np.sum(np.abs(noise * turn) ** 2))
        return capacitance_f * math.sqrt(variance) / abs((1.0 / y).imag)

    def _errors(self, ratio: complex) -> tuple[Complexes, Complexes]:
        """Error of Y at a ratio from each reference: noise (any phase), tolerance."""
        noise_s, known_s = _spreads(self.references, self.readings, self.carrier_hz, self.scale_s)
        inverse = _inverse(self.readings, noise_s, known_s)
        weight = ratio * inverse[0] - inverse[1]
        return weight * noise_s, weight * known_s


def read_reference(
    readings: NDArray[np.int16] | NDArray[np.float64],
    *,
    rate_hz: float,
    carrier_hz: float,
    volt_per_reading: float = 1.0,
    full_scale: float | None = None,
) -> ReferenceReading:
    """Read a reference: mean over valid blocks, with noise from their scatter.

    Args:
        readings: at 0 V drive, carrier on, settled. Shape `(blocks, block_samples, 2)`.
        rate_hz: samples per second and channel.
        carrier_hz: sensing frequency.
        volt_per_reading: 1 for volts, else volts of one ADC code.
        full_scale: a reading of this magnitude or more is clipped; None: the last code of 16 bits
            for codes, no limit for volts.
    Returns:
        The reading.
    Raises:
        InputError: fewer than 8 blocks, or a wrong shape.
        ResultError: more than a quarter of the blocks are not valid.
    Example:
        >>> angle = 2 * np.pi * 2000.0 * np.arange(16000) / 200e3
        >>> noise = 1e-3 * np.random.default_rng(1).standard_normal((16000, 2))
        >>> record = np.stack([np.cos(angle), -0.5 * np.sin(angle)], axis=1) + noise
        >>> reading = read_reference(record.reshape(8, 2000, 2), rate_hz=200e3, carrier_hz=2000.0)
        >>> f"{reading.ratio:.3f}"
        '0.000+0.500j'
    """
    if readings.ndim != 3 or len(readings) < _FEWEST_BLOCKS:
        raise InputError(
            f"Readings of shape {readings.shape}; they must be at least {_FEWEST_BLOCKS} blocks, "
            "(blocks, block_samples, 2). Record the reference for longer."
        )
    if full_scale is None:
        full_scale = np.iinfo(np.int16).max if readings.dtype == np.int16 else math.inf
    config = LockinConfig(
        rate_hz=rate_hz,
        block_samples=readings.shape[1],
        carrier_hz=carrier_hz,
        skew_s=0.0,
        ohm_per_ratio=1.0,
        min_amplitude_codes=1e-6 / volt_per_reading,
        full_scale=full_scale,
    )
    sensed = Lockin(config).sense(readings)
    good = sensed.valid
    if good.sum() < max(_FEWEST_BLOCKS, _LEAST_SHARE * len(readings)):
        raise ResultError(
            f"{int((~good).sum())} of {len(readings)} blocks "
            f"{_unusable(sensed.reason[~good], carrier_hz)}"
        )
    ratios = (sensed.i_pp / sensed.v_pp * np.exp(1j * sensed.phase_rad))[good]
    scatter = float(np.sqrt(0.5 * np.var(ratios, ddof=1)))  # of one quadrature
    volt_v, ampere_v = readings[good].mean(axis=(0, 1), dtype=np.float64) * volt_per_reading
    return ReferenceReading(
        complex(ratios.mean()), scatter / math.sqrt(len(ratios)), (float(volt_v), float(ampere_v))
    )


def _unusable(reasons: NDArray[np.integer[Any]], carrier_hz: float) -> str:
    """What is wrong with most of the blocks that are not valid, and what to check."""
    values, counts = np.unique(reasons, return_counts=True)
    most = int(values[np.argmax(counts)])
    if most & (AMPLITUDE_LOST | CARRIER_OFF):
        return (
            f"show no carrier at {carrier_hz:g} Hz on both monitors. Check the generator and the "
            "reference's leads."
        )
    if most & PHASE_OUT:
        return (
            "have a phase between the monitors that no capacitor has. Check the polarity of the "
            "monitors, that their channels are not swapped, and the reference's leads."
        )
    if most & CLIPPED:
        return "are clipped. Lower the amplitude of the carrier, or use a smaller reference."
    return f"cannot be used ({reason_text(most)}). Check the generator and the reference's leads."


def fit_calibration(
    references: Sequence[Reference],
    readings: Sequence[ReferenceReading],
    *,
    carrier_hz: float,
    rate_hz: float,
    amplifier: str,
    date: str,
) -> Calibration:
    r"""Scale and stray admittance from two or more reference capacitors.

    $Y_k = a\,r_k - Y_s$ is linear in $a$ and $Y_s$; with more than two references it is solved by
    least squares, each weighted by its noise and tolerance.

    Args:
        references: the connected capacitors, two or more that differ.
        readings: the readings of each.
        carrier_hz: sensing frequency.
        rate_hz: samples per second and channel.
        amplifier: amplifier whose monitors were read.
        date: date of the measurement, ISO 8601.
    Returns:
        The calibration.
    Raises:
        InputError: fewer than two references, or references that are equal within noise and
            tolerances.
        ResultError: the residual is much larger than noise and tolerances explain.
    Example:
        >>> known = [Reference(0.5e-9), Reference(2e-9)]
        >>> truth = [(r.admittance_s(2e3) + 1e-6j) / 4e-7 for r in known]
        >>> c = fit_calibration(known, [ReferenceReading(y, 1e-6, (0.0, 0.0)) for y in truth],
        ...                     carrier_hz=2e3, rate_hz=2e5, amplifier="", date="2026-01-01")
        >>> f"{abs(c.scale_s):.3e}", f"{c.stray_s.imag:.3e}"
        ('4.000e-07', '1.000e-06')
    """
    _check_pairs(references, readings)
    _check_read_apart(references, readings)
    known = np.array([r.admittance_s(carrier_hz) for r in references])
    ratios = np.array([r.ratio for r in readings])
    design = np.stack([ratios, -np.ones_like(ratios)], axis=1)
    scale_s = complex(np.linalg.lstsq(design, known, rcond=None)[0][0])
    for _ in range(_LOOP_ROUNDS):
        noise_s, known_s = _spreads(references, readings, carrier_hz, scale_s)
        inverse = _inverse(readings, noise_s, known_s)
        scale_s, stray_s = (complex(x) for x in inverse @ known)
    left = design @ np.array([scale_s, stray_s]) - known
    _check_apart(references, known, np.hypot(noise_s, np.abs(known_s)))
    _check_residual(references, left, np.hypot(noise_s, np.abs(known_s)))
    along = inverse[0] * np.exp(-1j * np.angle(scale_s))
    spread = np.sum((np.abs(along) * noise_s) ** 2) + np.sum(np.real(along * known_s) ** 2)
    volt_v, ampere_v = np.mean([r.offsets_v for r in readings], axis=0)
    return Calibration(
        scale_s=scale_s,
        stray_s=stray_s,
        offsets_v=(float(volt_v), float(ampere_v)),
        carrier_hz=carrier_hz,
        rate_hz=rate_hz,
        amplifier=amplifier,
        date=date,
        references=tuple(references),
        readings=tuple(readings),
        residual=float(np.sqrt(np.mean(np.abs(left / known) ** 2))) if len(known) > 2 else 0.0,
        scale_std_s=float(np.sqrt(spread)),
    )


def _spreads(
    references: Sequence[Reference],
    readings: Sequence[ReferenceReading],
    carrier_hz: float,
    scale_s: complex,
) -> tuple[Floats, Complexes]:
    """Standard deviations of each reference, in S: noise of one quadrature, and tolerance."""
    noise_s = abs(scale_s) * np.array([r.ratio_std for r in readings])
    return noise_s, np.array([r.tolerance_s(carrier_hz) for r in references])


def _inverse(
    readings: Sequence[ReferenceReading], noise_s: Floats, known_s: Complexes
) -> Complexes:
    """Matrix from the known admittances to scale and stray (rows), by weighted least squares."""
    spread = np.hypot(noise_s, np.abs(known_s))
    weight = 1.0 / np.maximum(spread, 1e-12 * max(float(spread.max()), 1e-30))
    weight /= weight.max()
    ratios = np.array([r.ratio for r in readings])
    design = np.stack([ratios, -np.ones_like(ratios)], axis=1)
    return np.asarray(np.linalg.pinv(weight[:, np.newaxis] * design) * weight)


def _check_pairs(references: Sequence[Reference], readings: Sequence[ReferenceReading]) -> None:
    if len(references) != len(readings):
        raise InputError(
            f"{len(references)} references and {len(readings)} readings; there must be one reading "
            "for each. Measure every reference once."
        )
    if len(references) < 2:
        raise InputError(
            f"{len(references)} reference capacitor(s); scale and stray require at least 2 that "
            "differ. Add another one."
        )


def _check_read_apart(
    references: Sequence[Reference], readings: Sequence[ReferenceReading]
) -> None:
    """Refuse references whose readings are equal within noise."""
    ratios = np.array([r.ratio for r in readings])
    noise = np.array([r.ratio_std for r in readings])
    if not _some_apart(ratios, noise):
        listed = ", ".join(f"{r.capacitance_f:g}" for r in references)
        raise InputError(
            f"The references ({listed} F) have equal readings within noise; scale and stray "
            "require two that differ. Check that each was connected in turn."
        )


def _some_apart(values: Complexes, std: Floats) -> bool:
    """Whether two of the values differ by more than their standard deviations and rounding."""
    apart = np.abs(values[:, np.newaxis] - values)
    unsure = np.hypot(std[:, np.newaxis], std)
    return bool(np.any(apart > np.maximum(_CLEAR * unsure, 1e-9 * np.abs(values).max())))


def _check_apart(references: Sequence[Reference], known: Complexes, spread: Floats) -> None:
    """Refuse references that are equal within their uncertainty."""
    if not _some_apart(known, spread):
        listed = ", ".join(f"{r.capacitance_f:g}" for r in references)
        raise InputError(
            f"The references ({listed} F) are equal within noise and tolerance; scale and stray "
            "require two that differ. Add one with a different value."
        )


def _check_residual(references: Sequence[Reference], left: Complexes, spread: Floats) -> None:
    """Refuse a fit in which the references contradict each other."""
    free = 2 * (len(left) - 2)
    if free == 0:
        return
    weighted = np.abs(left) / np.maximum(spread, 1e-300)
    factor = math.sqrt(float(np.sum(weighted**2)) / free)
    if factor > _CLEAR:
        worst = references[int(np.argmax(weighted))]
        raise ResultError(
            f"The references contradict each other {factor:.3g} times more than noise and "
            f"tolerance explain (the limit is {_CLEAR:g}); the worst is {worst.capacitance_f:g} F. "
            "Check its value and leads, or specify its tolerance."
        )
