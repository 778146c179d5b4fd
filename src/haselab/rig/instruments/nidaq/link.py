"""Connect to an NI board by the local driver or NI's gRPC server, and explain its errors."""

from __future__ import annotations

import contextlib
import functools
import random
import re
import threading
import time
from collections.abc import Iterator
from typing import Any

from haselab.base import DeviceError, HaselabError, InputError
from haselab.rig.drivers import load_driver, quietly
from haselab.rig.instruments.nidaq.section import NidaqConfig

__all__ = ["NidaqLink", "key_of"]

_LATE_READ = "samples were overwritten before they were read, because the computer was late"
_RAN_OUT = -200290
_TOO_FAST = -200332
_FULL_V = 10.0  # range of the analogue outputs
_END = re.compile(r"(Source|Destination) Terminal:")  # of a route, in DAQmx's text
_ROUTE = "the device cannot route a required signal"
_ROUTE_ADVICE = "Change the terminals and counters of the rig file, or use another device."
_NO_CLOCK = "the output's buffer is full, because its clock has stopped"
_NO_CLOCK_ADVICE = (
    "If another program, such as 'haselab rig safe', has reset the board, start this program "
    "again; otherwise check daq.counter."
)
# Longest random pause after each failed attempt to shut down: another program may do it as well.
_PAUSES_S = (0.01, 0.02, 0.04, 0.08, 0.16, 0.32)
_RETRY_S = 0.7
_CHANCE = random.SystemRandom()  # programs with one seed must not wait equally long
_SILENT_S = 2e-3  # timeout after a server has not replied once, so that the guardian acts soon
# DAQmx status: meaning, what to do.
_EXPLANATIONS = {
    -200279: (_LATE_READ, "Close other programs, or raise daq.buffer_s."),
    -200222: (_LATE_READ, "Close other programs, or raise daq.buffer_s."),
    -200361: (
        "the device's memory overflowed, because the bus was late",
        "Use a separate USB port.",
    ),
    _RAN_OUT: (
        "an output did not arrive in time, because the computer was late",
        "Close other programs, or raise daq.ahead_blocks.",
    ),
    -200284: (
        "no samples arrived in time: the sample clock or a USB device has stopped",
        "Check the device and its cable, then open the rig again.",
    ),
    -200220: (
        "the device does not exist",
        "Set daq.device to the name that NI MAX or nilsdev shows.",
    ),
    -200170: ("the device has no such channel", "Change the channels of section daq."),
    _TOO_FAST: ("the rate exceeds the device's limit for two channels", "Lower daq.rate_hz."),
    -200077: (
        "a setting is outside the device's limits",
        "Change channels, wiring, range and rate of section daq.",
    ),
    -200292: (_NO_CLOCK, _NO_CLOCK_ADVICE),
    -200293: (_NO_CLOCK, _NO_CLOCK_ADVICE),
    -200462: (
        "an output was started without values",
        "This is a bug in haselab. Please report it.",
    ),
    -200547: (
        "an output was written to a buffer of unknown size",
        "This is a bug in haselab. Please report it.",
    ),
    -200609: (
        "the output's buffer is too small to start",
        "This is a bug in haselab. Please report it.",
    ),
    -89120: (
        "the device has no such terminal",
        "Change exposure.input, daq.counter or exposure.counter.",
    ),
    -89125: (_ROUTE, _ROUTE_ADVICE),
    -89136: (_ROUTE, _ROUTE_ADVICE),
    -89137: (
        "a required route is in use",
        "Close other programs that use the device, or choose another counter.",
    ),
    -89139: (_ROUTE, _ROUTE_ADVICE),
    -50103: (
        "the device is reserved by a program, possibly one that crashed",
        "Close that program; if there is none, run: haselab rig safe RIG.toml",
    ),
    -201003: ("the device does not respond", "Check its cable and its power."),
}


def key_of(serial_number: str) -> str:
    """Interlock key of an NI device on this computer.

    Args:
        serial_number: hexadecimal.
    """
    return f"NI {int(serial_number, 16):08X}"


