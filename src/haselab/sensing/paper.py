"""The reference study's own method: Butterworth, mean of the periods, peak to peak, phase."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab import _sense
from haselab.base import InputError
from haselab.sensing.sensed import (
    LockinConfig,
    Phasors,
    Sensed,
    blocks_of_channels,
    check_blocks,
    middles_s,
    range_reasons,
    sensed_from_phasors,
)

__all__ = ["PaperChain"]

_CUTOFF_HZ = 2001.0
_ORDER = 4
_RESULT = _sense.PAPER_RESULT  # of a channel, by name: native/sensing/paper.h


class PaperChain:
    r"""Rows S6 to S9 as printed, for comparison; the lock-in is better in every respect.

    Both monitors pass a low-pass whose state is kept from block to block. The periods of a block
    are averaged into one; its peak-to-peak values are the amplitudes, the angle between the
    fundamentals of its two channels is the phase: $Z = k\,(V_{pp}/I_{pp})\,e^{-j\varphi}$.

    The low-pass reduces both amplitudes by 3 dB if its cut-off is the carrier; capacitance and
    phase are not affected. A drive that ramps remains in the average of the periods and
    biases the result; the standard deviation, from the scatter of the periods, does not include
    this.

    Args:
        config: see `LockinConfig`; blanking and the search for updates are not supported.
        cutoff_hz: of the low-pass.
    Raises:
        InputError: a period is not a whole number of samples, a block is not at least two
            whole periods, or samples are blanked.
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
                f"The paper's method averages whole periods, but there are {period:g} samples per "
                f"period and {periods:g} periods per block. Use a block of whole periods, or the "
                "lock-in."
            )
        if config.blank[1] > config.blank[0]:
            raise InputError(
                f"The paper's method cannot blank {config.blank[1] - config.blank[0]} samples of a "
                "block. Use the lock-in."
            )
        if not 0.0 < cutoff_hz < 0.5 * config.rate_hz:
            raise InputError(
                f"Cut-off = {cutoff_hz:g} Hz is outside (0, {0.5 * config.rate_hz:g}) Hz. Lower it."
            )
        from scipy import signal  # the import takes half a second

        sections = signal.butter(_ORDER, cutoff_hz, fs=config.rate_hz, output="sos")
        turn = 2.0 * np.pi * np.arange(self._period_samples) / self._period_samples
        wave = np.concatenate([np.cos(turn), np.sin(turn)]) * (2.0 / self._period_samples)
        self._native = _sense.Paper(sections, signal.sosfilt_zi(sections), wave)

    def sense(self, readings: NDArray[Any]) -> Sensed:
        """Process the next blocks; the filter keeps its state between calls.

        Args:
            readings: shape `(blocks, block_samples, 2)`, voltage then current.
        Returns:
            Results, arrays of shape `(blocks,)`; amplitudes in the unit of the readings, after
            the low-pass.
        Raises:
            InputError: the shape does not fit the configuration.
        """
        check_blocks(readings, self.config)
        blocks = np.ascontiguousarray(readings, dtype=np.float64)
        rows = np.empty((len(blocks), 2), _RESULT)
        self._native.step(blocks, rows)
        angle = np.arctan2(rows["im"], rows["re"])
        phasors = np.asarray(0.5 * rows["peak_to_peak"] * np.exp(1j * angle), dtype=np.complex128)
        voltage, current = phasors.T
        voltage_std, current_std = np.sqrt(rows["scatter"]).T
        middle_s = 0.5 * (self.config.block_samples - 1) / self.config.rate_hz
        return sensed_from_phasors(
            Phasors(
                voltage=voltage,
                current=current,
                voltage_std=voltage_std,
                current_std=current_std,
                omega_rad_s=np.full(len(rows), self.config.omega_rad_s),
                time_s=middles_s(self.config, np.full(len(rows), middle_s)),
                reason=range_reasons(rows["most"], self.config),
            ),
            self.config,
        )

    def sense_channels(self, v: NDArray[Any], i: NDArray[Any]) -> Sensed:
        """Process the next blocks from two columns, each of shape `(blocks * block_samples,)`."""
        return self.sense(blocks_of_channels(v, i, self.config))
