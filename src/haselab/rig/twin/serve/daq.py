"""The twin as an NI board behind NI's gRPC device server.

It knows what a client of two inputs, one output and a counter needs, with the driver's refusals.
"""

from __future__ import annotations

import itertools
import secrets
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

from haselab.rig.drivers import load_driver
from haselab.rig.twin.serve.hub import TICKS, TwinHub
from haselab.rig.twin.serve.local_user import LocalUserFilter

__all__ = ["DEVICE", "PRODUCT", "DaqServer"]

DEVICE, PRODUCT = "Dev1", "USB-6212"
_FASTEST_HZ = 400e3  # readings per second over all channels
_OUTPUT_RANGE_V = 10.0
_VERSION = {0x1272: 26, 0x1923: 0, 0x2F22: 0}
_PRODUCT_TYPE, _SERIAL_NUM = 0x631, 0x632
_OFFSET, _ACQUIRED, _GENERATED, _TASK_NAME = 0x190B, 0x192A, 0x192B, 0x1276
_AVAILABLE, _EDGES_TERM, _UNRESERVE = 0x1223, 0x18C7, 5
_ROUND = 1 << 32  # of a counter
EXPOSURE_LINE = "PFI0"
_OVERWRITTEN, _LATE, _NO_DEVICE, _NO_CHANNEL = -200279, -200284, -200220, -200170
_RESERVED, _TOO_FAST, _TOO_HIGH, _NO_TASK, _BAD_VALUE = -50103, -200332, -200561, -200088, -200077
_THREADS = 8
_MOST_TASKS, _MOST_WRITTEN = 64, 100_000  # what a client may leave in the server
_LONGEST_WAIT_S = 600.0
_OTHER_USER = (
    "Another user of this computer runs this server. Start your own, or have it started with "
    "--allow-other-users."
)
_WORDS = {
    _OVERWRITTEN: "The application is not able to keep up with the hardware acquisition.",
    _LATE: "Some or all of the samples requested have not yet been acquired.",
    _NO_DEVICE: "Device identifier is invalid.",
    _NO_CHANNEL: "Physical channel specified does not exist on this device.",
    _RESERVED: "The specified resource is reserved.",
    _TOO_FAST: "Sample rate exceeds the maximum for the number of channels.",
    _TOO_HIGH: "Attempted writing analog data that is too large or too small.",
    _BAD_VALUE: "Requested value is not supported by the device.",
    _NO_TASK: "Task specified is invalid or does not exist.",
    -200290: "The generation has stopped to prevent the regeneration of old samples.",
}


@dataclass
class _Task:
    """What the server remembers of a task.

    Args:
        name: of the session.
        kind: of its channels, empty before the first.
        channels: how many.
        clocked: a sample clock has been configured.
        first: initial delay of a counter, in ticks.
        period: of a counter, in ticks.
        running: between start and stop.
        position: samples read of each channel.
        offset: samples to pass over at each read.
        written: values waiting for the start.
    """

    name: str
    kind: str = ""
    channels: int = 0
    clocked: bool = False
    first: int = 0
    period: int = 0
    running: bool = False
    committed: bool = False  # by a write or a start; stopped it still holds what it has reserved
    position: int = 0
    offset: int = 0
    written: list[float] = field(default_factory=list)


class _StatusError(Exception):
    """A DAQmx status that the call ends with."""

    def __init__(self, code: int) -> None:
        super().__init__(_WORDS.get(code, "DAQmx error"))
        self.code = code


