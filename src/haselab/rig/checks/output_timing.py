"""Measure how late the outputs and the samples of a data acquisition device are.

`measure_start` needs the output wired to the voltage monitor's input, without the amplifier.
`measure_lag` needs no wiring.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base import LimitError
from haselab.rig.instruments.devices import DaqDevice
from haselab.rig.instruments.sections import DaqConfig

__all__ = [
    "Lag",
    "StartMeasurement",
    "measure_lag",
    "measure_start",
    "recommended_ahead_blocks",
]

_SPARE_SHARE = 0.25  # fraction of a block kept as a reserve for a slow computer
_SETTLE_BLOCKS = 3
_EDGE_SHARE = 0.5  # fraction of the step at which it counts as arrived


@dataclass(frozen=True)
class StartMeasurement:
    """Starts of the output, measured at the input to which it is wired.

    Args:
        late_samples: delay of each start, from the expected edge to the measured one, in samples;
            NaN: it did not come within a few blocks, or was written too late. Shape `(starts,)`.
        block_samples: samples of a block.
        missed: number of outputs that were written too late, counted by the driver.
    """

    late_samples: NDArray[np.float64]
    block_samples: int
    missed: int = 0

    @property
    def seen(self) -> int:
        """Number of starts whose output was seen."""
        return int(np.isfinite(self.late_samples).sum())

    @property
    def late_blocks(self) -> int:
        """Delay of the latest start in whole blocks; negative if early, 0 if none was seen."""
        late = self.late_samples[np.isfinite(self.late_samples)]
        blocks = np.rint(late / self.block_samples)
        return int(blocks[np.argmax(np.abs(blocks))]) if blocks.size else 0

    @property
    def spread_samples(self) -> float:
        """Difference of the largest and the smallest delay, in samples."""
        late = self.late_samples[np.isfinite(self.late_samples)]
        return float(late.max() - late.min()) if late.size else math.nan


@dataclass(frozen=True)
class Lag:
    """The driver's count of samples compared with the wall clock.

    Args:
        highest_s: largest delay of the count, in s.
        median_s: median delay of the count, in s.
        rate_share: relative error of the configured sample rate: measured over configured, minus 1.
    """

    highest_s: float
    median_s: float
    rate_share: float


def measure_start(
    board: DaqDevice, daq: DaqConfig, *, starts: int = 50, step_v: float = 0.1
) -> StartMeasurement:
    """Start the output repeatedly with a step, and measure when the step arrives.

    This needs the output wired to the voltage monitor's input, without the amplifier. It ends at
    0 V.

    Args:
        board: opened device; nothing else may read its blocks meanwhile.
        daq: section `daq` of the rig file.
        starts: how many.
        step_v: of the output, in V; within its limits.
    Returns:
        The delay of each start.
    Raises:
        DeviceError: The board does not reply correctly.
        LimitError: The step is outside the output's limits or too small; or there is no start.
    """
    least_v = 20.0 * daq.volt_per_code
    if starts < 1 or not abs(step_v) >= least_v:
        raise LimitError(
            f"starts is {starts} and step_v is {step_v:g} V, but they must be at least 1 and "
            f"{least_v:.2g} V. Raise them."
        )
    late, missed = np.full(starts, np.nan), 0
    expected = daq.switch_in_block + daq.ahead_blocks * daq.block_samples
    try:
        for k in range(starts):
            board.write(0.0)
            board.pause()
            board.read()
            board.pause()
            board.keep(True)  # restarts the output; from here on no block is skipped
            before, step = board.missed_outputs, []
            board.write(step_v)
            for _ in range(daq.ahead_blocks + _SETTLE_BLOCKS):
                step.append(board.read()[:, 0])
            board.keep(False)
            came = np.flatnonzero(np.concatenate(step) * daq.volt_per_code / step_v > _EDGE_SHARE)
            missed += board.missed_outputs - before
            if came.size and board.missed_outputs == before:
                late[k] = came[0] - expected
    finally:
        board.zero()
        board.keep(False)
    return StartMeasurement(late, daq.block_samples, missed)


def measure_lag(
    acquired: Callable[[], int],
    rate_hz: float,
    *,
    duration_s: float = 1.0,
    now: Callable[[], float] = time.monotonic,
    pause: Callable[[float], None] = time.sleep,
) -> Lag:
    """Measure the delay of the driver's count of samples behind the device.

    The smallest delay defines the device's own clock, so a constant delay is not found by this
    function, but by `measure_start`.

    Args:
        acquired: number of acquired samples, as in `CountsSamples`.
        rate_hz: of the samples.
        duration_s: of the measurement, in s.
        now: clock, in s.
        pause: called between two readings.
    Returns:
        The lag; all zero on a twin in lock-step, whose count does not change.
    Raises:
        DeviceError: The board does not reply.
    """
    times_s, counts = [now()], [acquired()]
    while times_s[-1] - times_s[0] < duration_s:
        pause(duration_s / 500.0)
        before_s = now()
        counts.append(acquired())
        times_s.append(before_s)  # the count is not older than the query
    if counts[-1] == counts[0]:
        return Lag(0.0, 0.0, 0.0)
    times, samples = np.array(times_s) - times_s[0], np.array(counts, dtype=np.float64)
    measured_hz = (samples[-1] - samples[0]) / times[-1]
    ahead_s = samples / rate_hz - times
    lag_s = ahead_s.max() - ahead_s
    return Lag(float(lag_s.max()), float(np.median(lag_s)), measured_hz / rate_hz - 1.0)


def recommended_ahead_blocks(lag_s: float, write_s: float, daq: DaqConfig) -> int:
    """Compute how many output blocks must be queued in the device so that none is late.

    The time from a block's end until the output computed from it is due is `output_delay_s` plus
    one block for each queued output.

    Args:
        lag_s: from a block's end until it can be read, in s.
        write_s: from then until its output has been written to the device, in s.
        daq: section `daq` of the rig file.
    Returns:
        Value for `daq.ahead_blocks`, at most 10.
    Example:
        >>> recommended_ahead_blocks(0.0, 1e-3, DaqConfig(kind="any"))
        1
        >>> recommended_ahead_blocks(8e-3, 3e-3, DaqConfig(kind="any"))
        2
    """
    block_s = daq.block_samples / daq.rate_hz
    needed_s = lag_s + write_s + _SPARE_SHARE * block_s - daq.output_delay_s
    return min(max(math.ceil(needed_s / block_s), 0), 10)
