"""Data common to all sensing methods: configuration, phasors and results per block."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError

__all__ = [
    "AMPLITUDE_LOST",
    "CARRIER_OFF",
    "CLIPPED",
    "CURRENT_LIMIT",
    "NOT_FINITE",
    "PHASE_OUT",
    "REASONS",
    "Levels",
    "LockinConfig",
    "Phasors",
    "Sensed",
    "blocks_of_channels",
    "check_blocks",
    "check_channels",
    "middles_s",
    "range_reasons",
    "reason_text",
    "sensed_from_phasors",
]

Floats = NDArray[np.float64]

# The bits of core/include/hs.h.
REASONS = {
    1: "amplitude lost",
    2: "phase out of band",
    4: "clipped",
    8: "current limit",
    16: "update in the window",
    32: "not a finite number",
    64: "carrier off",
    128: "disturbed",
}
AMPLITUDE_LOST, PHASE_OUT, CLIPPED, CARRIER_OFF = 1, 2, 4, 64  # keys of REASONS
CURRENT_LIMIT, NOT_FINITE = 8, 32

# Amplitude over the standard deviation of a quadrature. Noise alone exceeds it once in 270,000
# blocks: exp(-5^2 / 2), the tail of its Rayleigh distribution.
_CLEAR_OF_NOISE = 5.0
_MOST_LEAKAGE = 0.8  # of the admittance of C, doubled: above it the two are hardly separable
_ROUNDS = 6  # each reduces the error by about 2 R G
_LARGEST_LEAD = 0.25  # tangent of the lead beyond 90 degrees that a monitor's phase error explains


_SMALLEST, _LARGEST = 1e-9, 1e15


@dataclass(frozen=True)
class LockinConfig:
    """Configuration of a sensing method.

    Args:
        rate_hz: samples per second and channel.
        block_samples: samples per block.
        carrier_hz: sensing frequency.
        skew_s: time from a voltage sample to its current sample.
        ohm_per_ratio: impedance for equal readings on both channels, in ohm:
            (V per V of the amplifier output) / (A per V) of the two monitors.
        blank: samples of each block, from the first to before the second, that are not used: from
            an output's update until amplifier and monitors have settled.
        search_updates: whether to search each block for an update at an unknown time and
            blank the affected part.
        min_amplitude_codes: amplitude below which the carrier counts as lost, in ADC codes, or in
            the unit of the readings if these are not codes.
        full_scale: a reading of this magnitude is out of the converter's range, unit of the
            readings.
        current_limit: the same for the current monitor at the amplifier's current limit.
        scale_s: admittance for equal readings, in S, with the phase between the channels corrected;
            None: from `ohm_per_ratio` and `skew_s`.
        stray_s: admittance parallel to the actuator at the carrier, in S.
        offsets: readings of both monitors at 0 V and 0 A.
    """

    rate_hz: float
    block_samples: int
    carrier_hz: float
    skew_s: float
    ohm_per_ratio: float
    blank: tuple[int, int] = (0, 0)
    search_updates: bool = False
    min_amplitude_codes: float = 5.0
    full_scale: float = float("inf")
    current_limit: float = float("inf")
    scale_s: complex | None = None
    stray_s: complex = 0j
    offsets: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("rate_hz", "block_samples", "carrier_hz", "ohm_per_ratio"):
            value = getattr(self, name)
            if not _SMALLEST <= value <= _LARGEST:
                raise InputError(
                    f"{name} = {value:g}; it must be a number above 0, from {_SMALLEST:g} to "
                    f"{_LARGEST:g}."
                )
        for name in ("full_scale", "current_limit", "min_amplitude_codes", "skew_s"):
            if np.isnan(getattr(self, name)):
                raise InputError(f"{name} is not a number.")
        low, high = self.blank
        if not 0 <= low <= high <= self.block_samples:
            raise InputError(
                f"Blanked samples [{low}, {high}) are not inside a block of {self.block_samples}. "
                "Shorten the blanking."
            )

    @property
    def block_s(self) -> float:
        """Duration of one block, in s."""
        return self.block_samples / self.rate_hz

    @property
    def omega_rad_s(self) -> float:
        """Nominal frequency of the carrier, in rad/s."""
        return 2.0 * np.pi * self.carrier_hz

    @property
    def admittance_scale_s(self) -> complex:
        """Admittance for equal readings at the nominal carrier, in S."""
        if self.scale_s is not None:
            return self.scale_s
        return complex(np.exp(-1j * self.omega_rad_s * self.skew_s) / self.ohm_per_ratio)


class _Blocks(Protocol):
    """A configuration with the length of a block."""

    @property
    def block_samples(self) -> int:
        """Samples per block."""


@dataclass(frozen=True)
class Sensed:
    """Results block by block; every array has shape `(blocks,)`.

    Args:
        time_s: middle of the samples that counted, from the first sample of the first block.
        capacitance_f: series capacitance.
        capacitance_std_f: its standard deviation, from the residual of the same block.
        resistance_ohm: series resistance.
        resistance_std_ohm: its standard deviation.
        leakage_s: conductance in parallel, in S, from the levels of both monitors; NaN if the
            method does not give it.
        leakage_std_s: its standard deviation; large at low voltage.
        phase_rad: phase of current against voltage.
        v_pp: peak-to-peak carrier on the voltage monitor, in the unit of the readings.
        i_pp: the same on the current monitor.
        valid: whether the results are valid.
        reason: why they are not, a sum of keys of `REASONS`; 0 where they are.
        seen: for blocks beyond the plain model, by index: the model that explains a valid
            block, or the disturbance of an invalid one.
    """

    time_s: Floats
    capacitance_f: Floats
    capacitance_std_f: Floats
    resistance_ohm: Floats
    resistance_std_ohm: Floats
    leakage_s: Floats
    leakage_std_s: Floats
    phase_rad: Floats
    v_pp: Floats
    i_pp: Floats
    valid: NDArray[np.bool_]
    reason: NDArray[np.uint8]
    seen: Mapping[int, str] = field(default_factory=dict)

    def model(self, block: int) -> str:
        """Name of the model of a block: "plain", or its additions to that."""
        return self.seen.get(block, "plain") if self.valid[block] else ""

    def reason_of(self, block: int) -> str:
        """Why a block is not valid, as text; empty if it is valid."""
        if self.valid[block]:
            return ""
        known, seen = reason_text(int(self.reason[block])), self.seen.get(block, "")
        return f"{known}: {seen}" if seen else known


@dataclass(frozen=True)
class Levels:
    """Levels of both monitors without the carrier; arrays of shape `(blocks,)`.

    Args:
        voltage: mean of the voltage monitor, in the unit of the readings.
        current: the same of the current monitor.
        voltage_std: standard deviation of `voltage`.
        current_std: the same of `current`.
        slope: of the voltage monitor, per s.
        slope_std: standard deviation of `slope`.
    """

    voltage: Floats
    current: Floats
    voltage_std: Floats
    current_std: Floats
    slope: Floats
    slope_std: Floats


@dataclass(frozen=True)
class Phasors:
    """The carrier on both monitors, per block; arrays of shape `(blocks,)`.

    Args:
        voltage: complex peak amplitude, in the unit of the readings.
        current: the same of the current monitor, at its own sampling instants.
        voltage_std: standard deviation of one quadrature of `voltage`.
        current_std: the same of `current`.
        omega_rad_s: frequency of the carrier.
        time_s: middle of the counted samples.
        reason: faults of the readings, a sum of keys of `REASONS`.
        levels: of both monitors, for the leakage; None if the method does not give them.
        seen: as in `Sensed`.
    """

    voltage: NDArray[np.complex128]
    current: NDArray[np.complex128]
    voltage_std: Floats
    current_std: Floats
    omega_rad_s: Floats
    time_s: Floats
    reason: NDArray[np.uint8]
    levels: Levels | None = None
    seen: Mapping[int, str] = field(default_factory=dict)


def reason_text(mask: int) -> str:
    """Text for the reasons why a block is not valid.

    Args:
        mask: of `Sensed.reason`.
    Returns:
        The reasons, joined; empty for 0.
    Example:
        >>> reason_text(6)
        'phase out of band; clipped'
    """
    return "; ".join(text for bit, text in REASONS.items() if mask & bit)


def check_blocks(readings: NDArray[np.generic], config: _Blocks) -> None:
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


def check_channels(v: NDArray[np.generic], i: NDArray[np.generic], config: _Blocks) -> None:
    """Refuse columns that are not a whole number of blocks.

    Args:
        v: voltage monitor, expected shape `(blocks * block_samples,)`.
        i: current monitor, the same shape.
        config: states `block_samples`.
    Raises:
        InputError: unequal lengths, or not a whole number of blocks.
    """
    if v.ndim != 1 or v.shape != i.shape or v.size % config.block_samples:
        raise InputError(
            f"Channels of shapes {v.shape} and {i.shape} are not two equal columns of whole blocks "
            f"of {config.block_samples} samples. Cut the record into whole blocks."
        )


def blocks_of_channels(
    v: NDArray[np.generic], i: NDArray[np.generic], config: LockinConfig
) -> Floats:
    """Two checked columns of readings as blocks, shape `(blocks, block_samples, 2)`."""
    check_channels(v, i, config)
    pairs = np.stack([v, i], axis=1).astype(np.float64, copy=False)
    return pairs.reshape(-1, config.block_samples, 2)


def range_reasons(most: Floats, config: LockinConfig) -> NDArray[np.uint8]:
    """Faults visible from the magnitude of the readings: clipped, current limit.

    Args:
        most: largest reading of either channel by magnitude, shape `(blocks, 2)`.
        config: states the limits.
    Returns:
        Sums of keys of `REASONS`, shape `(blocks,)`.
    """
    reason = np.where((most >= config.full_scale).any(axis=1), CLIPPED, 0)
    reason |= np.where(most[:, 1] >= config.current_limit, CURRENT_LIMIT, 0)
    return np.asarray(reason, dtype=np.uint8)


def middles_s(config: LockinConfig, middle_s: Floats) -> Floats:
    """Times of the blocks' middles, from those relative to each block, shape `(blocks,)`."""
    return middle_s + config.block_s * np.arange(middle_s.size, dtype=np.float64)