class _Board:
    """The calls of NI's service that the client makes; `calls` has them by their names there."""

    def __init__(self, hub: TwinHub, serial_number: int) -> None:
        self._hub, self._serial_number = hub, serial_number
        self._pb = load_driver("nidaqmx._stubs.nidaqmx_pb2", "The served board")
        self._session = load_driver("session_pb2", "The served board")
        self._tasks: dict[int, _Task] = {}
        self._ids = itertools.count(1)
        self.calls: dict[str, Callable[[Any], dict[str, Any]]] = {
            "GetSystemInfoAttributeUInt32": self._system_info,
            "GetDeviceAttributeString": self._device_text,
            "GetDeviceAttributeUInt32": self._device_number,
            "ResetDevice": self._reset,
            "CreateTask": self._create,
            "ClearTask": self._clear,
            "CreateAIVoltageChan": self._add_input,
            "CreateAOVoltageChan": self._add_output,
            "CreateCOPulseChanTicks": self._add_counter,
            "CreateCICountEdgesChan": self._add_edges,
            "SetChanAttributeString": self._set_terminal,
            "CfgSampClkTiming": self._set_rate,
            "CfgImplicitTiming": lambda request: self._known(request),
            "SetReadAttributeInt32": self._set_read,
            "SetWriteAttributeInt32": lambda request: self._known(request),
            "GetReadAttributeUInt64": self._get_acquired,
            "GetWriteAttributeUInt64": self._get_generated,
            "GetReadAttributeUInt32": self._read_number,
            "GetWriteAttributeUInt32": self._count_channels,
            "GetTaskAttributeUInt32": self._count_channels,
            "GetTaskAttributeString": self._task_text,
            "GetPhysicalChanAttributeString": lambda request: {"value": ""},
            "StartTask": self._start,
            "StopTask": self._stop,
            "TaskControl": self._control,
            "WriteAnalogF64": lambda request: {
                "samps_per_chan_written": self._write(request, list(request.write_array))
            },
            "WriteAnalogScalarF64": self._write_one,
            "ReadAnalogF64": self._read,
            "ReadCounterU32Ex": self._read_counter,
        }

    def reply(self, name: str, request: Any) -> Any:
        """The answer to one call.

        Raises:
            _StatusError: the driver would refuse it.
        """
        return getattr(self._pb, f"{name}Response")(**self.calls[name](request))

    # ---- device --------------------------------------------------------------------------------

    def _system_info(self, request: Any) -> dict[str, Any]:
        return {"value": _VERSION.get(request.attribute_raw, 0)}

    def _device_text(self, request: Any) -> dict[str, Any]:
        self._check_device(request.device_name)
        return {"value": PRODUCT if request.attribute_raw == _PRODUCT_TYPE else ""}

    def _device_number(self, request: Any) -> dict[str, Any]:
        self._check_device(request.device_name)
        return {"value": self._serial_number if request.attribute_raw == _SERIAL_NUM else 0}

    def _reset(self, request: Any) -> dict[str, Any]:
        self._check_device(request.device_name)
        for task in self._tasks.values():
            task.running = task.committed = False
        self._hub.stream(False)
        self._hub.run_clock(0, 0)
        self._hub.stop_inputs()
        self._hub.set_output(0.0)
        return {}

    @staticmethod
    def _check_device(name: str) -> None:
        if name != DEVICE:
            raise _StatusError(_NO_DEVICE)

    # ---- tasks ---------------------------------------------------------------------------------

    def _known(self, request: Any) -> dict[str, Any]:
        self._task(request)
        return {}

    def _task(self, request: Any) -> _Task:
        if request.task.id not in self._tasks:
            raise _StatusError(_NO_TASK)
        return self._tasks[request.task.id]

    def _create(self, request: Any) -> dict[str, Any]:
        if len(self._tasks) >= _MOST_TASKS:
            raise _StatusError(_RESERVED)
        number = next(self._ids)
        name = request.session_name or f"_unnamed{number}"
        self._tasks[number] = _Task(name)
        return {
            "task": self._session.Session(name=name, id=number),
            "new_session_initialized": True,
        }

    def _clear(self, request: Any) -> dict[str, Any]:
        task = self._task(request)
        self._halt(task)
        del self._tasks[request.task.id]
        return {}

    def _add(self, request: Any, kind: str, name: str, known: tuple[str, ...]) -> dict[str, Any]:
        device, _, channel = name.partition("/")
        self._check_device(device)
        if channel not in known:
            raise _StatusError(_NO_CHANNEL)
        task = self._task(request)
        task.kind = kind
        task.channels += 1
        return {}

    def _add_input(self, request: Any) -> dict[str, Any]:
        return self._add(request, "inputs", request.physical_channel, ("ai0", "ai1"))

    def _add_output(self, request: Any) -> dict[str, Any]:
        return self._add(request, "output", request.physical_channel, ("ao0",))

    def _add_counter(self, request: Any) -> dict[str, Any]:
        task = self._task(request)
        first, period = request.initial_delay, request.low_ticks + request.high_ticks
        if first < 0 or period <= 0 or first % TICKS or period % TICKS:
            raise _StatusError(_BAD_VALUE)
        task.first, task.period = first, period
        return self._add(request, "clock", request.counter, ("ctr0",))

    def _add_edges(self, request: Any) -> dict[str, Any]:
        return self._add(request, "exposures", request.counter, ("ctr1",))

    def _set_terminal(self, request: Any) -> dict[str, Any]:
        self._task(request)
        if (request.attribute_raw, request.value) != (_EDGES_TERM, f"/{DEVICE}/ai/SampleClock"):
            raise _StatusError(_BAD_VALUE)
        return {}

    def _set_rate(self, request: Any) -> dict[str, Any]:
        task = self._task(request)
        if task.kind == "inputs" and task.channels * request.rate > _FASTEST_HZ:
            raise _StatusError(_TOO_FAST)
        if task.kind == "inputs" and request.rate != self._hub.rate_hz:
            raise _StatusError(_BAD_VALUE)
        if task.kind == "exposures" and request.source != f"/{DEVICE}/{EXPOSURE_LINE}":
            raise _StatusError(_BAD_VALUE)
        task.clocked = True
        return {}

    def _set_read(self, request: Any) -> dict[str, Any]:
        task = self._task(request)
        if request.attribute_raw == _OFFSET:
            task.offset = request.value_raw
        return {}

    def _get_acquired(self, request: Any) -> dict[str, Any]:
        task = self._task(request)
        if request.attribute_raw != _ACQUIRED:
            raise _StatusError(_BAD_VALUE)
        return {"value": self._hub.acquired if task.running else 0}

    def _get_generated(self, request: Any) -> dict[str, Any]:
        if request.attribute_raw != _GENERATED or not self._task(request).clocked:
            raise _StatusError(_BAD_VALUE)
        if self._hub.output_status:
            raise _StatusError(self._hub.output_status)
        return {"value": self._hub.put_out}

    def _read_number(self, request: Any) -> dict[str, Any]:
        if request.attribute_raw != _AVAILABLE:
            return self._count_channels(request)
        task = self._task(request)
        return {"value": len(self._hub.exposed_since(task.position)) if task.running else 0}

    def _read_counter(self, request: Any) -> dict[str, Any]:
        task = self._task(request)
        if request.num_samps_per_chan < 0:
            raise _StatusError(_BAD_VALUE)
        found = self._hub.exposed_since(task.position)[: request.num_samps_per_chan]
        if len(found) < request.num_samps_per_chan:
            raise _StatusError(_LATE)
        task.position += len(found)
        counted = [number % _ROUND for number in found]
        return {"read_array": counted, "samps_per_chan_read": len(found)}

    def _count_channels(self, request: Any) -> dict[str, Any]:
        return {"value": self._task(request).channels}

    def _task_text(self, request: Any) -> dict[str, Any]:
        task = self._task(request)
        return {"value": task.name if request.attribute_raw == _TASK_NAME else ""}

    def _start(self, request: Any) -> dict[str, Any]:
        task = self._task(request)
        self._reserve(task)
        task.running = True
        if task.kind == "inputs":
            task.position = 0
            self._hub.start_inputs()
        elif task.kind == "clock":
            self._hub.run_clock(task.first, task.period)
        elif task.clocked:
            self._hub.queue_output(task.written)
            self._hub.stream(True)
            task.written = []
        return {}

    def _reserve(self, task: _Task) -> None:
        others = (t for t in self._tasks.values() if t is not task and t.kind == task.kind)
        if any(t.running or t.committed for t in others):
            raise _StatusError(_RESERVED)

    def _stop(self, request: Any) -> dict[str, Any]:
        self._halt(self._task(request))
        return {}

    def _control(self, request: Any) -> dict[str, Any]:
        if request.action_raw != _UNRESERVE:
            raise _StatusError(_BAD_VALUE)
        task = self._task(request)
        self._halt(task)
        task.committed = False
        task.written = []
        return {}

    def _halt(self, task: _Task) -> None:
        if not task.running:
            return
        task.running = False
        if task.kind == "inputs":
            self._hub.stop_inputs()
        elif task.kind == "clock":
            self._hub.run_clock(0, 0)
        elif task.clocked:
            self._hub.stream(False)

    # ---- samples -------------------------------------------------------------------------------

    def _write_one(self, request: Any) -> dict[str, Any]:
        self._write(request, [request.value])
        return {}

    def _write(self, request: Any, values: list[float]) -> int:
        task = self._task(request)
        if not values or len(task.written) + self._hub.queued + len(values) > _MOST_WRITTEN:
            raise _StatusError(_BAD_VALUE)
        if any(not abs(value) <= _OUTPUT_RANGE_V for value in values):
            raise _StatusError(_TOO_HIGH)
        if not task.clocked:
            self._reserve(task)
            task.running = True
            self._hub.set_output(values[-1])
        elif not task.running:
            self._reserve(task)
            task.committed = True
            task.written += values
        elif self._hub.output_status:
            raise _StatusError(self._hub.output_status)
        else:
            self._hub.queue_output(values)
        return len(values)

    def _read(self, request: Any) -> dict[str, Any]:
        task = self._task(request)
        start, count = task.position + task.offset, request.num_samps_per_chan
        if count <= 0 or not 0.0 <= request.timeout <= _LONGEST_WAIT_S:
            raise _StatusError(_BAD_VALUE)
        if start + count - self._hub.acquired > self._hub.buffer_samples:
            raise _StatusError(_LATE)
        try:
            codes = self._hub.readings(start, count, request.timeout)
        except LookupError:
            raise _StatusError(_OVERWRITTEN) from None
        if codes is None:
            raise _StatusError(_LATE)
        task.position = start + count
        volts = (codes.T * self._hub.volt_per_code).ravel()
        return {"read_array": volts, "samps_per_chan_read": count}


