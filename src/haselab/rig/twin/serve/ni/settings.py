"""The settings of an emulated NI device: properties, channels, timing, triggers, buffers."""

from __future__ import annotations

from typing import Any

from haselab.rig.twin.serve.ni.driver import DEVICE, NiDriver
from haselab.rig.twin.serve.ni.status import StatusError, StatusNumber
from haselab.rig.twin.serve.ni.tasks import State, Task

__all__ = ["NiSettings"]

_VERSION = {0x1272: 26, 0x1923: 0, 0x2F22: 0}
_TASK_NAME, _EDGES_TERM = 0x1276, 0x18C7
_OFFSET, _OVERWRITE, _OVERWRITE_ON = 0x190B, 0x1211, 10252
_REGENERATION, _REGENERATION_OFF = 0x1453, 10158
_OUTPUT_BUFFER, _INPUT_BUFFER, _FALLING, _DIFFERENTIAL = 0x186D, 0x186C, 10171, 10106
_ARM_TYPE, _ARM_EDGE, _ARM_SOURCE, _BY_EDGE = 0x1414, 0x1415, 0x1417, 10150
_START_DELAY, _CONVERT_DELAY = 0x1856, 0x1317
_RATE, _CONVERT_RATE, _TIMEBASE_RATE = 0x1344, 0x1848, 0x1303


