"""The twin's high-voltage rail as a Peta-Pico-Voltron on a pseudo-terminal."""

from __future__ import annotations

import os
import select
import sys
import threading

from haselab.base import DeviceError
from haselab.rig.twin.serve.hub import TwinHub

if sys.platform != "win32":
    import tty

__all__ = ["NAME", "SupplyServer"]

NAME = "haselab-twin"
_REACH_V = 5000
_MODE_DC = 1
_SETTINGS = {"SwMode": 4, "SwSrc": 3, "VMode": 3, "F": 1001, "Cycle": 65536, "LatchMode": 2}


class SupplyServer:
    """Serves a hub's rail on a pseudo-terminal.

    Args:
        hub: the bench.
    Raises:
        DeviceError: this system has no pseudo-terminals.
    """

    def __init__(self, hub: TwinHub) -> None:
        if sys.platform == "win32":
            raise DeviceError(
                "Windows has no pseudo-terminals. Serve the twin from Linux or macOS."
            )
        self._hub = hub
        self._set_v = 0
        self._state = dict.fromkeys(_SETTINGS, 0)
        self._main, self._side = os.openpty()
        tty.setraw(self._side)
        self.port = os.ttyname(self._side)
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._serve, name="twin supply")
        self._thread.start()

    def _serve(self) -> None:
        pending = b""
        while True:
            ready, _, _ = select.select([self._main, self._wake_read], [], [])
            if self._wake_read in ready:
                return
            pending += os.read(self._main, 4096)
            *lines, pending = pending.split(b"\r")
            for line in lines:
                reply = self.answer(line.decode("ascii", errors="replace").strip())
                os.write(self._main, reply.encode("ascii") + b"\r\n")

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
        if not parameter.isdigit():
            return "Err"
        value = int(parameter)
        if word == "SVset" and value <= _REACH_V:
            self._set_v = value
        elif word[:1] == "S" and value < _SETTINGS.get(word[1:], 0):
            self._state[word[1:]] = value
        else:
            return "Err"
        self._hub.rail(float(self._set_v) if self._state["SwMode"] == _MODE_DC else 0.0)
        return str(value)

    def close(self) -> None:
        """Stop serving."""
        os.write(self._wake_write, b".")
        self._thread.join()
        for handle in (self._main, self._side, self._wake_read, self._wake_write):
            os.close(handle)
