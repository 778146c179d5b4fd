"""The samples of an emulated NI device: written, read, and counted by its counters."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.rig.twin.serve.ni.driver import NiDriver
from haselab.rig.twin.serve.ni.status import StatusError, StatusNumber
from haselab.rig.twin.serve.ni.tasks import State, Task

__all__ = ["EXPOSURE_LINE", "NiSamples"]

EXPOSURE_LINE = "PFI0"
_MONITORS = ("ai0", "ai1")
_OUTPUT = "ao0"
_OUTPUT_RANGE_V = 10.0
_ROUND = 1 << 32  # of a counter
_ACQUIRED, _GENERATED, _AVAILABLE = 0x192A, 0x192B, 0x1223
_FEWEST_VALUES = 2  # in an output buffer: DAQmxWriteRaw, note on buffered writes
_MOST_VALUES = 100_000  # of one call
_LONGEST_WAIT_S = 600.0


class NiSamples:
    """Calls of NI's service that move samples.

    Args:
        driver: whose tasks these are.
    """

    def __init__(self, driver: NiDriver) -> None:
        self._driver, self._device = driver, driver.device
        self.calls = {
            "GetReadAttributeUInt64": self._count_read,
            "GetReadAttributeUInt32": self._count_read,
            "GetWriteAttributeUInt64": self._count_written,
            "GetWriteAttributeUInt32": self._count_channels,
            "WriteAnalogF64": self._write_many,
            "WriteAnalogScalarF64": self._write_one,
            "ReadAnalogF64": self._read,
            "ReadCounterU32Ex": self._read_counter,
        }

    # ---- output ----------------------------------------------------------------------------------

    def _count_written(self, request: Any) -> dict[str, Any]:
        if request.attribute_raw != _GENERATED or not self._driver.task(request).buffered:
            raise StatusError(StatusNumber.NOT_APPLICABLE)
        if self._driver.hub.output_status:
            raise StatusError(self._driver.hub.output_status)
        return {"value": self._driver.hub.put_out}

    def _write_many(self, request: Any) -> dict[str, Any]:
        count = self._write(request, list(request.write_array))
        return {"samps_per_chan_written": count}

    def _write_one(self, request: Any) -> dict[str, Any]:
        self._write(request, [request.value])
        return {}

    def _write(self, request: Any, values: list[float]) -> int:
        task = self._driver.task(request)
        if task.kind != "output" or not 0 < len(values) <= _MOST_VALUES:
            raise StatusError(StatusNumber.BAD_VALUE)
        if any(not abs(value) <= _OUTPUT_RANGE_V for value in values):
            raise StatusError(StatusNumber.TOO_HIGH)
        if not task.buffered:
            self._put_out_now(task, values[-1], request.auto_start)
        elif task.running:
            self._append(task, values, request.timeout)
        else:
            self._prime(task, values)
            if request.auto_start:
                self._driver.run(task)
        return len(values)

    def _put_out_now(self, task: Task, value: float, auto_start: bool) -> None:
        before = task.state
        self._driver.raise_to(task, State.COMMITTED)
        if auto_start and not task.running:
            task.state, task.before = State.RUNNING, before
        if _OUTPUT in task.channels and task.running:
            self._driver.hub.set_output(value)

    def _prime(self, task: Task, values: list[float]) -> None:
        """Size the buffer by the first write unless it has a size; one value is too few."""
        if not task.buffer_size:
            if len(values) < _FEWEST_VALUES:
                raise StatusError(StatusNumber.ONE_VALUE_WITHOUT_BUFFER, 0)
            task.buffer_size = len(values)
        self._driver.raise_to(task, State.COMMITTED)
        if len(task.primed) + len(values) > task.buffer_size:
            raise StatusError(StatusNumber.NO_ROOM, 0)
        task.primed += values

    def _append(self, task: Task, values: list[float], timeout_s: float) -> None:
        """Space is size + generated - written: Key Concepts, "Write Status ... and Buffers"."""

        def room() -> int:
            return task.buffer_size + self._driver.hub.put_out - task.written

        wait_s = timeout_s if 0.0 <= timeout_s <= _LONGEST_WAIT_S else 0.0
        self._driver.hub.wait_until(
            lambda: room() >= len(values) or bool(self._driver.hub.output_status), wait_s
        )
        if self._driver.hub.output_status:
            raise StatusError(self._driver.hub.output_status, 0)
        taken = values[: max(room(), 0)]
        task.written += len(taken)
        self._driver.hub.queue_output(taken, self._driver.bus.write_samples)
        if len(taken) < len(values):
            raise StatusError(StatusNumber.NO_ROOM_YET, len(taken))

    # ---- inputs and counters ---------------------------------------------------------------------

    def _seen(self, task: Task) -> int:
        """Samples that have come of a task."""
        if not task.running:
            return 0
        if task.kind == "inputs":
            return self._driver.bus.visible(self._driver.hub.acquired)
        return len(self._latched(task))

    def _count_read(self, request: Any) -> dict[str, Any]:
        task = self._driver.task(request)
        if request.attribute_raw == _ACQUIRED:
            return {"value": self._seen(task)}
        if request.attribute_raw == _AVAILABLE:
            return {"value": max(self._seen(task) - task.position, 0)}
        return {"value": len(task.channels)}

    def _count_channels(self, request: Any) -> dict[str, Any]:
        return {"value": len(self._driver.task(request).channels)}

    def _read(self, request: Any) -> dict[str, Any]:
        task = self._driver.task(request)
        start, count = task.position + task.offset, request.num_samps_per_chan
        if task.kind != "inputs" or count <= 0 or not 0.0 <= request.timeout <= _LONGEST_WAIT_S:
            raise StatusError(StatusNumber.BAD_VALUE)
        acquired = self._driver.hub.acquired
        self._driver.bus.visible(acquired)
        due = self._driver.bus.needed(start + count)
        if (
            due is None
            or start + count - acquired > self._driver.hub.buffer_samples
            or not task.running
        ):
            raise StatusError(StatusNumber.LATE)
        if not task.overwrites and acquired - task.position > task.buffer_samples:
            raise StatusError(StatusNumber.OVERWRITTEN)
        try:
            codes = self._driver.hub.readings(start, count, request.timeout, due)
        except LookupError:
            raise StatusError(StatusNumber.OVERWRITTEN) from None
        if codes is None:
            raise StatusError(StatusNumber.LATE)
        if self._driver.hub.acquired - start > max(task.buffer_samples, count):
            raise StatusError(StatusNumber.OVERWRITTEN)
        task.position = start + count
        return {"read_array": self._volts(task, codes).ravel(), "samps_per_chan_read": count}

    def _volts(self, task: Task, codes: NDArray[np.int16]) -> NDArray[np.float64]:
        """Of each channel of the task; where nothing is connected, 0 V."""
        volts = np.zeros((len(task.channels), len(codes)))
        for row, channel in enumerate(task.channels):
            if channel in _MONITORS:
                volts[row] = codes[:, _MONITORS.index(channel)] * self._driver.hub.volt_per_code
        return volts

    def _latched(self, task: Task) -> list[int]:
        """What a counter showed at each edge of its sample clock."""
        if math.isnan(task.armed_s) or not task.clock.endswith(f"/{EXPOSURE_LINE}"):
            return []
        ticks_hz = self._device.timebases.get(task.counted.rpartition("/")[2], 0.0)
        later_s = 0.0 if task.rising else self._driver.hub.exposure_s
        begun_s = self._driver.hub.exposed_from(task.exposures)
        task.exposures += len(begun_s)
        for time_s in begun_s:
            since_s = time_s + later_s - task.armed_s
            if since_s >= 0.0:
                task.latched.append(int(since_s * ticks_hz) % _ROUND)
        return task.latched

    def _read_counter(self, request: Any) -> dict[str, Any]:
        task, count = self._driver.task(request), request.num_samps_per_chan
        if count < 0 or task.kind != "edges":
            raise StatusError(StatusNumber.BAD_VALUE)
        latched, start = self._latched(task) if task.running else [], task.position + task.offset
        if start < 0 or (len(latched) - start > max(task.asked_samples, 1) and task.overwrites):
            raise StatusError(StatusNumber.OVERWRITTEN)
        found = latched[start : start + count]
        if len(found) < count:
            raise StatusError(StatusNumber.LATE)
        task.position = start + count
        return {"read_array": found, "samps_per_chan_read": count}
