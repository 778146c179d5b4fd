"""The serial line of a Peta-Pico-Voltron: request and response matching, and switching off.

ASCII at 115,200 baud, 8N1; a command ends with CR, its answer with CR LF. `S...` sets and echoes,
`Q...` asks, anything else is answered by `Err` (petapicovoltron.com, "Direct communication with
the HVPS").

Several programs share the port: ModemManager sends AT commands to every new one, and the guardians
use it while the program does. So a request begins with filler and ends with `QVer`, whose answer
nothing else gives: what was on the line before does not count. The firmware never clears its
buffer, and an empty line repeats the last command; 19 characters of filler replace whatever
fragment it holds by one that is answered with `Err`, without executing it.

An echo does not mean that something was done: the output switch follows `SSwMode` only while the
switch source is the firmware's own, and `SSwSrc` by itself does not open it. `SSwMode 0` goes out
twice, since after the waveform mode the set point counts again only then; `SCycle 0`, since the
button would otherwise start the cycles again.
"""

from __future__ import annotations

import errno
import math
import re
import time
from collections.abc import Sequence
from typing import Any

from haselab.base import DeviceError
from haselab.rig.drivers import load_driver, quietly
from haselab.rig.instruments.petapicovoltron.section import PetaPicoVoltronConfig

__all__ = ["SupplyLine"]

_BAUD = 115_200
_FILLER = b"x" * 19 + b"\r"  # the length of the firmware's buffer
_VERSION = re.compile(r"slave \d+")
_DEBUG = re.compile(r"\d+, .*|Kill")  # lines of the firmware's debug mode
_OFF = ("SSwSrc 0", "SSwMode 0", "SVMode 0", "SVset 0", "SCycle 0", "SSwMode 0")
_STATE = {  # what is asked: its answer while the output is off, and its name for a person
    "QSwSrc": ("0", "the switch source"),
    "QSwMode": ("0", "the switching mode"),
    "QVMode": ("0", "the voltage mode"),
    "QVset": ("0", "the set point"),
}
_MOST_LINES = 40  # that are read over before an answer
_TRIALS = 3
_LOOK_S = 0.05
_IGNORE = (
    'If ModemManager runs, exclude this port from it: ENV{ID_MM_DEVICE_IGNORE}="1" in a udev rule'
)


