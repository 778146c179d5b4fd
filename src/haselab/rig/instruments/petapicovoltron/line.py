"""The serial port of a Peta-Pico-Voltron: request and response matching, and switching off.

ASCII at 115,200 baud, 8N1; a command ends with CR, its reply with CR LF. `S...` sets and echoes,
`Q...` queries, and the reply to anything else is `Err` (petapicovoltron.com, "Direct communication
with the HVPS").

Several programs share the port: ModemManager sends AT commands to every new one, and the guardians
use it while the program does. So a request begins with filler and ends with `QVer`, whose reply is
unique, and everything before the request is ignored. The firmware never clears its buffer, and an
empty line repeats the last command; 19 characters of filler replace any fragment in it by one to
which it replies `Err` without executing anything.

An echo does not mean that a command took effect: the output switch follows `SSwMode` only while the
switch source is the firmware's own, and `SSwSrc` by itself does not open it. `SSwMode 0` is sent
twice, since after the waveform mode the set point is used again only then; `SCycle 0`, since the
button would otherwise start the cycles again.
"""

from __future__ import annotations

import contextlib
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
_STATE = {  # query: its reply while the output is off, and its name for messages
    "QSwSrc": ("0", "the switch source"),
    "QSwMode": ("0", "the switching mode"),
    "QVMode": ("0", "the voltage mode"),
    "QVset": ("0", "the set point"),
}
_MOST_LINES = 40  # most lines skipped before a reply
_TRIALS = 3
_LOOK_S = 0.05
_IGNORE = (
    'If ModemManager runs, exclude this port from it: ENV{ID_MM_DEVICE_IGNORE}="1" in a udev rule'
)