class NidaqLink:
    """Connection to one device; makes tasks and closes them.

    Args:
        config: section `daq` of the rig file.
    Raises:
        DeviceError: Driver, server or device is missing.
    """

    def __init__(self, config: NidaqConfig) -> None:
        self._config = config
        self._stack, self._tasks = contextlib.ExitStack(), contextlib.ExitStack()
        self._nidaqmx = load_driver("nidaqmx", "The NI board")
        self.constants = load_driver("nidaqmx.constants", "The NI board")
        self._errors = load_driver("nidaqmx.errors", "The NI board")
        self._channel: Any = None
        # threads whose timeouts are ignored, see `ignore_silence`
        self._ignoring = threading.local()
        if config.server is not None:
            grpc = load_driver("grpc", "NI's gRPC device server")
            channel = grpc.insecure_channel(config.server)
            self._stack.callback(quietly, channel.close)
            timeouts = _with_timeouts(grpc, config, self._ignoring)
            self._channel = grpc.intercept_channel(channel, timeouts)
        with self.translated_errors():
            device = self._device()
            self.product = str(device.product_type)
            self.serial_number = f"{int(device.serial_num):08X}"

    @property
    def key(self) -> str:
        """Interlock key of the device, see `key_of`."""
        return key_of(self.serial_number)

    @functools.cached_property
    def usb(self) -> bool:
        """Whether samples come over USB, late and in packets."""
        with self.translated_errors():
            return bool(self._device().bus_type is self.constants.BusType.USB)

    @functools.cached_property
    def simultaneous(self) -> bool:
        """Whether each input has its own converter."""
        with self.translated_errors():
            return bool(self._device().ai_simultaneous_sampling_supported)

    @property
    def identity(self) -> str:
        """Product and serial number."""
        return f"{self.product}, serial number {self.serial_number}"

    def ignore_silence(self) -> None:
        """Ignore timeouts of this thread's calls, so that they do not shorten those of others."""
        self._ignoring.timeouts = True

    def _options(self, name: str) -> dict[str, Any]:
        if self._channel is None:
            return {}
        return {"grpc_options": self._nidaqmx.GrpcSessionOptions(self._channel, name)}

    def _device(self) -> Any:
        system = load_driver("nidaqmx.system.device", "The NI board")
        return system.Device(self._config.device, **self._options(""))

    def check_serial(self) -> None:
        """Check that the device is the one that the rig file names.

        Raises:
            InputError: The serial number differs.
        """
        wanted = self._config.serial_number
        if wanted is not None and int(wanted, 16) != int(self.serial_number, 16):
            raise InputError(
                f"{self._config.device} has the serial number {self.serial_number}, but the rig "
                f"file names {wanted}. Connect that device, or change daq.serial_number."
            )

    def task(self) -> Any:
        """Create a task, which is closed with the link."""
        task = self._nidaqmx.Task(**self._options(""))
        self._tasks.callback(quietly, task.close)
        return task

    def reader(self, task: Any) -> Any:
        """Create a reader of all channels of a task into one array."""
        readers = load_driver("nidaqmx.stream_readers", "The NI board")
        reader = readers.AnalogMultiChannelReader(task.in_stream)
        reader.verify_array_shape = False  # it would query the device for every block
        return reader

    def counter_reader(self, task: Any) -> Any:
        """Create a reader of the only counter of a task."""
        readers = load_driver("nidaqmx.stream_readers", "The NI board")
        reader = readers.CounterReader(task.in_stream)
        reader.verify_array_shape = False
        return reader

    def writer(self, task: Any, *, auto_start: bool) -> Any:
        """Create a writer of the only channel of a task."""
        writers = load_driver("nidaqmx.stream_writers", "The NI board")
        writer = writers.AnalogSingleChannelWriter(task.out_stream, auto_start=auto_start)
        writer.verify_array_shape = False
        return writer

    def is_late_output(self, error: Exception) -> bool:
        """Whether a driver error means that an output did not arrive in time."""
        return isinstance(error, self._errors.DaqError) and int(error.error_code) == _RAN_OUT

    def reset(self) -> None:
        """Abort all tasks of all programs on the device; its outputs go to their power-up state.

        Raises:
            DeviceError: The device does not reply.
        """
        with self.translated_errors():
            self._device().reset_device()

    def shut_down(self) -> None:
        """Reset the device, then put out 0 V, since its power-up state may be another voltage.

        Several programs may shut the device down at the same time, and each reset aborts the tasks
        of the others. A failed attempt is therefore repeated after a random pause.

        Raises:
            DeviceError: No attempt succeeded.
        """
        begun_s = time.monotonic()
        with self.translated_errors():
            for longest_s in _PAUSES_S:
                try:
                    self._reset_to_zero()
                except self._errors.DaqError:
                    if time.monotonic() > begun_s + _RETRY_S:  # a device that is slow to fail
                        raise
                    time.sleep(_CHANCE.uniform(0.0, longest_s))
                else:
                    return
            self._reset_to_zero()

    def _reset_to_zero(self) -> None:
        self._device().reset_device()
        task = self.task()
        output = f"{self._config.device}/{self._config.output}"
        task.ao_channels.add_ao_voltage_chan(output, min_val=-_FULL_V, max_val=_FULL_V)
        try:
            self.writer(task, auto_start=True).write_one_sample(0.0)
        finally:
            task.stop()  # the output stays, and is free for other programs

    def close(self) -> None:
        """Close tasks and connection. Never raises."""
        self.close_tasks()
        self._stack.close()

    def close_tasks(self) -> None:
        """Close all tasks; the connection stays. Never raises."""
        self._tasks.close()

    @contextlib.contextmanager
    def translated_errors(self) -> Iterator[None]:
        """Translate the driver's errors into one line with advice."""
        try:
            yield
        except HaselabError:
            raise
        except self._errors.DaqNotFoundError:
            raise DeviceError(
                "The NI-DAQmx driver is not installed on this computer. Install it from ni.com, or "
                "set daq.server to a computer that has it."
            ) from None
        except self._errors.DaqError as error:
            code = int(error.error_code)
            what, advice = self._explain(code, str(error))
            raise DeviceError(
                f"NI board {self._config.device}: {what} (status {code}). {advice}"
            ) from None
        except self._errors.Error as error:
            text = str(error).partition("\n")[0]
            raise DeviceError(
                f"NI board {self._config.device} does not reply ({text}). Start the device "
                f"server, or change daq.server. {self._config.server or 'local driver'}"
            ) from None

    def _explain(self, code: int, text: str) -> tuple[str, str]:
        """Return what a status means here, and what to do."""
        what, advice = _EXPLANATIONS.get(code, (text.partition("\n")[0], "See NI's error list."))
        ends = [line.partition(":")[2].strip() for line in text.splitlines() if _END.match(line)]
        if len(ends) == 2:
            what = f"{what}, {ends[0]} to {ends[1]}"
        if code == _TOO_FAST:
            rates_hz: list[float] = []
            quietly(lambda: rates_hz.append(float(self._device().ai_max_multi_chan_rate)))
            for rate_hz in rates_hz:
                each_hz = rate_hz if self.simultaneous else rate_hz / 2.0
                limit = f"the {self.product}'s limit of {each_hz:g} Hz for two channels"
                what = f"the rate exceeds {limit}"
                advice = (
                    f"daq.rate_hz is {self._config.rate_hz:g}. Lower it to {each_hz:g} or less."
                )
        return what, advice


def _with_timeouts(grpc: Any, config: NidaqConfig, ignoring: threading.local) -> Any:
    """Make an interceptor that ends calls to which a server does not reply in time."""

    class Timeouts(grpc.UnaryUnaryClientInterceptor):  # type: ignore[misc]
        silent = False  # at the last call

        def intercept_unary_unary(self, go_on: Any, call: Any, request: Any) -> Any:
            asked_s = max(float(getattr(request, "timeout", 0.0)), 0.0)
            limit_s = asked_s + config.server_patience_s
            if self.silent:
                limit_s = min(limit_s, _SILENT_S)
            answer = go_on(call._replace(timeout=limit_s), request)
            late = answer.code() is grpc.StatusCode.DEADLINE_EXCEEDED
            if not getattr(ignoring, "timeouts", False):
                self.silent = late
            return answer

    return Timeouts()
