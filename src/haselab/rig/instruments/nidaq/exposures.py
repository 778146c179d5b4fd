"""Time a camera's exposures with a counter of the NI board, which each edge latches.

The counter counts the 20 MHz timebase from the start of the inputs on, and the camera's exposure
line latches the count. So an exposure needs no analogue input and is known to 50 ns, however late
it is read.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab.rig.cameras.pairing import ExposureLog
from haselab.rig.instruments.nidaq.link import NidaqLink
from haselab.rig.instruments.nidaq.section import NidaqConfig
from haselab.rig.instruments.nidaq.tasks import TIMEBASE_HZ, NidaqTasks
from haselab.rig.instruments.sections import ExposureConfig

__all__ = ["ExposureCounter", "unrolled"]

_FASTEST_HZ = 10e3  # of the frames, for the driver's buffer
_BUFFER = 100_000
_ROUND = 1 << 32  # a counter has 32 bits: 215 s of 20 MHz
_UNSURE_S = 40.0  # after so long without reading, the number of counter overflows is unknown
_TICK_S = 1.0 / TIMEBASE_HZ
_LONGEST_START_S = 0.3e-6  # from the start trigger to the first conversion, if not reported


class ExposureCounter:
    """Adds the exposures of one camera to a log; `task` is the driver's.

    Args:
        link: to the board.
        daq: section `daq` of the rig file.
        exposure: section `exposure`.
        log: to continue with after the board was opened again; None: a new one.
    Raises:
        InputError: The sample rate does not divide the timebase.
    """

    def __init__(
        self,
        link: NidaqLink,
        daq: NidaqConfig,
        exposure: ExposureConfig,
        log: ExposureLog | None = None,
    ) -> None:
        self.log = log or ExposureLog(_TICK_S)
        self.log.forget()
        self._daq = daq
        self._half_s = 0.5 * exposure.duration_s
        self._start_s = 0.0  # from the start trigger to the first sample
        self._looked = 0  # number of samples at the last reading
        self._logged = 0  # exposures added or dropped
        # position at which the driver continues to read, and its offset
        self._place = self._offset = 0
        constants, tasks = link.constants, NidaqTasks(link, daq)
        self._ticks = tasks.ticks
        self.task = link.task()
        channel = self.task.ci_channels.add_ci_count_edges_chan(f"{daq.device}/{exposure.counter}")
        channel.ci_count_edges_term = tasks.timebase
        self.task.timing.cfg_samp_clk_timing(
            _FASTEST_HZ,
            source=f"/{daq.device}/{exposure.input}",
            active_edge=constants.Edge[exposure.edge.upper()],
            sample_mode=constants.AcquisitionType.CONTINUOUS,
            samps_per_chan=_BUFFER,
        )
        # A counting task has no start trigger; this is its counterpart.
        arm = self.task.triggers.arm_start_trigger
        arm.trig_type = constants.TriggerType.DIGITAL_EDGE
        arm.dig_edge_src = tasks.start_trigger
        arm.dig_edge_edge = constants.Edge.RISING
        self.task.in_stream.overwrite = constants.OverwriteMode.OVERWRITE_UNREAD_SAMPLES
        self._reader = link.counter_reader(self.task)

    def start(self, first_sample_s: float | None) -> None:
        """Start before the inputs, and wait for their start trigger.

        Args:
            first_sample_s: from their start trigger to their first sample; None: unknown.
        """
        self._start_s = first_sample_s or 0.0
        if first_sample_s is None:
            self.log.uncertainty_s = _LONGEST_START_S
        self.task.start()

    def collect(self, position: int) -> None:
        """Add what has been latched to the log.

        After a long time without reading, exposures are dropped, since the counter may have
        overflowed; frames of that time have no exposure.

        Args:
            position: number of samples read so far; an edge is added at most one block later.
        """
        total = int(self.task.in_stream.total_samp_per_chan_acquired)
        idle_s = (position - self._looked) / self._daq.rate_hz
        if idle_s > _UNSURE_S or total - self._logged > _BUFFER // 2:
            self._logged = total
        self._looked = position
        latched = self._read(total - self._logged)
        settled_s = (position - self._daq.block_samples) / self._daq.rate_hz
        # An edge is between the last counted tick and the next one.
        ticks = unrolled(latched, position * self._ticks) + 0.5
        edges_s = ticks / np.float64(TIMEBASE_HZ) - self._start_s
        self.log.add(edges_s + self._half_s, settled_s + self._half_s)

    def _read(self, count: int) -> NDArray[np.uint32]:
        latched = np.empty(count, dtype=np.uint32)
        if count:
            offset = self._logged - self._place
            if offset != self._offset:
                self.task.in_stream.offset = offset
                self._offset = offset
            self._reader.read_many_sample_uint32(latched, count, timeout=0.0)
            self._logged += count
            self._place = self._logged
        return latched


def unrolled(latched: NDArray[np.uint32], position: int) -> NDArray[np.int64]:
    """Unwrap counts of a counter that overflowed, nearest to a known count.

    Args:
        latched: latched counts, shape `(n,)`.
        position: approximate true count.
    Returns:
        Shape `(n,)`.
    Example:
        >>> unrolled(np.array([5, 2**32 - 1], np.uint32), 2**32)
        array([4294967301, 4294967295])
    """
    since = (latched.astype(np.int64) - position + _ROUND // 2) % _ROUND - _ROUND // 2
    return position + since