class SupplyLine:
    """Sends commands to any supply of this family; opening the port changes nothing.

    Args:
        config: section `supply` of the rig file.
    Raises:
        DeviceError: The driver or the port is missing.
    """

    def __init__(self, config: PetaPicoVoltronConfig) -> None:
        self._config = config
        self.version = ""
        self._received = b""  # since the last request
        self._unanswered = 0  # requests whose replies may still arrive
        serial = load_driver("serial", "The high-voltage supply")
        try:
            self._port: Any = serial.Serial(
                config.port, _BAUD, timeout=config.timeout_s, write_timeout=config.timeout_s
            )
        except (OSError, ValueError) as error:
            busy = getattr(error, "errno", None) == errno.EBUSY
            raise self.no_reply(f"{error}; {_IGNORE}" if busy else str(error)) from None

    def no_reply(self, what: str) -> DeviceError:
        """Make the error of a supply that does not reply correctly."""
        return DeviceError(
            f"The high-voltage supply does not reply correctly ({what}). Check its cable and its "
            f"power, or change supply.port. {self._config.port}"
        )

    # ---- requests ------------------------------------------------------------------------------

    def query(self, command: str) -> str:
        """Send one command and return its reply; repeat it once if the reply is not valid.

        Raises:
            DeviceError: There is no reply, or the reply is `Err`.
        """
        if not self._unanswered:
            with contextlib.suppress(DeviceError):
                self._send(command.encode("ascii") + b"\r")
                answer = self._sound(command, self._line(command))
                if not _DEBUG.fullmatch(answer):
                    return answer
        return self._sound(command, self.query_all([command])[0])

    def query_all(self, commands: Sequence[str]) -> list[str]:
        """Send several commands at once and return their replies; ignore earlier data.

        Replies to a request that timed out may arrive late. After a timeout, all outstanding
        replies are read, the request is repeated once if one is missing, and the last replies are
        returned.

        Raises:
            DeviceError: There is no reply.
        """
        whole = "".join(f"{command}\r" for command in (*commands, "QVer"))
        request = _FILLER + whole.encode("ascii")
        for _ in range(2 if self._unanswered else 1):
            self._unanswered += 1
            self._send(request)
            found, fault = self._all_replies(commands)
            if fault is None:
                break
        if fault is not None and not found:
            raise fault
        lines = found[-1]
        self._unanswered = 0
        if len(lines) < len(commands):
            raise self.no_reply(f"{len(lines)} replies to {len(commands)} commands; {_IGNORE}")
        return lines[len(lines) - len(commands) :]

    def _all_replies(self, commands: Sequence[str]) -> tuple[list[list[str]], Exception | None]:
        """Read the replies to all requests; also return why some are missing."""
        found: list[list[str]] = []
        for _ in range(self._unanswered):
            fault = quietly(lambda: found.append(self._replies(commands)))
            if fault is not None:
                return found, fault
        return found, None

    def _replies(self, commands: Sequence[str]) -> list[str]:
        """Read all lines before the next reply to `QVer`.

        Raises:
            DeviceError: There is no such reply.
        """
        lines: list[str] = []
        for _ in range(_MOST_LINES):
            line = self._line(commands[0] if commands else "QVer")
            if _VERSION.fullmatch(line):
                self.version = line
                return lines
            if not _DEBUG.fullmatch(line):
                lines.append(line)
        raise self.no_reply(f"{_MOST_LINES} lines and no reply to QVer; {_IGNORE}")

    def synchronise(self) -> str:
        """Skip what other programs have left in the port's buffers, after opening it.

        Returns:
            The version that the supply reports.
        Raises:
            DeviceError: Nothing replies like such a supply.
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
        except (OSError, TypeError) as error:  # pyserial: TypeError on a port that was removed
            raise self.no_reply(str(error) or type(error).__name__) from None

    def _line(self, command: str) -> str:
        try:
            answer = self._port.read_until(b"\r\n", 128)
        except (OSError, TypeError) as error:
            raise self.no_reply(str(error) or type(error).__name__) from None
        self._received += answer
        if not answer.endswith(b"\r\n"):
            raise self.no_reply(f"{command}: {len(answer)} bytes without an end of line")
        try:
            return str(answer[:-2].decode("ascii").strip())
        except UnicodeDecodeError:
            raise self.no_reply(f"{command}: not ASCII") from None

    def _sound(self, command: str, answer: str) -> str:
        if answer == "Err":
            raise self.no_reply(f"{command}: Err")
        return answer

    def number(self, command: str) -> float:
        """Send a command and return its reply as a finite number.

        Raises:
            DeviceError: The reply is not a finite number.
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
        """Set a value and check its echo.

        Raises:
            DeviceError: The echo differs.
        """
        echo = self.number(f"{command} {value}")
        if echo != value:
            raise self.no_reply(f"{command} {value} is echoed as {echo:g}")

    # ---- switching off -------------------------------------------------------------------------

    def switch_off(self) -> None:
        """Send all commands that take the output to 0 V, then verify them, without waiting.

        Raises:
            DeviceError: An echo or a setting is not that of an output that is off.
        """
        echoes = self.query_all(_OFF)
        if any(echo != "0" for echo in echoes):
            raise self.no_reply(f"{'; '.join(_OFF)} are echoed as {'; '.join(echoes)}")
        if fault := self.not_off():
            raise DeviceError(f"The high-voltage supply is not off: {fault}. {self._config.port}")

    def not_off(self) -> str:
        """Query the settings for anything that could still put out a voltage; empty if nothing.

        Raises:
            DeviceError: There is no reply.
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
            within_s: longest wait, in s.
        Raises:
            DeviceError: It still shows a voltage, or does not reply.
        """
        end_s = time.monotonic() + within_s
        while True:
            left_v = self.number("QVnow")
            if abs(left_v) <= self._config.tolerance_v:
                return
            if time.monotonic() >= end_s:
                raise DeviceError(
                    "Pull the power jack of the high-voltage supply, which is not confirmed off: "
                    f"its meter shows {left_v:g} V {within_s:g} s after it was switched off (limit "
                    f"{self._config.tolerance_v:g} V). {self._config.port}"
                )
            time.sleep(_LOOK_S)

    def close(self) -> None:
        """Close the port without changing the supply. Never raises."""
        quietly(self._port.close)
