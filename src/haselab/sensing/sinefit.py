"""Sine fit with unknown frequency, for a carrier whose frequency is not known exactly."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.sensing.sensed import (
    Levels,
    LockinConfig,
    Phasors,
    Sensed,
    blocks_of_channels,
    check_blocks,
    middles_s,
    range_reasons,
    sensed_from_phasors,
)

__all__ = ["SineFit"]

_MAX_ITERATIONS = 12
_TOLERANCE_RAD = 1e-9  # change of the phase at a block's end, far below the noise of any converter
_CARRIER_OFF = 64
_FIT = np.dtype([
    ("voltage", complex), ("current", complex), ("voltage_std", float), ("current_std", float),
    ("omega_rad_s", float), ("levels", float, len(fields(Levels))),
])  # fmt: skip
_NOT_SETTLED = np.array([(np.nan,) * len(_FIT.names or ())], _FIT)


@dataclass(frozen=True)
class _Channel:
    """One channel at one trial frequency, with its frequency correction."""

    phasor: complex
    level: float
    slope: float
    noise: float
    step_rad_s: float
    step_variance: float


class SineFit:
    r"""Sine fit of both monitors with one common frequency, for each block.

    $x = a\cos\omega t + b\sin\omega t + c + d\,t$, with $\omega$ refined by Gauss-Newton from
    the nominal carrier. Each channel gives a correction of $\omega$; the two are averaged with
    the weights of their variances. The slope $d$ removes the drive's ramp; where samples are
    blanked, each side has its own level. A block whose frequency leaves the main lobe
    ($\pm 1$ period per block) or does not converge is not valid.

    Args:
        config: see `LockinConfig`; `carrier_hz` is where the search starts. Updates at an unknown
            time are not searched for.
        parameters: 4 refines the frequency, 3 keeps it.
    Raises:
        InputError: fewer than two carrier periods count, or the carrier is above a third of the
            sampling rate.
    Source: IEEE Std 1057, three- and four-parameter sine fit, with a slope and over two channels.
    Example:
        >>> angle = 2 * np.pi * 2003.0 * np.arange(2000) / 200e3  # 3 Hz beside the nominal
        >>> block = np.stack([np.cos(angle), 2 * np.cos(angle + np.pi / 2)], axis=1)
        >>> fit = SineFit(LockinConfig(200e3, 2000, 2000.0, 0.0, 1e6, min_amplitude_codes=0.1))
        >>> round(float(fit.sense(block[np.newaxis]).capacitance_f[0]) * 2 * np.pi * 2003 * 5e5, 6)
        1.0
        >>> round(float(fit.frequencies_hz(block[np.newaxis])[0]), 6)
        2003.0
    """

    def __init__(self, config: LockinConfig, *, parameters: Literal[3, 4] = 4) -> None:
        self.config = config
        low, high = config.blank
        kept = np.r_[0:low, high : config.block_samples]
        periods = kept.size * config.carrier_hz / config.rate_hz
        if not (periods >= 2.0 and config.carrier_hz <= config.rate_hz / 3.0 and kept.size >= 8):
            raise InputError(
                f"Sine fit at {config.carrier_hz:g} Hz has {periods:g} periods in {kept.size} "
                f"samples of {config.rate_hz:g} Hz; at least 2 periods and a carrier up to "
                f"{config.rate_hz / 3:g} Hz are required. Lengthen the block, or sample faster."
            )
        self._refine = parameters == 4
        self._kept = kept
        self._middle_s = float(kept.mean()) / config.rate_hz
        self._time_s = kept / config.rate_hz - self._middle_s
        self._used_s = float(np.ptp(kept) + 1) / config.rate_hz
        columns = [np.ones(kept.size), self._time_s / self._used_s]
        if 0 < low < high < config.block_samples:
            after = (kept >= high).astype(np.float64)
            columns.append(after - after.mean())
        self._drift = np.stack(columns, axis=1)

    def sense(self, readings: NDArray[Any]) -> Sensed:
        """Capacitance and resistance of many blocks.

        Args:
            readings: shape `(blocks, block_samples, 2)`, voltage then current.
        Returns:
            Results, arrays of shape `(blocks,)`; amplitudes in the unit of the readings.
        Raises:
            InputError: the shape does not fit the configuration.
        """
        return sensed_from_phasors(self._fit(readings), self.config)

    def sense_channels(self, v: NDArray[Any], i: NDArray[Any]) -> Sensed:
        """Capacitance and resistance from two columns of shape `(blocks * block_samples,)`."""
        return self.sense(blocks_of_channels(v, i, self.config))

    def frequencies_hz(self, readings: NDArray[Any]) -> NDArray[np.float64]:
        """The refined frequency of each block.

        Args:
            readings: shape `(blocks, block_samples, 2)`, voltage then current.
        Returns:
            Frequencies in Hz, shape `(blocks,)`; NaN where the fit did not converge.
        Raises:
            InputError: the shape does not fit the configuration.
        """
        return self._fit(readings).omega_rad_s / (2.0 * np.pi)

    def _fit(self, readings: NDArray[Any]) -> Phasors:
        check_blocks(readings, self.config)
        rows = np.repeat(_NOT_SETTLED, len(readings))
        most = np.empty((len(readings), 2))
        for k, block in enumerate(readings.astype(np.float64, copy=False)):
            most[k] = np.abs(block).max(axis=0)
            if np.isfinite(most[k]).all():
                rows[k] = self._fit_block(block[self._kept]) or _NOT_SETTLED[0]
        reason = range_reasons(most, self.config)
        unsettled = np.isnan(rows["voltage"].real) & np.isfinite(most).all(axis=1)
        return Phasors(
            # A search without convergence sets the reason, not NaN; the phasor is 0.
            voltage=np.where(unsettled, 0.0, rows["voltage"]),
            current=np.where(unsettled, 0.0, rows["current"]),
            voltage_std=rows["voltage_std"],
            current_std=rows["current_std"],
            omega_rad_s=rows["omega_rad_s"],
            time_s=middles_s(self.config, np.full(len(readings), self._middle_s)),
            reason=reason | np.where(unsettled, _CARRIER_OFF, 0).astype(np.uint8),
            levels=Levels(*rows["levels"].T),
        )

    def _fit_block(self, block: NDArray[np.float64]) -> tuple[Any, ...] | None:
        """A row of `_FIT`; None where the frequency does not settle."""
        nominal_rad_s = omega_rad_s = self.config.omega_rad_s
        reach_rad_s = 2.0 * np.pi / self._used_s
        for _ in range(_MAX_ITERATIONS):
            voltage, current, inverse = self._channels(block, omega_rad_s)
            step_rad_s = _combine(voltage, current) if self._refine else 0.0
            if abs(step_rad_s) * self._used_s < _TOLERANCE_RAD:
                quadrature = 0.5 * (inverse[0, 0] + inverse[1, 1])
                return (
                    voltage.phasor,
                    current.phasor,
                    (quadrature * voltage.noise) ** 0.5,
                    (quadrature * current.noise) ** 0.5,
                    omega_rad_s,
                    (
                        voltage.level,
                        current.level,
                        (inverse[2, 2] * voltage.noise) ** 0.5,
                        (inverse[2, 2] * current.noise) ** 0.5,
                        voltage.slope,
                        (inverse[3, 3] * voltage.noise) ** 0.5 / self._used_s,
                    ),
                )
            omega_rad_s += step_rad_s
            if not abs(omega_rad_s - nominal_rad_s) < reach_rad_s:
                break
        return None

    def _channels(
        self, block: NDArray[np.float64], omega_rad_s: float
    ) -> tuple[_Channel, _Channel, NDArray[np.float64]]:
        cosine, sine = np.cos(omega_rad_s * self._time_s), np.sin(omega_rad_s * self._time_s)
        basis = np.concatenate([cosine[:, np.newaxis], sine[:, np.newaxis], self._drift], axis=1)
        inverse = np.linalg.inv(basis.T @ basis)
        parameters = inverse @ (basis.T @ block)
        residual = block - basis @ parameters
        variance = (residual**2).sum(axis=0) / (len(block) - basis.shape[1] - 1)
        # d x / d omega, orthogonal to the basis, so omega becomes one more column.
        ramp = self._drift[:, 1:2]
        slopes = ramp * (cosine[:, np.newaxis] * parameters[1])
        slopes -= ramp * (sine[:, np.newaxis] * parameters[0])
        slopes -= basis @ (inverse @ (basis.T @ slopes))
        energy = (slopes**2).sum(axis=0)
        step = (slopes * residual).sum(axis=0) / np.where(energy > 0.0, energy, np.inf)
        spread = variance / np.where(energy > 0.0, energy, np.nan)
        voltage, current = (
            _Channel(
                complex(parameters[0, k], -parameters[1, k]),
                float(parameters[2, k]),
                float(parameters[3, k] / self._used_s),
                float(variance[k]),
                float(step[k] / self._used_s),
                float(spread[k]),
            )
            for k in (0, 1)
        )
        return voltage, current, inverse


def _combine(voltage: _Channel, current: _Channel) -> float:
    """Correction of the common frequency; NaN where a channel has no signal."""
    total = voltage.step_variance + current.step_variance
    if total == 0.0:  # both channels without noise have equal weight
        return 0.5 * (voltage.step_rad_s + current.step_rad_s)
    return (
        voltage.step_rad_s * current.step_variance + current.step_rad_s * voltage.step_variance
    ) / total