def sensed_from_phasors(phasors: Phasors, config: LockinConfig) -> Sensed:
    r"""Series capacitance, series resistance and leakage of each block.

    $Y = s\,I/V - Y_s,\quad 1/Y = R + 1/(G + j\omega C)$

    With equal, independent noise in both quadratures, $\sigma_V$ and $\sigma_I$, the standard
    deviation of either part of $Z = 1/Y$ is
    $|Y + Y_s|\,|Z|^2 \sqrt{\sigma_V^2/|V|^2 + \sigma_I^2/|I|^2}$.
    G is the mean current minus the charging current $C\,dV/dt$, over the mean voltage; it is
    included in C and R if it is significant and the drive is above the carrier.

    Args:
        phasors: of each block.
        config: scale, stray and the amplitude below which the carrier is lost.
    Returns:
        Results; those of an invalid block are NaN, except for its amplitudes.
    Example:
        >>> config = LockinConfig(200e3, 2000, 2000.0, 0.0, ohm_per_ratio=1e6)
        >>> one = np.ones(1)
        >>> sensed = sensed_from_phasors(
        ...     Phasors(10 * one + 0j, 20j * one, 0.01 * one, 0.02 * one, 2e3 * one, 0 * one,
        ...             np.zeros(1, np.uint8)), config)
        >>> [float(f"{x[0]:.3g}") for x in (sensed.capacitance_f, sensed.capacitance_std_f)]
        [1e-09, 1.41e-12]
    """
    voltage, current = phasors.voltage, phasors.current
    reason, whole_s = _judged(phasors, config)
    valid = reason == 0
    nan = np.full(valid.shape, np.nan)
    y = np.where(valid, whole_s - config.stray_s, complex(np.nan, np.nan))
    z = np.divide(1.0, y, out=np.full_like(y, complex(np.nan, np.nan)), where=valid)
    error = np.hypot(
        phasors.voltage_std / np.where(valid, np.abs(voltage), nan),
        phasors.current_std / np.where(valid, np.abs(current), nan),
    )
    z_std = np.abs(whole_s) * np.abs(z) ** 2 * error
    capacitance_f = -1.0 / (phasors.omega_rad_s * z.imag)
    capacitance_std_f = capacitance_f * z_std / np.abs(z.imag)
    resistance_ohm = z.real
    leakage_s = leakage_std_s = nan
    if phasors.levels is not None:
        leakage_s, leakage_std_s = _leakage(
            phasors.levels, config, capacitance_f, capacitance_std_f
        )
        # Without a drive, an offset of the monitors would look like leakage.
        driven = np.abs(phasors.levels.voltage - config.offsets[0]) > np.abs(voltage)
        clear = driven & (leakage_s > _CLEAR_OF_NOISE * leakage_std_s)
        resistive = clear & ~(2.0 * leakage_s * np.abs(z.imag) < _MOST_LEAKAGE)
        reason |= np.where(resistive, PHASE_OUT, 0).astype(np.uint8)
        valid = reason == 0
        capacitance_f, resistance_ohm = _without(
            np.where(clear & valid, leakage_s, 0.0), z, phasors.omega_rad_s
        )
        capacitance_f[resistive] = resistance_ohm[resistive] = np.nan
    return Sensed(
        time_s=phasors.time_s,
        capacitance_f=capacitance_f,
        capacitance_std_f=capacitance_std_f,
        resistance_ohm=resistance_ohm,
        resistance_std_ohm=z_std,
        leakage_s=leakage_s,
        leakage_std_s=leakage_std_s,
        phase_rad=np.where(valid, np.angle(whole_s), nan),
        v_pp=2.0 * np.abs(voltage),
        i_pp=2.0 * np.abs(current),
        valid=valid,
        reason=reason,
        seen=phasors.seen,
    )


