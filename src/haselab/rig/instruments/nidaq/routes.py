"""Check that an NI board accepts every task of a bench, without changing an output."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

from haselab.base import DeviceError, InputError
from haselab.rig.drivers import quietly
from haselab.rig.instruments.nidaq.exposures import ExposureCounter
from haselab.rig.instruments.nidaq.link import NidaqLink
from haselab.rig.instruments.nidaq.section import NidaqConfig
from haselab.rig.instruments.nidaq.tasks import NidaqTasks
from haselab.rig.instruments.sections import ExposureConfig

__all__ = ["RouteStatus", "verify_routes"]


class RouteStatus(NamedTuple):
    """Whether a device accepts one task.

    Args:
        task: inputs, block clock, output, exposure counter; or channel skew.
        fault: one line with DAQmx's status and what to do; empty if it accepts it.
        skew_s: in the row channel skew the device's skew, in s; None: not reported.
    """

    task: str
    fault: str
    skew_s: float | None = None

    @property
    def ok(self) -> bool:
        """Whether the device accepts the task."""
        return not self.fault


def verify_routes(
    daq: NidaqConfig, exposure: ExposureConfig | None = None, link: NidaqLink | None = None
) -> list[RouteStatus]:
    """Create all tasks of a bench; verify, reserve and commit each; then release them.

    No value is written and no task is started, so no output changes.

    Args:
        daq: section `daq` of the rig file.
        exposure: section `exposure`; None: there is none.
        link: to the device, which no task of this program may use; None: it is made here.
    Returns:
        One row per task, in the order in which a bench creates them. A refusal before a task could
        be created is in its row.
    Raises:
        DeviceError: Driver, server or device is missing.
        InputError: The sample rate does not divide the counters' timebase.
    Example:
        `[row for row in verify_routes(file.daq, file.exposure) if not row.ok]`
    """
    opened = link or NidaqLink(daq)
    made: list[Any] = []
    try:
        tasks = NidaqTasks(opened, daq)
        inputs: list[Any] = []

        def both_inputs() -> Any:
            inputs.append(tasks.inputs())
            return inputs[0]

        makers: list[tuple[str, Callable[[], Any]]] = [
            ("inputs", both_inputs),
            ("block clock", tasks.clock),
            ("output", tasks.stream),
        ]
        if exposure is not None:
            makers.append(("exposure counter", lambda: ExposureCounter(opened, daq, exposure).task))
        rows = [RouteStatus(name, _fault(opened, make, made)) for name, make in makers]
        if rows[0].ok:
            fault = _fault_of(lambda: tasks.check_skew(inputs[0]))
            rows.append(RouteStatus("channel skew", fault, tasks.skew_s(inputs[0])))
        return rows
    finally:
        for task in made:
            quietly(functools.partial(task.control, opened.constants.TaskMode.TASK_UNRESERVE))
        if link is None:
            opened.close()


def _fault(link: NidaqLink, make: Callable[[], Any], made: list[Any]) -> str:
    modes = link.constants.TaskMode

    def take() -> None:
        with link.translated_errors():
            task = make()
            made.append(task)
            for mode in (modes.TASK_VERIFY, modes.TASK_RESERVE, modes.TASK_COMMIT):
                task.control(mode)

    return _fault_of(take)


def _fault_of(act: Callable[[], object]) -> str:
    try:
        act()
    except (DeviceError, InputError) as error:
        return str(error)
    return ""
