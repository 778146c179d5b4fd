"""Statuses of NI-DAQmx that the emulated board returns.

The numbers are those of `nidaqmx.error_codes`. Where a document says which condition gives which
status it is named beside the check; the rest is inferred from the status's name there.
"""

from __future__ import annotations

from enum import IntEnum

__all__ = ["StatusError", "StatusNumber"]


class StatusNumber(IntEnum):
    """The ones in use, by their names in `nidaqmx.error_codes` where these are short."""

    RESERVED = -50103
    UNKNOWN_TERMINAL = -89120
    NO_ROUTE = -89136
    ROUTE_IN_USE = -89137
    BAD_VALUE = -200077
    NO_TASK = -200088
    NO_CHANNEL = -200170
    NO_DEVICE = -200220
    OVERWRITTEN = -200279
    LATE = -200284
    RAN_DRY = -200290
    NO_ROOM_YET = -200292
    NO_ROOM = -200293
    TOO_FAST = -200332
    NOT_APPLICABLE = -200452
    BUFFER_EMPTY = -200462
    NO_CHANNELS_IN_TASK = -200478
    ONE_VALUE_WITHOUT_BUFFER = -200547
    RUNNING = -200557
    TOO_HIGH = -200561
    BUFFER_TOO_SMALL = -200609


_TEXTS = {
    StatusNumber.RESERVED: "The specified resource is reserved.",
    StatusNumber.UNKNOWN_TERMINAL: "Source terminal to be routed could not be found on the device.",
    StatusNumber.NO_ROUTE: "Specified route cannot be satisfied: the hardware does not support it.",
    StatusNumber.ROUTE_IN_USE: "Specified route requires resources that are in use.",
    StatusNumber.BAD_VALUE: "Requested value is not supported by the device.",
    StatusNumber.NO_TASK: "Task specified is invalid or does not exist.",
    StatusNumber.NO_CHANNEL: "Physical channel specified does not exist on this device.",
    StatusNumber.NO_DEVICE: "Device identifier is invalid.",
    StatusNumber.OVERWRITTEN: "The application does not keep up with the hardware acquisition.",
    StatusNumber.LATE: "Some or all of the samples requested have not yet been acquired.",
    StatusNumber.RAN_DRY: "The generation stopped to prevent the regeneration of old samples.",
    StatusNumber.NO_ROOM_YET: "Some or all of the samples to write could not be written yet.",
    StatusNumber.NO_ROOM: "There is no more space in the buffer for the samples to write.",
    StatusNumber.TOO_FAST: "Sample rate exceeds the maximum for the number of channels.",
    StatusNumber.NOT_APPLICABLE: "The property is not supported or does not apply to the task.",
    StatusNumber.BUFFER_EMPTY: "Generation cannot start: the output buffer is empty.",
    StatusNumber.NO_CHANNELS_IN_TASK: "The operation needs a channel, and the task has none.",
    StatusNumber.ONE_VALUE_WITHOUT_BUFFER: (
        "A single sample cannot be written to a buffer whose size was configured automatically."
    ),
    StatusNumber.RUNNING: "The property cannot be set while the task is running.",
    StatusNumber.TOO_HIGH: "Attempted to write analog data that is too large or too small.",
    StatusNumber.BUFFER_TOO_SMALL: "Generation cannot start: the output buffer is too small.",
}


class StatusError(Exception):
    """A call that ends with a DAQmx status.

    Args:
        code: the status, negative.
        written: values that were taken before a write failed; None: it was no write.
        route: source and destination of a route that failed, without the device.
    """

    def __init__(
        self, code: int, written: int | None = None, route: tuple[str, str] | None = None
    ) -> None:
        known = code in StatusNumber.__members__.values()
        text = _TEXTS[StatusNumber(code)] if known else "DAQmx error"
        if route is not None:
            text += f"\n\nSource Terminal: {route[0]}\nDestination Terminal: {route[1]}"
        super().__init__(text)
        self.code = int(code)
        self.written = written
