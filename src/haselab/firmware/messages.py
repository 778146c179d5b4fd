"""Messages of the wire: made by firmware/protocol/generate.py of protocol.toml."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import ClassVar

__all__ = [
    "COMMANDS",
    "TELEMETRY",
    "VERSION",
    "Ack",
    "Alarm",
    "ClearFault",
    "ConfirmArming",
    "Event",
    "Fault",
    "Hello",
    "Identity",
    "KeepAlive",
    "Reason",
    "RequestArming",
    "Result",
    "Run",
    "SetReference",
    "SetTelemetry",
    "State",
    "Status",
    "Stop",
    "Trace",
]

VERSION = 2


class State(IntEnum):
    """The safety state machine."""

    OFF = 0  # enable pin inactive, output 0
    ARMED = 1  # enable pin active, output 0, carrier on
    RUNNING = 2  # loop closed
    STOPPING = 3  # ramping down, then off or tripped
    TRIPPED = 4  # like off, until clear_fault


class Fault(IntEnum):
    """Why it tripped; latched until clear_fault."""

    NONE = 0
    BREAKDOWN = 1  # a monitor at the end of its range, or a collapsed level
    SENSING = 2  # no plausible strain in too many updates
    LINK = 3  # no message from the computer; the output was ramped down
    LATE = 4  # updates not completed; detected in the sampling interrupt
    NOT_FINITE = 5  # the drive was NaN or outside its limits: memory was damaged
    WATCHDOG = 6  # the watchdog reset the microcontroller
    BROWN_OUT = 7  # the supply dipped
    LOST_STATE = 8  # the state machine's memory was damaged
    WRONG_OUTPUT = 9  # the high voltage differs from the requested one


class Alarm(IntFlag):
    """Bits that the sampling interrupt sets."""

    RAIL = 1  # a monitor at the end of its range, or the level collapsed, while enabled
    LOST_SAMPLE = 2  # a conversion was lost or late
    LATE = 4  # updates are not completed


class Reason(IntFlag):
    """Why there is no strain: 1, 2 and 4 are from core/include/hs.h, others from the firmware."""

    AMPLITUDE_LOST = 1  # no carrier on one of the monitors
    PHASE_OUT = 2  # the phase is not that of a capacitor
    CLIPPED = 4  # a sample at the end of the converter's range
    SLIPPED = 16  # conversions were lost
    IMPLAUSIBLE = 128  # amplitude or capacitance beyond the calibrated range


class Event(IntEnum):
    """What an update received from the link."""

    NONE = 0
    ARM = 1  # both steps of arming were done
    RUN = 2
    SET_REFERENCE = 3
    ALIVE = 4
    STOP = 5
    CLEAR = 6


class Result(IntEnum):
    """Result of a command."""

    ACCEPTED = 0
    UNKNOWN = 1  # unknown command, or wrong length
    BAD_VERSION = 2  # send hello with this version first
    BAD_STATE = 3  # not possible in this state
    BAD_TOKEN = 4  # wrong or expired token
    BAD_VALUE = 5  # outside the compiled-in limits
    NOT_READY = 6  # no valid strain yet


@dataclass(frozen=True)
class Hello:
    """Connects with a version of this table, and restarts the sequence numbers; the reply is
    identity. Accepted only while the output is off.

    Args:
        version: of this table.
    """

    CODE: ClassVar[int] = 1
    LAYOUT: ClassVar[str] = "<H"

    version: int


@dataclass(frozen=True)
class RequestArming:
    """First of two steps; the ack contains a token that is valid for one second."""

    CODE: ClassVar[int] = 2
    LAYOUT: ClassVar[str] = "<"


@dataclass(frozen=True)
class ConfirmArming:
    """Second step: carrier on, enable pin active, drive 0 V.

    Args:
        token: from the ack of request_arming.
    """

    CODE: ClassVar[int] = 3
    LAYOUT: ClassVar[str] = "<H"

    token: int


@dataclass(frozen=True)
class Run:
    """Closes the loop. Refused until the strain is valid.

    Args:
        reference: desired strain.
    """

    CODE: ClassVar[int] = 4
    LAYOUT: ClassVar[str] = "<f"

    reference: float


@dataclass(frozen=True)
class SetReference:
    """New desired strain while the loop is closed; also keeps the link alive.

    Args:
        reference: desired strain.
    """

    CODE: ClassVar[int] = 5
    LAYOUT: ClassVar[str] = "<f"

    reference: float


@dataclass(frozen=True)
class KeepAlive:
    """Keeps the link alive, as set_reference does. After 150 ms without either, the output is
    ramped down."""

    CODE: ClassVar[int] = 6
    LAYOUT: ClassVar[str] = "<"


@dataclass(frozen=True)
class Stop:
    """Ramp down, then off."""

    CODE: ClassVar[int] = 7
    LAYOUT: ClassVar[str] = "<"


@dataclass(frozen=True)
class ClearFault:
    """From tripped to off, once the output is 0."""

    CODE: ClassVar[int] = 8
    LAYOUT: ClassVar[str] = "<"


@dataclass(frozen=True)
class SetTelemetry:
    """Sets how often status is sent, and whether every update is traced.

    Args:
        every: updates from one status to the next; 0: none.
        trace: 1: a trace at every update.
    """

    CODE: ClassVar[int] = 9
    LAYOUT: ClassVar[str] = "<BB"

    every: int
    trace: int


@dataclass(frozen=True)
class Identity:
    """Reply to hello.

    Args:
        version: of this table.
        settings: CRC-32 of the compiled-in settings.
        rate_hz: updates per second.
        supply: code of the 1.1 V reference relative to the supply, 10 bits; 0: not measured.
    """

    CODE: ClassVar[int] = 65
    LAYOUT: ClassVar[str] = "<HIHH"

    version: int
    settings: int
    rate_hz: int
    supply: int


@dataclass(frozen=True)
class Ack:
    """Reply to every other command.

    Args:
        command: code of the command.
        answered: sequence number of the command.
        result: see results.
        token: for confirm_arming; else 0.
    """

    CODE: ClassVar[int] = 66
    LAYOUT: ClassVar[str] = "<BHBH"

    command: int
    answered: int
    result: int
    token: int


@dataclass(frozen=True)
class Status:
    """The state, sent at regular times.

    Args:
        update: number of the update, modulo 65536.
        state: see states.
        fault: why it tripped, see faults.
        reason: why there is no strain, see reasons; 0: the strain is valid.
        strain: measured strain; 0 without one.
        capacitance_f: measured capacitance, in F; 0 without one.
        code: of the output converter, 0.5 mV each.
        busy_cycles: longest update since the last status, in CPU cycles.
        overruns: updates that were not ready in time, modulo 256.
        bad_frames: damaged frames, modulo 256.
    """

    CODE: ClassVar[int] = 67
    LAYOUT: ClassVar[str] = "<HBBBffHHBB"

    update: int
    state: int
    fault: int
    reason: int
    strain: float
    capacitance_f: float
    code: int
    busy_cycles: int
    overruns: int
    bad_frames: int


@dataclass(frozen=True)
class Trace:
    """One update in full: its latched inputs and its results.

    Args:
        update: number of the update, modulo 65536.
        codes: new samples: level, current, voltage, current, voltage, ....
        event: see events.
        alarms: see alarms.
        state: see states.
        reference: desired strain.
        strain: measured strain; 0 without one.
        corrected: the controller's output, in strain or in V.
        code: of the output converter.
    """

    CODE: ClassVar[int] = 68
    LAYOUT: ClassVar[str] = "<H8hBBBfffH"

    update: int
    codes: tuple[int, ...]
    event: int
    alarms: int
    state: int
    reference: float
    strain: float
    corrected: float
    code: int


COMMANDS = (
    Hello,
    RequestArming,
    ConfirmArming,
    Run,
    SetReference,
    KeepAlive,
    Stop,
    ClearFault,
    SetTelemetry,
)
TELEMETRY = (
    Identity,
    Ack,
    Status,
    Trace,
)