def _judged(
    phasors: Phasors, config: LockinConfig
) -> tuple[NDArray[np.uint8], NDArray[np.complex128]]:
    """Reasons of each block, and the admittance including the stray one."""
    voltage, current = phasors.voltage, phasors.current
    floor = config.min_amplitude_codes
    there = np.abs(voltage) > np.maximum(floor, _CLEAR_OF_NOISE * phasors.voltage_std)
    there &= np.abs(current) > np.maximum(floor, _CLEAR_OF_NOISE * phasors.current_std)
    finite = np.isfinite(voltage) & np.isfinite(current)
    reason = phasors.reason | np.where(finite, 0, NOT_FINITE).astype(np.uint8)
    lost = finite & ~there & (reason & NOT_FINITE == 0)
    reason |= np.where(lost, AMPLITUDE_LOST, 0).astype(np.uint8)
    ratio = np.divide(current, voltage, out=np.full_like(voltage, np.nan), where=there & finite)
    whole_s = config.admittance_scale_s * ratio
    if config.scale_s is None:  # the phase of the skew depends on the true frequency of the block
        whole_s *= np.exp(-1j * (phasors.omega_rad_s - config.omega_rad_s) * config.skew_s)
    y = whole_s - config.stray_s
    with np.errstate(invalid="ignore"):
        plausible = (y.imag > 0.0) & (y.real > -_LARGEST_LEAD * y.imag)
    reason |= np.where(there & finite & ~plausible, PHASE_OUT, 0).astype(np.uint8)
    return reason, whole_s


