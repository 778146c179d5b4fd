"""The twin's high-voltage rail as a Peta-Pico-Voltron on a pseudo-terminal."""

from __future__ import annotations

import os
import select
import sys
import threading
import traceback
from typing import Protocol

from haselab.base import DeviceError

if sys.platform != "win32":
    import tty

__all__ = ["NAME", "Rail", "SupplyServer"]

NAME = "haselab-twin"
_REACH_V = 5000
_MODE_DC = 1
_ERROR = b"Err"
_MOST_DIGITS = 9
_LONGEST = 256  # bytes of a command, and of answers that nobody has read yet
_SETTINGS = {"SwMode": 4, "SwSrc": 3, "VMode": 3, "F": 1001, "Cycle": 65536, "LatchMode": 2}


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
    Raises:
        DeviceError: this system has no pseudo-terminals.
    """

    def __init__(self, hub: Rail, *, allow_others: bool = False) -> None:
        if sys.platform == "win32":
            raise DeviceError(
                "Windows has no pseudo-terminals. Serve the twin from Linux or macOS."
            )
        self._hub = hub
        self._set_v = 0
        self._state = dict.fromkeys(_SETTINGS, 0)
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
        pending, unread = b"", b""
        while True:
            reading, writing = ([], [self._main]) if unread else ([self._main], [])
            ready, free, _ = select.select([*reading, self._wake_read], writing, [])
            if self._wake_read in ready:
                return
            if free:
                unread = unread[os.write(self._main, unread) :]
            if self._main in ready:
                *lines, pending = (pending + os.read(self._main, _LONGEST)).split(b"\r")
                unread = b"".join(self._reply(line) + b"\r\n" for line in lines)
                pending = pending[: _LONGEST + 1]  # more of it cannot become a command

    def _reply(self, line: bytes) -> bytes:
        if len(line) > _LONGEST:
            return _ERROR
        try:
            return self.answer(line.decode("ascii", errors="replace").strip()).encode("ascii")
        except Exception:  # a defect: shown, and the client is served on
            traceback.print_exc(file=sys.stderr)
            return _ERROR

    def answer(self, line: str) -> str:
        """What the supply sends for one command."""
        word, _, parameter = line.partition(" ")
        fixed = {
            "QVer": "slave 8",
            "QName": NAME,
            "QVmax": str(_REACH_V),
            "QVset": str(self._set_v),
        }
        if word in fixed:
            return fixed[word]
        if word == "QVnow":
            return str(round(self._hub.rail_v))
        if word[:1] == "Q" and word[1:] in self._state:
            return str(self._state[word[1:]])
        if not parameter.isdecimal() or len(parameter) > _MOST_DIGITS:
            return _ERROR.decode()
        value = int(parameter)
        if word == "SVset" and value <= _REACH_V:
            self._set_v = value
        elif word[:1] == "S" and value < _SETTINGS.get(word[1:], 0):
            self._state[word[1:]] = value
        else:
            return _ERROR.decode()
        self._hub.rail(float(self._set_v) if self._state["SwMode"] == _MODE_DC else 0.0)
        return str(value)

    def close(self) -> None:
        """Stop serving."""
        os.write(self._wake_write, b".")
        self._thread.join()
        for handle in (self._main, self._side, self._wake_read, self._wake_write):
            os.close(handle)