def _address(peer: str) -> tuple[str, int]:
    """A client as gRPC names it, "ipv4:127.0.0.1:40000"; one that has gone has no address."""
    _, _, address = peer.partition(":")
    host, _, port = address.rpartition(":")
    return host, int(port) if port.isascii() and port.isdigit() else 0


class DaqServer:
    """Serves a hub's inputs and output on a loopback port.

    Args:
        hub: the bench.
        port: 0: any free one.
        allow_others: also serve clients of other users of this computer.
    Raises:
        DeviceError: nidaqmx with gRPC is not installed.
    """

    def __init__(self, hub: TwinHub, port: int = 0, *, allow_others: bool = False) -> None:
        grpc = load_driver("grpc", "The served board")
        stubs = load_driver("nidaqmx._stubs.nidaqmx_pb2_grpc", "The served board")
        # Each served board is another device: what was latched for one is not for the next.
        self.serial_number = secrets.randbits(31) | 1
        board = _Board(hub, self.serial_number)

        def method(name: str) -> Callable[[Any, Any, Any], Any]:
            def call(_servicer: Any, request: Any, context: Any) -> Any:
                if not self._gate.admits_call(_address(context.peer())):
                    return context.abort(grpc.StatusCode.PERMISSION_DENIED, _OTHER_USER)
                try:
                    return board.reply(name, request)
                except _StatusError as error:
                    context.set_trailing_metadata((("ni-error", str(error.code)),))
                    return context.abort(grpc.StatusCode.UNKNOWN, str(error))

            return call

        servicer = type(
            "_Servicer", (stubs.NiDAQmxServicer,), {name: method(name) for name in board.calls}
        )
        self._pool = ThreadPoolExecutor(_THREADS)
        self._server = grpc.server(self._pool)
        stubs.add_NiDAQmxServicer_to_server(servicer(), self._server)
        port = self._server.add_insecure_port(f"127.0.0.1:{port}")
        self.address = f"127.0.0.1:{port}"
        self._gate = LocalUserFilter(port, allow_others=allow_others)
        self._server.start()

    def close(self) -> None:
        """Stop serving."""
        self._server.stop(grace=None).wait()
        self._pool.shutdown()