def _leakage(
    levels: Levels, config: LockinConfig, capacitance_f: Floats, capacitance_std_f: Floats
) -> tuple[Floats, Floats]:
    """Parallel conductance in S and its standard deviation."""
    scale_s = abs(config.admittance_scale_s)
    volts = levels.voltage - config.offsets[0]
    charged_f = capacitance_f + config.stray_s.imag / config.omega_rad_s
    drawn = scale_s * (levels.current - config.offsets[1]) - charged_f * levels.slope
    with np.errstate(divide="ignore", invalid="ignore"):
        leakage_s = drawn / volts
        noise = (scale_s * levels.current_std) ** 2 + (leakage_s * levels.voltage_std) ** 2
        noise += (charged_f * levels.slope_std) ** 2 + (capacitance_std_f * levels.slope) ** 2
        return leakage_s, np.sqrt(noise) / np.abs(volts)


def _without(
    leakage_s: Floats, z: NDArray[np.complex128], omega_rad_s: Floats
) -> tuple[Floats, Floats]:
    """Capacitance and series resistance for a known parallel conductance.

    The level sees R + 1/G: this gives G once R is known, and R requires G.
    """
    x, g = -z.imag, leakage_s
    resistance_ohm = z.real
    for _ in range(_ROUNDS):
        with np.errstate(invalid="ignore"):
            susceptance_s = (1.0 + np.sqrt(1.0 - (2.0 * g * x) ** 2)) / (2.0 * x)
        resistance_ohm = z.real - g / (g**2 + susceptance_s**2)
        g = leakage_s / (1.0 - leakage_s * resistance_ohm)
    return susceptance_s / omega_rad_s, resistance_ohm
