"""The link to a microcontroller on a serial port."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from typing import Any

from haselab.base import DeviceError
from haselab.rig.chip.link import ChipLink
from haselab.rig.drivers import load_driver

__all__ = ["SerialChip"]

_BAUD = 500_000  # firmware/board
_RESET_S = 2.5  # opening the port resets an Arduino; its boot loader waits that long
_POLL_S = 2e-3


class SerialChip(ChipLink):
    """A microcontroller on a serial port; time is that of the wall clock.

    Args:
        port: /dev/ttyACM0, COM3, ...
        patience_s: longest wait for a reply, in s; a computer's port delivers bytes in parts.
        reset_s: longest start of the board after the port is opened, in s.
    Raises:
        DeviceError: The driver or the port does not exist.
    """

    def __init__(self, port: str, patience_s: float = 0.5, reset_s: float = _RESET_S) -> None:
        super().__init__()
        serial = load_driver("serial", "The microcontroller")
        self._name, self.patience_s = port, patience_s
        try:
            self._port: Any = serial.Serial(port, _BAUD, timeout=_POLL_S, write_timeout=patience_s)
        except (OSError, ValueError) as error:
            raise self._gone(str(error)) from None
        try:
            self.run(reset_s)
        except BaseException:
            self.close()
            raise
        self.messages.clear()

    def _gone(self, what: str) -> DeviceError:
        return DeviceError(
            f"The microcontroller's serial port does not work ({what}). Check its cable and its "
            f"power, or change port. {self._name}"
        )

    def put(self, data: bytes) -> None:
        """See `ChipLink`."""
        try:
            self._port.write(data)
        except (OSError, TypeError) as error:  # pyserial: TypeError on a port that was removed
            raise self._gone(str(error) or type(error).__name__) from None

    def receive(self, duration_s: float) -> Iterator[Any]:
        """See `ChipLink`; time is that of the wall clock."""
        end_s = time.monotonic() + duration_s
        while time.monotonic() < end_s:
            try:
                data = self._port.read(max(1, self._port.in_waiting))
            except (OSError, TypeError) as error:
                raise self._gone(str(error) or type(error).__name__) from None
            yield from self.decoded(data)

    def close(self) -> None:
        """See `ChipLink`."""
        with contextlib.suppress(OSError):
            self._port.close()
