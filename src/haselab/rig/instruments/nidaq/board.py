"""NI-DAQmx as source and acquisition: blocks without gaps, outputs clocked by the inputs.

The inputs run as long as the bench is open. A counter that starts with them divides their timebase
by the length of a block and clocks the output, so that each output begins at the same sample of its
block: one value is queued for every block that is read. While no block is read, the output is
constant. Between experiments blocks may be skipped; while `keep` is on, no block is skipped: an
output that comes too late is skipped and counted, the output is constant meanwhile, and the blocks
continue.
"""

from __future__ import annotations

import itertools
import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from haselab.base import DeviceError, Limits
from haselab.rig.cameras.pairing import ExposureLog
from haselab.rig.drivers import quietly
from haselab.rig.instruments.nidaq.exposures import ExposureCounter
from haselab.rig.instruments.nidaq.idle import IdlePoll
from haselab.rig.instruments.nidaq.link import NidaqLink
from haselab.rig.instruments.nidaq.section import NidaqConfig
from haselab.rig.instruments.nidaq.tasks import NidaqTasks
from haselab.rig.instruments.sections import ExposureConfig

__all__ = ["NidaqBoard"]

# most blocks per call of `pass_time` without reading: 0.5 s, so that Ctrl-C works
_PASS_BLOCKS = 50
_STARTS = 12  # attempts to start the output synchronously
_LOOKS = 100  # readings of the device's counts, until both belong to one block
_LEAD, _AT_ONCE = 50, 10  # known values queued in the device, and most that one call queues
_FEWEST = 2  # number of values with which a stream is started
_FEWEST_USB = 3  # over USB, so that two readings of the counts fit before the last value
_USB_LOOKS = 8  # packets after a start over USB after which the device's counts are read


