"""How late the outputs and the readings of a data acquisition device come.

`measure_start` needs the output looped to the voltage monitor's input, without the amplifier.
`measure_lag` needs no wire.
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

_SPARE_SHARE = 0.25  # of a block, for a computer that is a little late
_SETTLE_BLOCKS = 3
_EDGE_SHARE = 0.5  # of the step: where it counts as come


@dataclass(frozen=True)
class StartMeasurement:
    """Starts of the output, seen at a looped input.

    Args:
        late_samples: of each start, from the expected edge to where the output really came, in
            samples; NaN: it did not come within a few blocks, or was written too late. Shape
            `(starts,)`.
        block_samples: of a block.
        missed: outputs that were written too late, by the driver's own count.
    """

    late_samples: NDArray[np.float64]
    block_samples: int
    missed: int = 0

    @property
    def seen(self) -> int:
        """Starts whose output came."""
        return int(np.isfinite(self.late_samples).sum())

    @property
    def late_blocks(self) -> int:
        """Whole blocks that the latest one was late, or early (below zero); 0 where none came."""
        late = self.late_samples[np.isfinite(self.late_samples)]
        blocks = np.rint(late / self.block_samples)
        return int(blocks[np.argmax(np.abs(blocks))]) if blocks.size else 0

    @property
    def spread_samples(self) -> float:
        """Largest less smallest delay, in samples."""
        late = self.late_samples[np.isfinite(self.late_samples)]
        return float(late.max() - late.min()) if late.size else math.nan


@dataclass(frozen=True)
class Lag:
    """The driver's count of samples against the wall clock.

    Args:
        highest_s: by which the count was behind the device at the most, in s.
        median_s: the same of half of the looks, in s.
        rate_share: measured rate of the samples over the configured one, less 1.
    """

    highest_s: float
    median_s: float
    rate_share: float


def measure_start(
    board: DaqDevice, daq: DaqConfig, *, starts: int = 50, step_v: float = 0.1
) -> StartMeasurement:
    """Start the output again and again, each time with a step, and see where the step comes.

    The output is wired to the voltage monitor's input for this, without the amplifier. It ends at
    0 V.

    Args:
        board: opened, and no other one uses its blocks meanwhile.
        daq: section `daq` of the rig file.
        starts: how many.
        step_v: of the output, in V; within its limits.
    Returns:
        How late each was.
    Raises:
        DeviceError: the board does not answer as it should.
        LimitError: the step is beyond the output's limits, or too small; or fewer than one start.
    """
    least_v = 20.0 * daq.volt_per_code
    if starts < 1 or not abs(step_v) >= least_v:
        raise LimitError(
            f"starts = {starts} and step_v = {step_v:g} V, but 1 start and {least_v:.2g} V are "
            "needed at least. Raise them."
        )
    late, missed = np.full(starts, np.nan), 0
    expected = daq.switch_in_block + daq.ahead_blocks * daq.block_samples
    try:
        for k in range(starts):
            board.write(0.0)
            board.pause()
            board.read()
            board.pause()
            board.keep(True)  # starts the output anew; from here on no block is passed over
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
    """How far the driver's count of samples is behind the device.

    What is least behind defines the device's own clock: a lag that is always there is not seen by
    this, but by `measure_start`.

    Args:
        acquired: samples that have come in, as a `CountsSamples` does.
        rate_hz: of the samples.
        duration_s: of the looks, in s.
        now: clock, in s.
        pause: between two looks.
    Returns:
        The lag; all zero on a twin in lock-step, whose count stands still.
    Raises:
        DeviceError: the board does not answer.
    """
    times_s, counts = [now()], [acquired()]
    while times_s[-1] - times_s[0] < duration_s:
        pause(duration_s / 500.0)
        before_s = now()
        counts.append(acquired())
        times_s.append(before_s)  # the count is no older than the question
    if counts[-1] == counts[0]:
        return Lag(0.0, 0.0, 0.0)
    times, samples = np.array(times_s) - times_s[0], np.array(counts, dtype=np.float64)
    measured_hz = (samples[-1] - samples[0]) / times[-1]
    ahead_s = samples / rate_hz - times
    lag_s = ahead_s.max() - ahead_s
    return Lag(float(lag_s.max()), float(np.median(lag_s)), measured_hz / rate_hz - 1.0)


def recommended_ahead_blocks(lag_s: float, write_s: float, daq: DaqConfig) -> int:
    """Output blocks that have to wait in the device so that none is late.

    An output computed from a block has from the block's end until it is due: `output_delay_s`, and
    a block for each one that waits.

    Args:
        lag_s: from a block's end until it can be read, in s.
        write_s: from then until its output is in the device, in s.
        daq: section `daq` of the rig file.
    Returns:
        Value for `daq.ahead_blocks`, 10 at most.
    Example:
        >>> recommended_ahead_blocks(0.0, 1e-3, DaqConfig(kind="any"))
        1
        >>> recommended_ahead_blocks(8e-3, 3e-3, DaqConfig(kind="any"))
        2
    """
    block_s = daq.block_samples / daq.rate_hz
    needed_s = lag_s + write_s + _SPARE_SHARE * block_s - daq.output_delay_s
    return min(max(math.ceil(needed_s / block_s), 0), 10)
