"""When a camera exposed, by a counter of the NI board: each edge latches the number of a sample.

The counter counts the inputs' sample clock, and the camera's exposure line clocks what is kept of
it. So an exposure needs no analogue input and is known to half a sample, however late it is read.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab.rig.bench_config import DaqConfig, ExposureConfig
from haselab.rig.cameras.pairing import ExposureLog
from haselab.rig.nidaq_link import NidaqLink

__all__ = ["ExposureCounter", "unrolled"]

_FASTEST_HZ = 10e3  # of the frames, for the driver's buffer
_BUFFER = 100_000
_ROUND = 1 << 32  # a counter has 32 bits: six hours at 200 kHz


class ExposureCounter:
    """Tells a log of the exposures of one camera.

    Args:
        link: to the board.
        daq: section `daq` of the rig file.
        exposure: section `exposure`.
    """

    def __init__(self, link: NidaqLink, daq: DaqConfig, exposure: ExposureConfig) -> None:
        self.log = ExposureLog(0.5 / daq.rate_hz)
        self._daq = daq
        self._half_s = 0.5 * exposure.duration_s
        constants = link.constants
        self._task = link.task()
        channel = self._task.ci_channels.add_ci_count_edges_chan(f"{daq.device}/{exposure.counter}")
        channel.ci_count_edges_term = f"/{daq.device}/ai/SampleClock"
        self._task.timing.cfg_samp_clk_timing(
            _FASTEST_HZ,
            source=f"/{daq.device}/{exposure.input}",
            active_edge=constants.Edge[exposure.edge.upper()],
            sample_mode=constants.AcquisitionType.CONTINUOUS,
            samps_per_chan=_BUFFER,
        )
        self._task.in_stream.overwrite = constants.OverwriteMode.OVERWRITE_UNREAD_SAMPLES
        self._reader = link.counter_reader(self._task)

    def start(self) -> None:
        """Count from here: before the inputs are started, so that both count the same samples."""
        self._task.start()

    def collect(self, position: int) -> None:
        """Tell the log what has been latched.

        Args:
            position: samples read so far; an edge is told one block after it at the latest.
        """
        count = int(self._task.in_stream.avail_samp_per_chan)
        latched = np.empty(count, dtype=np.uint32)
        if count:
            self._reader.read_many_sample_uint32(latched, count, timeout=0.0)
        settled_s = (position - self._daq.block_samples) / self._daq.rate_hz
        # An edge lies between the last sample that was counted and the next one.
        edges_s = (unrolled(latched, position) - 0.5) / np.float64(self._daq.rate_hz)
        self.log.tell(edges_s + self._half_s, settled_s + self._half_s)


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
