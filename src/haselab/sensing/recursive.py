"""Recursive least squares with forgetting: capacitance more often than once a block."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab import _sense
from haselab.base import InputError
from haselab.sensing.block.plan import make_plan
from haselab.sensing.lockin import as_readings
from haselab.sensing.sensed import (
    Levels,
    LockinConfig,
    Phasors,
    Sensed,
    check_blocks,
    sensed_from_phasors,
)

__all__ = ["Recursive"]

_COLUMNS = 14


class Recursive:
    r"""Recursive least squares over sine, cosine, level and slope, the past fading exponentially.

    Each block minimises $\sum_k \lambda^{n-k} \sum_{t \in k} (x - \hat x)^2$ over all blocks so
    far, with $\lambda = e^{-T/\tau}$: the weight is constant inside a block. A step of C is met
    with the time constant $\tau$; the variance is that of about $2\tau$ of readings.

    Args:
        config: see `LockinConfig`; a block is what comes between two results, one carrier period
            at least, and neither blanking nor a search is known.
        memory_s: the time constant of forgetting, in s.
    Raises:
        InputError: a block is shorter than a period, the memory than a block, or samples are
            blanked.
    Source: L. Ljung, System Identification, 2nd ed., ch. 11; exponential forgetting.
    Example:
        >>> config = LockinConfig(200e3, 200, 2000.0, 0.0, 1e6, min_amplitude_codes=0.1)
        >>> angle = 2 * np.pi * 2000.0 * np.arange(20 * 200) / 200e3
        >>> record = np.stack([np.cos(angle), 2 * np.cos(angle + np.pi / 2)], axis=1)
        >>> sensed = Recursive(config, memory_s=2e-3).sense(record.reshape(20, 200, 2))
        >>> round(float(sensed.capacitance_f[-1]) * 2 * np.pi * 2000.0 * 500e3, 6)
        1.0
    """

    def __init__(self, config: LockinConfig, memory_s: float) -> None:
        self.config = config
        if config.blank[1] > config.blank[0] or config.search_updates:
            raise InputError(
                "The recursive estimator knows no blanking, but the configuration asks for it. "
                "Take the lock-in, or leave it out."
            )
        if not memory_s >= config.block_s:
            raise InputError(
                f"Memory = {memory_s:g} s is shorter than a block of {config.block_s:g} s. "
                "Lengthen it, or shorten the block."
            )
        periods = config.block_s * config.carrier_hz
        if not periods >= 1.0 - 1e-9:
            raise InputError(
                f"A block of {config.block_samples} samples holds {periods:g} carrier periods; at "
                "least one is needed. Lengthen the block."
            )
        plan = make_plan(config, alone=True)
        self._native_plan = plan.native
        self._native = _sense.Recursive(
            plan.local_normal, float(np.exp(-config.block_s / memory_s))
        )
        self._blocks = 0

    def sense(self, readings: NDArray[Any]) -> Sensed:
        """The next blocks; the memory goes on where the last call left it.

        Args:
            readings: shape `(blocks, block_samples, 2)`, voltage then current.
        Returns:
            Results at the end of each block, arrays of shape `(blocks,)`; `time_s` is that end,
            counted from the first sample of all.
        Raises:
            InputError: the shape does not fit the configuration.
        """
        check_blocks(readings, self.config)
        rows = np.empty((len(readings), _COLUMNS))
        self._native.step(self._native_plan, as_readings(readings), rows)
        ends = self._blocks + np.arange(1, len(rows) + 1, dtype=np.float64)
        self._blocks += len(rows)
        v_noise, i_noise = rows[:, 4], rows[:, 5]
        quadrature, level, slope = rows[:, 10], rows[:, 11], rows[:, 12]
        return sensed_from_phasors(
            Phasors(
                voltage=rows[:, 0] + 1j * rows[:, 1],
                current=rows[:, 2] + 1j * rows[:, 3],
                voltage_std=np.sqrt(quadrature * v_noise),
                current_std=np.sqrt(quadrature * i_noise),
                omega_rad_s=np.full(len(rows), self.config.omega_rad_s),
                time_s=self.config.block_s * ends,
                reason=rows[:, 13].astype(np.uint8),
                levels=Levels(
                    rows[:, 6],
                    rows[:, 7],
                    np.sqrt(level * v_noise),
                    np.sqrt(level * i_noise),
                    rows[:, 8],
                    np.sqrt(slope * v_noise),
                ),
            ),
            self.config,
        )
