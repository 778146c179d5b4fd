"""Serve the twin's high-voltage supply as a Peta-Pico-Voltron on a pseudo-terminal."""

from __future__ import annotations

import math
import os
import select
import sys
import threading
import time
import traceback
from collections.abc import Callable
from typing import Protocol

from haselab.base import DeviceError
from haselab.rig.twin.serve.supply.firmware import ERROR, SupplyFaults, SupplyFirmware

if sys.platform != "win32":
    import tty

__all__ = ["NAME", "Rail", "SupplyFaults", "SupplyServer"]

NAME = "haselab-twin"
_LONGEST = 256  # bytes that are read at once, and of a line that is answered


class Rail(Protocol):
    """The high voltage that the supply puts out: of a `TwinHub`, or of a model of the supply."""

    @property
    def rail_v(self) -> float:
        """Output voltage, in V."""

    def rail(self, voltage_v: float) -> None:
        """Take over a new set point, in V."""


class SupplyServer:
    """Serves a high-voltage rail on a pseudo-terminal.

    Args:
        hub: the rail of a bench.
        allow_others: let other users of this computer open it, as their groups allow.
        faults: what is wrong with the supply.
        clock: of the converter's own voltage, which runs down by itself, in s.
    Raises:
        DeviceError: this system has no pseudo-terminals.
    """

    def __init__(
        self,
        hub: Rail,
        *,
        allow_others: bool = False,
        faults: SupplyFaults | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if sys.platform == "win32":
            raise DeviceError(
                "Windows has no pseudo-terminals. Serve the twin from Linux or macOS."
            )
        self._hub, self._clock = hub, clock
        self.faults = faults or SupplyFaults()
        self.firmware = SupplyFirmware(NAME, self.faults)
        self._lock = threading.RLock()
        self._left_v, self._since_s = 0.0, clock()  # above the converter's set point
        self._stale = self.faults.stale
        with self._lock:
            self._apply(0.0)
        for command in self.faults.left_by:
            self.answer(command)
        self.external(self.faults.external_high)
        self._main, self._side = os.openpty()
        tty.setraw(self._side)
        os.fchmod(self._side, 0o666 if allow_others else 0o600)
        os.set_blocking(self._main, False)
        self.port = os.ttyname(self._side)
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._serve, name="twin supply")
        self._thread.start()

    def _serve(self) -> None:
        """Commands in, answers out; while answers are not read, no command is."""
        unread = b""
        while True:
            reading, writing = ([], [self._main]) if unread else ([self._main], [])
            ready, free, _ = select.select([*reading, self._wake_read], writing, [])
            if self._wake_read in ready:
                return
            if free:
                unread = unread[os.write(self._main, unread) :]
            if self._main in ready:
                commands = self.firmware.take(os.read(self._main, _LONGEST))
                unread = b"".join(self._reply(command) for command in commands)
                if unread and self._stale:
                    unread, self._stale = self._stale + unread, b""

    def _reply(self, line: str) -> bytes:
        try:
            reported = self.answer(line)
            if self.firmware.debug:
                reported = f"{self.firmware.debug_line(self.converter_v)}\r\n{reported}"
            return reported.encode("latin-1") + b"\r\n"
        except Exception:  # a defect: shown, and the client is served on
            traceback.print_exc(file=sys.stderr)
            return ERROR.encode() + b"\r\n"

    # ---- what the supply does ------------------------------------------------------------------

    def answer(self, line: str) -> str:
        """What the supply sends for one command."""
        with self._lock:
            now_v = self.converter_v
            reported = self.firmware.answer(line, now_v)
            self._apply(now_v)
            return reported

    @property
    def converter_v(self) -> float:
        """Voltage of its converter, ahead of the output switch, in V: what `QVnow` measures."""
        with self._lock:
            left_v = self._remaining_v()
            requested_v = self.firmware.converter_v + left_v
            if self._on:  # a load may be slower
                requested_v = max(requested_v, self._hub.rail_v) if left_v else self._hub.rail_v
            return max(requested_v, self.faults.stuck_v)

    @property
    def _on(self) -> bool:
        return self.firmware.closed and not self.faults.relays_open

    def _remaining_v(self) -> float:
        if self._left_v == 0.0 or self.faults.decay_s == 0.0:
            return 0.0
        return self._left_v * math.exp(-(self._clock() - self._since_s) / self.faults.decay_s)

    def _apply(self, before_v: float) -> None:
        """Put converter and output switch as the firmware has set them."""
        requested_v = max(self.firmware.converter_v, self.faults.stuck_v)
        self._left_v, self._since_s = max(0.0, before_v - requested_v), self._clock()
        self._hub.rail(requested_v if self._on else 0.0)

    def press(self, down: bool) -> None:
        """Press or release its button."""
        self._outside(lambda: self.firmware.press(down))

    def external(self, high: bool) -> None:
        """Set the input of the external switch source."""
        self._outside(lambda: self.firmware.external(high))

    def plug(self, jack_in: bool) -> None:
        """Unplug or plug in the power jack; the USB cable powers the rest."""
        self._outside(lambda: setattr(self.firmware, "jack_in", jack_in))

    def power_on(self) -> None:
        """Reconnect its USB cable, so that it starts with its stored settings."""
        self._outside(self.firmware.power_on)

    def _outside(self, act: Callable[[], None]) -> None:
        with self._lock:
            now_v = self.converter_v
            act()
            self._apply(now_v)

    def close(self) -> None:
        """Stop serving."""
        os.write(self._wake_write, b".")
        self._thread.join()
        for handle in (self._main, self._side, self._wake_read, self._wake_write):
            os.close(handle)
