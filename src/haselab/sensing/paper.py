"""The reference study's own chain: Butterworth, mean of the periods, peak to peak, phase."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from haselab.base import InputError
from haselab.sensing.sensed import (
    LockinConfig,
    Phasors,
    Sensed,
    check_blocks,
    sensed_from_phasors,
)

__all__ = ["PaperChain"]

_CUTOFF_HZ = 2001.0
_ORDER = 4


class PaperChain:
    r"""Rows S6 to S9 as printed, to compare with; the lock-in is better in every respect.

    Both monitors pass a low-pass whose state goes on from block to block. The periods of a block
    are averaged into one; its peak-to-peak values are the amplitudes, the angle between the
    fundamentals of its two channels is the phase: $Z = k\,(V_{pp}/I_{pp})\,e^{-j\varphi}$.

    The low-pass takes 3 dB from both amplitudes where its cut-off is the carrier; capacitance and
    phase are not touched by it. A drive that ramps stays in the average of the periods and
    biases the result, which the standard deviation, from the scatter of the periods, cannot tell.

    Args:
        config: see `LockinConfig`; `first_sample` must be 0, the chain knows no blanking.
        cutoff_hz: of the low-pass.
    Raises:
        InputError: a period is not a whole number of samples, a block not one of at least two
            periods, or samples are blanked.
    Source: reference study, rows S6 to S9.
    Example:
        >>> angle = 2 * np.pi * 2000.0 * np.arange(20 * 2000) / 200e3
        >>> record = np.stack([np.cos(angle), 2 * np.cos(angle + np.pi / 2)], axis=1)
        >>> chain = PaperChain(LockinConfig(200e3, 2000, 2000.0, 0.0, 1e6, min_amplitude_codes=0.1))
        >>> sensed = chain.sense(record.reshape(20, 2000, 2))
        >>> round(float(sensed.capacitance_f[-1]) * 2 * np.pi * 2000.0 * 500e3, 3)
        1.0
    """

    def __init__(self, config: LockinConfig, *, cutoff_hz: float = _CUTOFF_HZ) -> None:
        self.config = config
        period = config.rate_hz / config.carrier_hz
        self._period_samples = round(period)
        whole = abs(period - self._period_samples) < 1e-9 * period and self._period_samples >= 3
        periods = config.block_samples / period
        if not whole or config.block_samples % self._period_samples or periods < 2:
            raise InputError(
                f"The paper's chain folds whole periods, got {period:g} samples a period and "
                f"{periods:g} periods a block. Take a block of whole periods, or the lock-in."
            )
        if config.first_sample:
            raise InputError(
                f"The paper's chain cannot blank {config.first_sample} samples of a block, only 0. "
                "Take the lock-in."
            )
        if not 0.0 < cutoff_hz < 0.5 * config.rate_hz:
            raise InputError(
                f"Cut-off = {cutoff_hz:g} Hz is outside (0, {0.5 * config.rate_hz:g}) Hz. Lower it."
            )
        self._sections = signal.butter(_ORDER, cutoff_hz, fs=config.rate_hz, output="sos")
        self._state: NDArray[np.float64] | None = None

    def sense(self, readings: NDArray[np.int16] | NDArray[np.float64]) -> Sensed:
        """The next blocks; the filter goes on where the last call left it.

        Args:
            readings: shape `(blocks, block_samples, 2)`, voltage then current.
        Returns:
            Results, arrays of shape `(blocks,)`; amplitudes in the unit of the readings, after
            the low-pass.
        Raises:
            InputError: the shape does not fit the configuration.
        """
        check_blocks(readings, self.config)
        record = readings.reshape(-1, 2).astype(np.float64)
        if self._state is None:
            rest = signal.sosfilt_zi(self._sections)
            self._state = rest[:, :, np.newaxis] * record[0]
        filtered, self._state = signal.sosfilt(self._sections, record, axis=0, zi=self._state)
        periods = filtered.reshape(len(readings), -1, self._period_samples, 2)
        return self._results(periods)

    def _results(self, periods: NDArray[np.float64]) -> Sensed:
        mean_period = periods.mean(axis=1)
        peak = 0.5 * np.ptp(mean_period, axis=1)
        angle = np.angle(np.fft.rfft(mean_period, axis=1)[:, 1, :])
        std = _quadrature_std(periods)
        return sensed_from_phasors(
            Phasors(
                voltage=peak[:, 0] * np.exp(1j * angle[:, 0]),
                current=peak[:, 1] * np.exp(1j * angle[:, 1]),
                voltage_std=std[:, 0],
                current_std=std[:, 1],
                omega_rad_s=np.full(len(periods), 2.0 * np.pi * self.config.carrier_hz),
            ),
            self.config,
        )


def _quadrature_std(periods: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviation of one quadrature of a block's mean period, shape `(blocks, 2)`."""
    count, samples = periods.shape[1:3]
    turn = np.exp(-2j * np.pi * np.arange(samples) / samples)
    fundamental = np.einsum("bpsc,s->bpc", periods, turn) * (2.0 / samples)
    return np.asarray(fundamental.std(axis=1, ddof=1) / np.sqrt(2.0 * count), dtype=np.float64)
