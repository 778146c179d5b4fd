"""A task of the emulated NI driver: its contents, its resources and its states.

States and transitions follow NI-DAQmx Key Concepts, "Task State Model", "Operations That Require
State Transitions" and "Transitioning the State Backwards": a question about a property verifies a
task, a write commits it, a stop takes back what the start had done by the way.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

from haselab.rig.twin.serve.ni.devices import NiDevice, check_route
from haselab.rig.twin.serve.ni.status import StatusError, StatusNumber

__all__ = ["State", "Task", "default_buffer"]

_FEWEST_TICKS = 2


class State(IntEnum):
    """Of a task, each with all that is before it."""

    UNVERIFIED = 0
    VERIFIED = 1
    RESERVED = 2
    COMMITTED = 3
    RUNNING = 4


def default_buffer(rate_hz: float) -> int:
    """Samples that the driver keeps of each channel at least: NI-DAQmx Help, "Buffer Size"."""
    for highest_hz, samples in ((100.0, 1_000), (10e3, 10_000), (1e6, 100_000)):
        if rate_hz <= highest_hz:
            return samples
    return 1_000_000


@dataclass
class Task:
    """State of one task in the driver.

    Args:
        name: of the session.
        kind: of its channels: inputs, output, pulses, edges; empty before the first.
        channels: without the device.
        ticks: initial delay and period of a pulse train.
        counted: terminal whose edges are counted, or that a pulse train is divided from.
        rate_hz: of its sample clock; 0: it has none.
        clock: terminal that clocks it; empty: its own.
        rising: edge of that clock.
        start_trigger: terminal; empty: none.
        arm_trigger: the same of a counter's arm-start trigger.
        armed_by_edge: the arm-start trigger's type is a digital edge.
        asked_samples: of each channel, that it was configured for.
        overwrites: unread samples may be overwritten.
        regenerates: samples are put out again where no new ones come.
        buffer_size: of the output, in samples; 0: not known before the first write.
        state: where it is.
        before: where a stop takes it back to.
        position: samples read of each channel.
        offset: samples to pass over at each read.
        primed: values waiting for the start.
        written: values since the start.
        armed_s: time of the bench's life from which a counter counts; NaN: not yet.
        latched: what a counter showed at the edges of its sample clock.
        exposures: of the bench's life, that `latched` has seen.
    """

    name: str
    kind: str = ""
    channels: list[str] = field(default_factory=list)
    ticks: tuple[int, int] = (0, 0)
    counted: str = ""
    rate_hz: float = 0.0
    clock: str = ""
    rising: bool = True
    start_trigger: str = ""
    arm_trigger: str = ""
    armed_by_edge: bool = False
    asked_samples: int = 0
    overwrites: bool = False
    regenerates: bool = True
    buffer_size: int = 0
    state: State = State.UNVERIFIED
    before: State = State.UNVERIFIED
    position: int = 0
    offset: int = 0
    primed: list[float] = field(default_factory=list)
    written: int = 0
    armed_s: float = float("nan")
    latched: list[int] = field(default_factory=list)
    exposures: int = 0

    @property
    def running(self) -> bool:
        """Between start and stop."""
        return self.state is State.RUNNING

    @property
    def buffered(self) -> bool:
        """An output with a sample clock: its values wait in a buffer."""
        return self.kind == "output" and self.rate_hz > 0.0

    @property
    def trigger(self) -> str:
        """Terminal that a counter waits for; empty: it starts on command."""
        return self.start_trigger or (self.arm_trigger if self.armed_by_edge else "")

    @property
    def buffer_samples(self) -> int:
        """Of each channel of an input."""
        return max(self.asked_samples, default_buffer(self.rate_hz))

    def add(self, kind: str, channel: str) -> None:
        """Add a channel.

        Raises:
            StatusError: of another kind than the ones before.
        """
        if self.kind not in ("", kind):
            raise StatusError(StatusNumber.BAD_VALUE)
        self.kind = kind
        self.channels.append(channel)
        self.changed()

    def changed(self) -> None:
        """A setting has changed: it has to be verified again.

        Raises:
            StatusError: the task runs.
        """
        if self.running:
            raise StatusError(StatusNumber.RUNNING)
        if self.state is State.VERIFIED:
            self.state = State.UNVERIFIED

    def resources(self) -> set[str]:
        """What it takes for itself alone."""
        if self.kind == "inputs":
            return {"ai"}
        return {*self.channels} | ({"ao/SampleClock"} if self.buffered else set())

    def verify(self, device: NiDevice, name: str, refused: tuple[str, ...]) -> None:
        """Whether the device can do this.

        Args:
            device: the product.
            name: of the device.
            refused: broken routes, see `BoardFaults`.
        Raises:
            StatusError: it cannot.
        """
        if not self.channels:
            raise StatusError(StatusNumber.NO_CHANNELS_IN_TASK)
        for destination, source in self._routes(device).items():
            check_route(device, name, source, destination, refused)
        if self.kind == "inputs":
            highest_hz = device.allowed_rate_hz(len(self.channels))
        elif self.buffered:
            highest_hz = device.output_rate_hz
        else:
            highest_hz = float("inf")
        if self.rate_hz > highest_hz * (1.0 + 1e-9):
            raise StatusError(StatusNumber.TOO_FAST)
        fewest = min(self.ticks[0], self.ticks[1] // 2)
        if self.kind == "pulses" and not _FEWEST_TICKS <= fewest <= max(self.ticks) < 2**32:
            raise StatusError(StatusNumber.BAD_VALUE)

    def _routes(self, device: NiDevice) -> dict[str, str]:
        """Inputs of the device that this task uses, and what is to drive them."""
        wanted: dict[str, str] = {}
        if self.kind in ("pulses", "edges"):
            counter = f"C{self.channels[0][1:]}"
            wanted[f"{counter}Source"] = self.counted
            wanted[f"{counter}Gate"] = self.start_trigger
            wanted[f"{counter}ArmStartTrigger"] = self.arm_trigger if self.armed_by_edge else ""
            if self.rate_hz:
                wanted[f"{counter}{'Gate' if device.m_series else 'SampleClock'}"] = self.clock
        else:
            system = "ai" if self.kind == "inputs" else "ao"
            wanted[f"{system}/SampleClock"] = self.clock
            wanted[f"{system}/StartTrigger"] = self.start_trigger
        return {destination: source for destination, source in wanted.items() if source}