class NiSettings:
    """Calls of NI's service that set or report something.

    Args:
        driver: whose tasks these are.
        serial_number: of the device.
    """

    def __init__(self, driver: NiDriver, serial_number: int) -> None:
        self._driver, self._device = driver, driver.device
        device = driver.device
        self._properties: dict[int, Any] = {
            0x631: device.product, 0x632: serial_number, 0x29A9: device.category,
            0x2326: device.bus, 0x298F: device.simultaneous, 0x22CA: False,
            0x298C: device.single_rate_hz, 0x298D: device.aggregate_rate_hz,
            0x2997: device.output_rate_hz,
            0x2A40: ", ".join(f"/{DEVICE}/{name}" for name in sorted(device.terminals())),
        }  # fmt: skip
        self.calls = {
            "GetSystemInfoAttributeUInt32": lambda r: {"value": _VERSION.get(r.attribute_raw, 0)},
            "GetDeviceAttributeString": lambda r: {"value": self._property(r, str)},
            "GetDeviceAttributeUInt32": lambda r: {"value": self._property(r, int)},
            "GetDeviceAttributeInt32": lambda r: {"value_raw": self._property(r, int)},
            "GetDeviceAttributeBool": lambda r: {"value": self._property(r, bool)},
            "GetDeviceAttributeDouble": lambda r: {"value": self._property(r, float)},
            "GetPhysicalChanAttributeString": lambda r: {"value": ""},
            "CreateAIVoltageChan": self._add_input,
            "CreateAOVoltageChan": self._add_output,
            "CreateCOPulseChanTicks": self._add_pulses,
            "CreateCICountEdgesChan": self._add_edges,
            "SetChanAttributeString": self._set_channel,
            "CfgSampClkTiming": self._set_clock,
            "CfgImplicitTiming": self._set_implicit,
            "CfgDigEdgeStartTrig": self._set_start_trigger,
            "SetTrigAttributeInt32": self._set_trigger_number,
            "SetTrigAttributeString": self._set_trigger_terminal,
            "GetTrigAttributeDouble": self._trigger_delay,
            "GetTimingAttributeDouble": self._timing,
            "SetBufferAttributeUInt32": self._set_buffer,
            "GetBufferAttributeUInt32": self._buffer,
            "SetReadAttributeInt32": self._set_read,
            "SetWriteAttributeInt32": self._set_write,
            "GetTaskAttributeUInt32": self._count_channels,
            "GetTaskAttributeString": self._task_text,
        }

    # ---- device --------------------------------------------------------------------------------

    def _property(self, request: Any, kind: type) -> Any:
        self._driver.check_device(request.device_name)
        value = self._properties.get(request.attribute_raw, kind())
        if not isinstance(value, kind):
            raise StatusError(StatusNumber.NOT_APPLICABLE)
        return value

    def _add(self, request: Any, kind: str, path: str, prefix: str, count: int) -> Task:
        device, _, channel = path.partition("/")
        self._driver.check_device(device)
        if channel not in [f"{prefix}{k}" for k in range(count)]:
            raise StatusError(StatusNumber.NO_CHANNEL)
        task = self._driver.task(request)
        task.add(kind, channel)
        return task

    def _add_input(self, request: Any) -> dict[str, Any]:
        path, count = request.physical_channel, self._device.inputs
        task = self._add(request, "inputs", path, "ai", count)
        # Differential pairs are ai0 and ai8 and so on: the second of a pair is none by itself.
        paired = not self._device.simultaneous and int(task.channels[-1][2:]) // 8 % 2
        if request.terminal_config_raw == _DIFFERENTIAL and paired:
            raise StatusError(StatusNumber.BAD_VALUE)
        return {}

    def _add_output(self, request: Any) -> dict[str, Any]:
        self._add(request, "output", request.physical_channel, "ao", self._device.outputs)
        return {}

    def _add_pulses(self, request: Any) -> dict[str, Any]:
        task = self._add(request, "pulses", request.counter, "ctr", self._device.counters)
        task.counted = request.source_terminal
        task.ticks = (request.initial_delay, request.low_ticks + request.high_ticks)
        return {}

    def _add_edges(self, request: Any) -> dict[str, Any]:
        self._add(request, "edges", request.counter, "ctr", self._device.counters)
        return {}

    def _set_channel(self, request: Any) -> dict[str, Any]:
        task = self._driver.task(request)
        if request.attribute_raw != _EDGES_TERM or task.kind != "edges":
            raise StatusError(StatusNumber.NOT_APPLICABLE)
        task.changed()
        task.counted = request.value
        return {}

    # ---- timing and triggers -------------------------------------------------------------------

    def _set_clock(self, request: Any) -> dict[str, Any]:
        task = self._driver.task(request)
        if not task.kind or not request.rate > 0.0 or request.samps_per_chan < 0:
            raise StatusError(StatusNumber.BAD_VALUE)
        task.changed()
        task.rate_hz, task.clock = request.rate, request.source
        task.rising = request.active_edge_raw != _FALLING
        task.asked_samples = request.samps_per_chan
        return {}

    def _set_implicit(self, request: Any) -> dict[str, Any]:
        if self._driver.task(request).kind != "pulses":
            raise StatusError(StatusNumber.NOT_APPLICABLE)
        return {}

    def _set_start_trigger(self, request: Any) -> dict[str, Any]:
        """A counter that counts has none: "Counter Triggering" of either manual."""
        task = self._driver.task(request)
        if task.kind in ("", "edges"):
            raise StatusError(StatusNumber.NOT_APPLICABLE)
        task.changed()
        task.start_trigger = request.trigger_source
        return {}

    def _counter_of(self, request: Any) -> Task:
        task = self._driver.task(request)
        if task.kind not in ("pulses", "edges"):
            raise StatusError(StatusNumber.NOT_APPLICABLE)
        task.changed()
        return task

    def _set_trigger_number(self, request: Any) -> dict[str, Any]:
        task = self._counter_of(request)
        if request.attribute_raw not in (_ARM_TYPE, _ARM_EDGE):
            raise StatusError(StatusNumber.NOT_APPLICABLE)
        if request.attribute_raw == _ARM_TYPE:
            task.armed_by_edge = request.value_raw == _BY_EDGE
        return {}

    def _set_trigger_terminal(self, request: Any) -> dict[str, Any]:
        task = self._counter_of(request)
        if request.attribute_raw != _ARM_SOURCE:
            raise StatusError(StatusNumber.NOT_APPLICABLE)
        task.arm_trigger = request.value
        return {}

    def _trigger_delay(self, request: Any) -> dict[str, Any]:
        task = self._driver.task(request)
        if request.attribute_raw != _START_DELAY or task.kind != "inputs":
            raise StatusError(StatusNumber.NOT_APPLICABLE)
        return {"value": float(self._device.start_ticks)}

    def _timing(self, request: Any) -> dict[str, Any]:
        """A question verifies the task: Key Concepts, "Operations That Require ..."."""
        task = self._driver.task(request)
        self._driver.raise_to(task, State.VERIFIED)
        if request.attribute_raw == _RATE:
            return {"value": task.rate_hz}
        if task.kind != "inputs":
            raise StatusError(StatusNumber.NOT_APPLICABLE)
        if request.attribute_raw == _TIMEBASE_RATE:
            return {"value": self._device.clock_hz}
        if self._device.simultaneous:
            raise StatusError(StatusNumber.NOT_APPLICABLE)
        if request.attribute_raw == _CONVERT_RATE:
            channels = len(task.channels)
            return {"value": self._device.convert_rate_hz(channels, task.rate_hz)}
        if request.attribute_raw == _CONVERT_DELAY:
            return {"value": float(self._device.convert_ticks)}
        raise StatusError(StatusNumber.NOT_APPLICABLE)

    # ---- buffers --------------------------------------------------------------------------------

    def _set_buffer(self, request: Any) -> dict[str, Any]:
        task = self._driver.task(request)
        if request.attribute_raw == _INPUT_BUFFER and task.kind == "inputs":
            task.changed()
            task.asked_samples = request.value
        elif request.attribute_raw == _OUTPUT_BUFFER and task.kind == "output":
            task.changed()
            task.buffer_size = request.value
        else:
            raise StatusError(StatusNumber.NOT_APPLICABLE)
        return {}

    def _buffer(self, request: Any) -> dict[str, Any]:
        task = self._driver.task(request)
        return {"value": task.buffer_samples if task.kind == "inputs" else task.buffer_size}

    def _set_write(self, request: Any) -> dict[str, Any]:
        task = self._driver.task(request)
        if request.attribute_raw == _REGENERATION:
            task.changed()
            task.regenerates = request.value_raw != _REGENERATION_OFF
        return {}

    def _set_read(self, request: Any) -> dict[str, Any]:
        task = self._driver.task(request)
        if request.attribute_raw == _OFFSET:
            task.offset = request.value_raw
        elif request.attribute_raw == _OVERWRITE:
            task.overwrites = request.value_raw == _OVERWRITE_ON
        return {}

    def _count_channels(self, request: Any) -> dict[str, Any]:
        return {"value": len(self._driver.task(request).channels)}

    def _task_text(self, request: Any) -> dict[str, Any]:
        name = self._driver.task(request).name
        return {"value": name if request.attribute_raw == _TASK_NAME else ""}