class SupplyLine:
    """Commands to a supply, whichever it is; opening it changes nothing.

    Args:
        config: section `supply` of the rig file.
    Raises:
        DeviceError: no driver, no port.
    """

    def __init__(self, config: PetaPicoVoltronConfig) -> None:
        self._config = config
        self.version = ""
        self._received = b""  # since the last request
        serial = load_driver("serial", "The high-voltage supply")
        try:
            self._port: Any = serial.Serial(
                config.port, _BAUD, timeout=config.timeout_s, write_timeout=config.timeout_s
            )
        except (OSError, ValueError) as error:
            busy = getattr(error, "errno", None) == errno.EBUSY
            raise self.no_reply(f"{error}; {_IGNORE}" if busy else str(error)) from None

    def no_reply(self, what: str) -> DeviceError:
        """The error of a supply that does not answer."""
        return DeviceError(
            f"The high-voltage supply does not answer as it should ({what}). Check cable and "
            f"power, or correct supply.port. {self._config.port}"
        )

    # ---- requests ------------------------------------------------------------------------------

    def query(self, command: str) -> str:
        """The answer to one command, which is repeated once where it makes no sense.

        Raises:
            DeviceError: no answer, or `Err`.
        """
        try:
            self._send(command.encode("ascii") + b"\r")
            answer = self._sound(command, self._line(command))
            if not _DEBUG.fullmatch(answer):
                return answer
        except DeviceError:
            pass
        return self._sound(command, self.query_all([command])[0])

    def query_all(self, commands: Sequence[str]) -> list[str]:
        """The answers to several commands, sent in one go; what was on the line does not count.

        Raises:
            DeviceError: no answer.
        """
        whole = "".join(f"{command}\r" for command in (*commands, "QVer"))
        self._send(_FILLER + whole.encode("ascii"))
        lines: list[str] = []
        for _ in range(_MOST_LINES):
            line = self._line(commands[0] if commands else "QVer")
            if _VERSION.fullmatch(line):
                self.version = line
                if len(lines) >= len(commands):
                    return lines[len(lines) - len(commands) :]
                raise self.no_reply(f"{len(lines)} answers to {len(commands)} commands; {_IGNORE}")
            if not _DEBUG.fullmatch(line):
                lines.append(line)
        raise self.no_reply(f"{_MOST_LINES} lines and no answer to QVer; {_IGNORE}")

    def synchronise(self) -> str:
        """Find the end of what others have left on the line; for once it is opened.

        Returns:
            Its version, as it reports it.
        Raises:
            DeviceError: nothing that answers like such a supply.
        """
        for trial in range(_TRIALS):
            error = quietly(lambda: self.query_all([]))
            if error is None:
                return self.version
            if trial == _TRIALS - 1 or not self._received:
                raise error
        raise AssertionError("unreachable")

    def _send(self, data: bytes) -> None:
        self._received = b""
        try:
            self._port.reset_input_buffer()
            self._port.write(data)
        except (OSError, TypeError) as error:  # pyserial: TypeError on a port that is gone
            raise self.no_reply(str(error) or type(error).__name__) from None

    def _line(self, command: str) -> str:
        try:
            answer = self._port.read_until(b"\r\n", 128)
        except (OSError, TypeError) as error:
            raise self.no_reply(str(error) or type(error).__name__) from None
        self._received += answer
        if not answer.endswith(b"\r\n"):
            raise self.no_reply(f"{command}: {len(answer)} bytes and no end of line")
        try:
            return str(answer[:-2].decode("ascii").strip())
        except UnicodeDecodeError:
            raise self.no_reply(f"{command}: garbage") from None

    def _sound(self, command: str, answer: str) -> str:
        if answer == "Err":
            raise self.no_reply(f"{command}: Err")
        return answer

    def number(self, command: str) -> float:
        """The answer to a command as a finite number.

        Raises:
            DeviceError: none.
        """
        answer = self.query(command)
        try:
            value = float(answer)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.no_reply(f"{command}: {answer!r}")
        return value

    def set(self, command: str, value: int) -> None:
        """Set something to a value that has to be echoed.

        Raises:
            DeviceError: another echo.
        """
        echo = self.number(f"{command} {value}")
        if echo != value:
            raise self.no_reply(f"{command} {value} is echoed as {echo:g}")

    # ---- switching off -------------------------------------------------------------------------

    def switch_off(self) -> None:
        """Everything that takes the output to 0 V, sent in one go, then verified. Never waits.

        Raises:
            DeviceError: an echo or a setting that is not the one of an output that is off.
        """
        echoes = self.query_all(_OFF)
        if any(echo != "0" for echo in echoes):
            raise self.no_reply(f"{'; '.join(_OFF)} are echoed as {'; '.join(echoes)}")
        if fault := self.not_off():
            raise DeviceError(f"The high-voltage supply is not off: {fault}. {self._config.port}")

    def not_off(self) -> str:
        """By its settings, asked for now: what could still put out a voltage; empty if nothing.

        Raises:
            DeviceError: no answer.
        """
        answers = self.query_all([*_STATE, "QCycle"])
        found = [
            f"{name} is {answer}, expected 0"
            for (expected, name), answer in zip(_STATE.values(), answers, strict=False)
            if answer != expected
        ]
        if not answers[-1].endswith("/0"):
            found.append(f"its button can start {answers[-1].rpartition('/')[2]} cycles")
        return ", ".join(found)

    def wait_discharged(self, within_s: float) -> None:
        """Wait until the supply's own meter shows no voltage.

        Args:
            within_s: for so long, in s.
        Raises:
            DeviceError: it still does, or it does not answer.
        """
        end_s = time.monotonic() + within_s
        while True:
            left_v = self.number("QVnow")
            if abs(left_v) <= self._config.tolerance_v:
                return
            if time.monotonic() >= end_s:
                raise DeviceError(
                    f"The high-voltage supply is not confirmed off: its meter shows {left_v:g} V "
                    f"{within_s:g} s after it was switched off (limit "
                    f"{self._config.tolerance_v:g} V). Pull its power jack. {self._config.port}"
                )
            time.sleep(_LOOK_S)

    def close(self) -> None:
        """Close the port and leave the supply as it is. Never raises."""
        quietly(self._port.close)