class NidaqBoard:
    """One NI board: `VoltageSource`, `Acquisition`, `ReportsOutput`, `PreloadsOutputs`.

    `zero` may be called from any thread, all else from one.

    Args:
        config: section `daq` of the rig file.
        limits: of the drive output.
        monitor_gain: volts at the voltage monitor per volt of drive, for the read-back.
        exposure: line that signals a camera's exposures; None: there is none.
        link: to the device, closed with the board; None: it is made here.
    Raises:
        DeviceError: Driver or device is missing, or the device refuses the configuration.
        InputError: The device is not the one that the rig file names, or the rate does not divide
            the timebase, or the skew is not the device's.
    """

    def __init__(
        self,
        config: NidaqConfig,
        limits: Limits,
        monitor_gain: float,
        exposure: ExposureConfig | None = None,
        link: NidaqLink | None = None,
    ) -> None:
        self._config = config
        self._limits = limits
        self._monitor_gain = monitor_gain
        self._volts = np.empty((2, config.block_samples))
        self._one = np.empty((2, 1))
        self._coming: deque[float] = deque()  # known values of later blocks
        self._early: deque[float] = deque()  # values that were written before their block was read
        self.missed_outputs = 0
        self._exposure = exposure
        self._exposures: ExposureCounter | None = None
        self._idle: IdlePoll | None = None
        self._link = link or NidaqLink(config)
        try:
            self._link.check_serial()
            self._tasks = NidaqTasks(self._link, config)
            with self._link.translated_errors():
                self._open()
        except BaseException:
            self._link.close()
            raise
        self.identity = self._link.identity

    # ---- opening and closing -------------------------------------------------------------------

    def _open(self) -> None:
        self._requested_v = 0.0  # of the last write
        self._queued_v = 0.0  # last value that was written to the device
        self._silent_until = 0  # outputs of blocks before this sample came too late
        self.fetched_s = 0.0  # end of the last fetched block; `time_s` may be later
        self._position = 0  # samples read or skipped since the start
        self._place = 0  # position at which the driver continues to read
        self._offset = 0  # offset that it adds
        self._kept = self._streaming = False
        self._forget()
        if self._exposure is not None:
            log = self.exposures  # which the camera reads
            self._exposures = ExposureCounter(self._link, self._config, self._exposure, log)
        self._static = self._tasks.output()
        self._at_once = self._link.writer(self._static, auto_start=True)
        self._put_out(0.0)
        self._stream = self._tasks.stream()
        self._stream.control(self._link.constants.TaskMode.TASK_VERIFY)
        self._ahead = self._link.writer(self._stream, auto_start=False)
        self._inputs = self._tasks.inputs()
        self._tasks.check_skew(self._inputs)
        self._clock = self._tasks.clock()
        self._reader = self._link.reader(self._inputs)
        self._clock.start()  # both wait for the inputs
        if self._exposures is not None:
            self._exposures.start(self._tasks.first_sample_s(self._inputs))
        self._inputs.start()
        if self._link.usb:
            self._idle = IdlePoll(self._query_idle)

    def reopen(self) -> None:
        """See `haselab.rig.Reopens`: makes all tasks again; the first one puts out 0 V."""
        if self._idle is not None:
            self._idle.close()
        self._link.close_tasks()
        with self._link.translated_errors():
            self._open()

    def close(self) -> None:
        """Go to 0 V, then close the board. Never raises."""
        self.zero()
        if self._idle is not None:
            self._idle.close()
        self._link.close()

    @property
    def exposures(self) -> ExposureLog | None:
        """Exposures of the camera in the blocks read so far; None if they are not recorded."""
        return None if self._exposures is None else self._exposures.log

    # ---- VoltageSource -------------------------------------------------------------------------

    def write(self, voltage_v: float) -> None:
        """See `haselab.rig.VoltageSource`; written to the device when the next block is read."""
        self._limits.check(voltage_v)
        self._requested_v = float(voltage_v)

    def zero(self) -> None:
        """See `haselab.rig.VoltageSource`; discards what is queued. Never raises."""
        self._requested_v = self._queued_v = 0.0
        self._forget()
        self._end_stream()
        # take the output from any program that holds it
        if quietly(lambda: self._put_out(0.0)) is not None:
            quietly(self._link.reset)
            quietly(lambda: self._put_out(0.0))

    def preload(self, voltages_v: NDArray[np.float64]) -> int:
        """See `haselab.rig.PreloadsOutputs`."""
        self._limits.check(voltages_v)
        self._forget()
        if not self._kept:
            return 0
        self._coming.extend(float(value) for value in voltages_v)
        return _LEAD - _AT_ONCE

    def _forget(self) -> None:
        self._coming.clear()
        self._early.clear()

    def read_back(self) -> float:
        """See `haselab.rig.ReportsOutput`; mean of the voltage monitor over a new block."""
        self.pause()
        self.read()  # this block may have begun before the last change of the output
        codes = self.read()
        self.pause()
        return float(codes[:, 0].mean()) * self._config.volt_per_code / self._monitor_gain

    # ---- Acquisition ---------------------------------------------------------------------------

    @property
    def time_s(self) -> float:
        """Clock at the end of the last block, in s since the inputs were started."""
        return self._position / self._config.rate_hz

    def keep(self, on: bool) -> None:
        """Start or stop keeping every block; otherwise blocks that are not read are skipped."""
        self._kept = on
        if not on:
            self.pause()
        elif not self._streaming:
            self.catch_up()
            with self._link.translated_errors():
                self._position = self._start_stream()

    def pause(self) -> None:
        """Hold the last requested output; blocks are skipped until the next one is read."""
        self._hold_output(self._requested_v)

    def _hold_output(self, voltage_v: float) -> None:
        self._forget()
        if not self._streaming and voltage_v == self._queued_v:
            return
        self._end_stream()
        with self._link.translated_errors():
            self._put_out(voltage_v)
        self._queued_v = voltage_v

    def _end_stream(self) -> None:
        """End the stream and its task, which would hold the output even when stopped.

        Never raises: stopping reports an underflow, which idle time may cause.
        """
        self._streaming = False
        quietly(self._stream.stop)
        quietly(lambda: self._stream.control(self._link.constants.TaskMode.TASK_UNRESERVE))

    def _put_out(self, voltage_v: float) -> None:
        """Write the output on demand; the device puts it out at once and holds it."""
        try:
            self._at_once.write_one_sample(voltage_v, self._config.timeout_s)
        finally:
            self._static.stop()
            quietly(lambda: self._static.control(self._link.constants.TaskMode.TASK_UNRESERVE))

    def catch_up(self) -> None:
        """Skip what has arrived since the last block, up to the last complete one."""
        with self._link.translated_errors():
            passed = (self._acquired() - self._position) // self._config.block_samples
        if passed > 0:
            self._hold_output(self._queued_v)
            self._position += passed * self._config.block_samples
            self.fetched_s = self._position / self._config.rate_hz
        # still needed: `pass_time` has not read it, and a camera starts
        if self._exposures is not None:
            with self._link.translated_errors():
                self._exposures.collect(self._position)

    def acquired(self) -> int:
        """Number of samples acquired since the start, counted by the driver.

        Raises:
            DeviceError: The board does not reply.
        """
        with self._link.translated_errors():
            return self._acquired()

    def _acquired(self) -> int:
        if self._idle is not None:
            self._idle.note_query()
        return int(self._inputs.in_stream.total_samp_per_chan_acquired)

    def _query_idle(self) -> int:
        self._link.ignore_silence()
        return int(self._inputs.in_stream.total_samp_per_chan_acquired)

    def read(self) -> NDArray[np.int16]:
        """See `haselab.rig.Acquisition`. Readings outside the range are set to its end."""
        if not (self._kept and self._streaming):
            self.catch_up()
        with self._link.translated_errors():
            if not self._streaming:
                self._position = self._start_stream()
            self._give()
            self._fetch()
            if self._exposures is not None:
                self._exposures.collect(self._position)
        top = self._config.top_code
        codes = np.rint(self._volts.T / self._config.volt_per_code)
        return np.clip(codes, -top - 1, top).astype(np.int16, order="C")

    def _give(self) -> None:
        """Queue the output of the next block, and known outputs of later blocks."""
        values: list[float] = []
        if self._early:
            if self._early.popleft() != self._requested_v:
                raise DeviceError(
                    f"NI board {self._config.device}: the queued output differs from the requested "
                    f"one, {self._requested_v:g} V. This is a bug in haselab. Please report it."
                )
        else:
            if self._coming:
                self._coming.popleft()
            if self._position < self._silent_until:
                self.missed_outputs += 1
                return
            values.append(self._requested_v)
        room = _LEAD - len(self._early)
        following = self._position + (len(self._early) + 1) * self._config.block_samples
        some: list[float] = []
        if following >= self._silent_until and (values or room >= _AT_ONCE):
            some = list(itertools.islice(self._coming, room))
        if not values + some:
            return
        try:
            self._ahead.write_many_sample(np.array(values + some), self._config.timeout_s)
        except Exception as error:
            if not self._link.is_late_output(error):
                raise
            self._restart_stream(bool(values))
            return
        self._queued_v = (values + some)[-1]
        self._early.extend(some)
        for _ in some:
            self._coming.popleft()

    def _restart_stream(self, owed: bool) -> None:
        """Restart the output after its queue ran out.

        The blocks until then are skipped; if all blocks are kept, only their outputs are skipped.

        Args:
            owed: whether the output of the next block has not been written yet.
        """
        early, coming = self._early.copy(), self._coming.copy()
        self._hold_output(self._queued_v)
        if not self._kept:
            self._position = self._start_stream()
            self._ahead.write_many_sample(np.array([self._requested_v]), self._config.timeout_s)
            self._queued_v = self._requested_v
            return
        self._silent_until = self._start_stream()
        self._early, self._coming = early, coming
        self.missed_outputs += owed

    def _start_stream(self) -> int:
        """Start the output so that the clock edge of its first value is known.

        The device keeps counting during the calls, so unless a block has just begun, this waits
        until a quarter of a block after an edge. A start that took until the next edge is resolved
        from the device's counts, or undone; the next attempt queues twice as many values of the
        present output. Over USB both the start and the counts are delayed by the bus, so there the
        device's counts decide, once a value has been put out.

        Returns:
            First sample of the first block whose output will not be late.
        """
        block, switch = self._config.block_samples, self._config.switch_in_block
        ahead, usb = self._config.ahead_blocks, self._link.usb
        for trial in range(_STARTS):
            queued = max(ahead, min((_FEWEST_USB if usb else _FEWEST) << trial, 32))
            now = self._acquired()
            edge: int = now // block * block + switch
            margin = switch // 2
            if now > edge - margin:
                edge, margin = edge + block, block // 8
                if now > edge - block // 2:
                    edge += block
                self._wait_for(edge - 3 * block // 4)
            self._ahead.write_many_sample(np.full(queued, self._queued_v), self._config.timeout_s)
            self._streaming = True
            self._stream.start()
            first: int | None = edge
            if usb:
                first = self._first_edge_usb(queued)
            elif self._acquired() > edge - margin:
                first = self._first_edge(queued)
            if first is not None:
                return first - switch + (queued - ahead) * block
            self._hold_output(self._queued_v)
        slow, advice = "the computer", "Close other programs."
        if usb:
            slow = "the computer or the USB connection"
            advice = "Close other programs, use a separate USB port, or raise daq.block_samples."
        raise DeviceError(
            f"NI board {self._config.device}: the output could not be synchronised with the blocks "
            f"in {_STARTS} attempts, because {slow} is too slow. {advice}"
        )

    def _first_edge_usb(self, queued: int) -> int | None:
        """Find the first edge if samples are late and in packets, just after a packet arrived.

        Its last sample is then new, so the counts belong together. A reading up to half a block
        after an edge leaves half a block for a packet on its way, and for writing the next value
        if only one is left; if no packet arrives then, two other readings must agree.
        """
        block, switch = self._config.block_samples, self._config.switch_in_block
        others: list[int] = []
        try:
            for _ in range(_USB_LOOKS):
                quarter = switch + block // 4
                self._wait_for((self._acquired() - quarter) // block * block + block + quarter)
                edges, since = divmod(self._acquired() - switch, block)
                put_out = int(self._stream.out_stream.total_samp_per_chan_generated)
                after = self._acquired() - switch - edges * block
                if put_out > queued - 1:
                    return None
                first = (edges + 1 - put_out) * block + switch
                if put_out and block // 8 <= since <= after <= block // 2:
                    return first
                if put_out and block // 8 <= since <= after <= block - block // 8:
                    others.append(first)
                    if others[-2:] == [first, first]:
                        return first
        except Exception as error:
            if not (isinstance(error, DeviceError) or self._link.is_late_output(error)):
                raise
        return None

    def _first_edge(self, queued: int) -> int | None:
        """Find the sample of the edge that puts out the first value of a running stream.

        It follows from the counts of values and readings if both certainly belong to one block;
        None if they do not, or if too few values are left for the next block.
        """
        block, switch = self._config.block_samples, self._config.switch_in_block
        try:
            with self._link.translated_errors():
                for _ in range(_LOOKS):
                    edges, since = divmod(self._acquired() - switch, block)
                    put_out = int(self._stream.out_stream.total_samp_per_chan_generated)
                    after = self._acquired() - switch - edges * block
                    if put_out > queued - 2:
                        return None
                    if block // 8 <= since <= after <= block - block // 8:
                        return (edges + 1 - put_out) * block + switch
        except DeviceError:  # the stream ran out meanwhile
            pass
        return None

    def _wait_for(self, sample: int) -> None:
        """Wait until the device has counted this many samples."""
        self._fetch_at(sample - 1, self._one)

    def _fetch(self) -> None:
        self._fetch_at(self._position, self._volts)
        self._position += self._config.block_samples
        self.fetched_s = self._position / self._config.rate_hz

    def _fetch_at(self, start: int, target: NDArray[np.float64]) -> None:
        """Read from this sample on; move the driver's read position if necessary."""
        config, samples = self._config, target.shape[1]
        offset = start - self._place
        if offset != self._offset:
            self._inputs.in_stream.offset = offset
            self._offset = offset
        if self._idle is not None:
            self._idle.note_query()
        wait_s = max(offset + samples, 0) / config.rate_hz + config.timeout_s
        self._reader.read_many_sample(target, samples, timeout=wait_s)
        self._place = start + samples

    def pass_time(self, duration_s: float) -> None:
        """Let whole blocks pass for at least `duration_s`; read them if kept, else skip them.

        Args:
            duration_s: in s.
        Raises:
            DeviceError: The board does not continue.
        """
        blocks = math.ceil(duration_s * self._config.rate_hz / self._config.block_samples - 1e-9)
        if self._kept:
            for _ in range(blocks):
                self.read()
            return
        self.pause()
        self.catch_up()
        while blocks > 0:
            some = min(blocks, _PASS_BLOCKS)
            self._position += (some - 1) * self._config.block_samples
            with self._link.translated_errors():
                self._fetch()
            blocks -= some
