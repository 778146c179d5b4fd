"""When a camera exposed, by a counter of the NI board: each edge latches the count of a clock.

The counter counts the 20 MHz timebase from the start of the inputs on, and the camera's exposure
line clocks what is kept of it. So an exposure needs no analogue input and is known to 50 ns,
however late it is read.
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
_UNSURE_S = 40.0  # after that long without a look it is not known how often the counter overflowed
_TICK_S = 1.0 / TIMEBASE_HZ
_LONGEST_START_S = 0.3e-6  # from the start trigger to the first conversion, if not reported


class ExposureCounter:
    """Tells a log of the exposures of one camera; `task` is the driver's.

    Args:
        link: to the board.
        daq: section `daq` of the rig file.
        exposure: section `exposure`.
    Raises:
        InputError: the sample rate does not divide the timebase.
    """

    def __init__(self, link: NidaqLink, daq: NidaqConfig, exposure: ExposureConfig) -> None:
        self.log = ExposureLog(_TICK_S)
        self._daq = daq
        self._half_s = 0.5 * exposure.duration_s
        self._start_s = 0.0  # from the start trigger to the first sample
        self._looked = 0  # samples there were at the last look
        self._logged = 0  # exposures added or dropped
        self._place = self._offset = 0  # where the driver reads on, and what it adds
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
        # A task that counts has no start trigger; this is its counterpart.
        arm = self.task.triggers.arm_start_trigger
        arm.trig_type = constants.TriggerType.DIGITAL_EDGE
        arm.dig_edge_src = tasks.start_trigger
        arm.dig_edge_edge = constants.Edge.RISING
        self.task.in_stream.overwrite = constants.OverwriteMode.OVERWRITE_UNREAD_SAMPLES
        self._reader = link.counter_reader(self.task)

    def start(self, first_sample_s: float | None) -> None:
        """Wait for the inputs, which are started after this.

        Args:
            first_sample_s: from their start trigger to their first sample; None: not known.
        """
        self._start_s = first_sample_s or 0.0
        if first_sample_s is None:
            self.log.uncertainty_s = _LONGEST_START_S
        self.task.start()

    def collect(self, position: int) -> None:
        """Tell the log what has been latched.

        Exposures of a long time in which nobody looked are dropped, since the counter may have gone
        round: frames of that time are nobody's.

        Args:
            position: samples read so far; an edge is added one block after it at the latest.
        """
        total = int(self.task.in_stream.total_samp_per_chan_acquired)
        idle_s = (position - self._looked) / self._daq.rate_hz
        if idle_s > _UNSURE_S or total - self._logged > _BUFFER // 2:
            self._logged = total
        self._looked = position
        latched = self._read(total - self._logged)
        settled_s = (position - self._daq.block_samples) / self._daq.rate_hz
        # An edge lies between the last tick that was counted and the next one.
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
    """Counts of a counter that has gone round, nearest to a known one.

    Args:
        latched: what the counter showed, shape `(n,)`.
        position: about what it should have counted.
    Returns:
        Shape `(n,)`.
    Example:
        >>> unrolled(np.array([5, 2**32 - 1], np.uint32), 2**32)
        array([4294967301, 4294967295])
    """
    since = (latched.astype(np.int64) - position + _ROUND // 2) % _ROUND - _ROUND // 2
    return position + since
