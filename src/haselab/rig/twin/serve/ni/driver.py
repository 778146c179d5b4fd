"""The emulated NI driver: its tasks, their states, and their effect on the twin's bench.

The voltage monitor is at ai0, the current monitor at ai1, the amplifier at ao0 and the camera's
exposure line at PFI0; nothing is at the other terminals. The twin samples at its own rate only.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

from haselab.rig.drivers import load_driver
from haselab.rig.twin.serve.hub import TICKS, TwinHub
from haselab.rig.twin.serve.ni.bus import BoardFaults, Bus
from haselab.rig.twin.serve.ni.devices import NiDevice, check_route
from haselab.rig.twin.serve.ni.status import StatusError, StatusNumber
from haselab.rig.twin.serve.ni.tasks import State, Task

__all__ = ["DEVICE", "NiDriver"]

DEVICE = "Dev1"
_START, _STOP, _VERIFY, _COMMIT, _RESERVE, _UNRESERVE, _ABORT = range(7)
_FEWEST_VALUES = 2  # in an output buffer: DAQmxWriteRaw, note on buffered writes
_MOST_TASKS = 64  # that clients may leave in the server
_ORPHAN = {"ai", "ao0", "ctr0", "ctr1"}


class NiDriver:
    """One device and its tasks, which remain after their client has disconnected.

    Args:
        hub: the bench behind it.
        device: the product.
        faults: planted.
    """

    def __init__(self, hub: TwinHub, device: NiDevice, faults: BoardFaults) -> None:
        self.hub, self.device = hub, device
        self.bus = Bus(device, hub.rate_hz, faults)
        self._refused = faults.refuse_routes
        self._orphaned = set(_ORPHAN) if faults.orphaned_tasks else set()
        self._session = load_driver("session_pb2", "The served board")
        self._tasks: dict[int, Task] = {}
        self._ids = itertools.count(1)
        self.calls = {
            "ResetDevice": self._reset,
            "CreateTask": self._create,
            "ClearTask": self._clear,
            "StartTask": lambda request: self.run(self.task(request)),
            "StopTask": lambda request: self._stop(self.task(request)),
            "TaskControl": self._control,
        }

    def _reset(self, request: Any) -> dict[str, Any]:
        """All tasks are aborted and verified again (Key Concepts, "Aborting a Task"); 0 V."""
        self.check_device(request.device_name)
        self._orphaned = set()
        for task in self._tasks.values():
            self._halt(task)
            task.state = min(task.state, State.VERIFIED)
            task.primed = []
        self.hub.stream(False)
        self.hub.run_clock(0, 0)
        self.hub.stop_inputs()
        self.hub.set_output(0.0)
        return {}

    @staticmethod
    def check_device(name: str) -> None:
        """Refuse another device."""
        if name != DEVICE:
            raise StatusError(StatusNumber.NO_DEVICE)

    # ---- tasks ---------------------------------------------------------------------------------

    def task(self, request: Any) -> Task:
        """The task that a call is about."""
        if request.task.id not in self._tasks:
            raise StatusError(StatusNumber.NO_TASK)
        return self._tasks[request.task.id]

    def _create(self, request: Any) -> dict[str, Any]:
        if len(self._tasks) >= _MOST_TASKS:
            raise StatusError(StatusNumber.RESERVED)
        number = next(self._ids)
        name = request.session_name or f"_unnamed{number}"
        self._tasks[number] = Task(name)
        return {
            "task": self._session.Session(name=name, id=number),
            "new_session_initialized": True,
        }

    def _clear(self, request: Any) -> dict[str, Any]:
        self._halt(self.task(request))
        del self._tasks[request.task.id]
        return {}

    # ---- states --------------------------------------------------------------------------------

    def raise_to(self, task: Task, state: State) -> None:
        """Go through the states up to this one, as far as they have not been reached."""
        if task.state < State.VERIFIED:
            task.verify(self.device, DEVICE, self._refused)
            if task.kind == "inputs" and task.rate_hz != self.hub.rate_hz:
                raise StatusError(StatusNumber.BAD_VALUE)  # of this bench, see above
            task.state = State.VERIFIED
        if state >= State.RESERVED and task.state < State.RESERVED:
            taken = set(self._orphaned)
            for other in self._tasks.values():
                taken |= other.resources() if other.state >= State.RESERVED else set()
            if taken & task.resources():
                raise StatusError(StatusNumber.RESERVED)
        task.state = max(task.state, state)

    def run(self, task: Task) -> None:
        """Start a task."""
        if task.running:
            return
        before = task.state
        self.raise_to(task, State.COMMITTED)
        try:
            self._begin(task)
        except StatusError:
            task.state = before
            raise
        task.state, task.before = State.RUNNING, before

    def _begin(self, task: Task) -> None:
        task.position = task.offset = task.exposures = 0
        task.latched = []
        if task.kind == "inputs":
            self.bus.restart()
            self.hub.start_inputs(self._armed_clock())
            armed_s = self.hub.origin_s - self.device.first_sample_s
            for other in self._tasks.values():
                if other.running and other.kind == "edges" and math.isnan(other.armed_s):
                    other.armed_s = armed_s
        elif task.kind == "pulses" and not task.trigger:
            self.hub.run_clock(*self._in_samples(task))
        elif task.kind == "pulses":
            self._in_samples(task)
        elif task.kind == "edges":
            task.armed_s = math.nan if task.trigger else self.hub.bench.time_s
        elif task.buffered:
            self._begin_stream(task)

    def _begin_stream(self, task: Task) -> None:
        if not task.primed:
            raise StatusError(StatusNumber.BUFFER_EMPTY)
        if min(task.buffer_size, len(task.primed)) < _FEWEST_VALUES:
            raise StatusError(StatusNumber.BUFFER_TOO_SMALL)
        self.hub.spend(self.bus.write_samples)
        self.hub.queue_output(task.primed)
        self.hub.stream(True, tuple(task.primed) if task.regenerates else ())
        task.written, task.primed = len(task.primed), []

    def _armed_clock(self) -> tuple[int, int] | None:
        """Edges of the counter that the inputs' start sets going."""
        for task in self._tasks.values():
            if task.running and task.kind == "pulses" and task.trigger.endswith("ai/StartTrigger"):
                return self._in_samples(task)
        return None

    def _in_samples(self, task: Task) -> tuple[int, int]:
        """First edge and period of a pulse train in samples, which the twin's steps must suit."""
        source = check_route(
            self.device, DEVICE, task.counted, f"C{task.channels[0][1:]}Source"
        )  # fmt: skip
        if source not in self.device.timebases:
            return 0, 0  # nothing is at the other terminals
        ticks = self.device.timebases[source] / self.hub.rate_hz
        first, period = (count / ticks for count in task.ticks)
        if first % TICKS or period % TICKS:
            raise StatusError(StatusNumber.BAD_VALUE)
        return int(first), int(period)

    def _stop(self, task: Task) -> None:
        """Back to where it was before the start; reports an output that ran out."""
        if not task.running:
            return
        dry = self.hub.output_status if task.buffered else 0
        self._halt(task)
        task.state = task.before
        if dry:
            raise StatusError(dry)

    def _halt(self, task: Task) -> None:
        if not task.running:
            return
        task.state = State.COMMITTED
        if task.kind == "inputs":
            self.hub.stop_inputs()
        elif task.kind == "pulses":
            self.hub.run_clock(0, 0)
        elif task.buffered:
            self.hub.stream(False)

    def _control(self, request: Any) -> dict[str, Any]:
        task, action = self.task(request), request.action_raw
        states = {_VERIFY: State.VERIFIED, _RESERVE: State.RESERVED, _COMMIT: State.COMMITTED}
        if action in states:
            self.raise_to(task, states[action])
        elif action == _START:
            self.run(task)
        elif action == _STOP:
            self._stop(task)
        elif action in (_UNRESERVE, _ABORT):
            self._halt(task)
            task.state = min(task.state, State.VERIFIED)
            task.primed = []
        else:
            raise StatusError(StatusNumber.BAD_VALUE)
        return {}
