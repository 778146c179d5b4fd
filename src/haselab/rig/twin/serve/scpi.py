"""The twin's sensing signal as a Keysight 33522B: SCPI lines on a TCP port.

Short and long headers, channel suffixes, the error queue; amplitudes in Vpp, Vrms or dBm at the
load that was set. What is not known here is error -113, as on the instrument.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from haselab.base import LimitError
from haselab.rig.twin.serve.hub import TwinHub
from haselab.rig.twin.serve.lines import LineServer

__all__ = ["IDENTITY", "ScpiServer"]

IDENTITY = "Agilent Technologies,33522B,MY00000001,4.00-1.19-2.00-58-00"
_UNKNOWN = '-113,"Undefined header"'
_RANGE = '-222,"Data out of range"'
_KIND = '-224,"Illegal parameter value"'
_TOO_LONG = '-363,"Input buffer overrun"'
_DEFECT = '-310,"System error"'
_INFINITE = 9.9e37
_OUTPUT_OHM = 50.0
_FASTEST_HZ = 30e6
_LOWEST_VPP = 2e-3  # into an open circuit
_HIGHEST_VPP = 20.0
_SHAPES = ("SIN", "SQU", "TRI", "RAMP", "PULS", "PRBS", "NOIS", "ARB", "DC")
_UNITS = ("VPP", "VRMS", "DBM")


@dataclass
class _Channel:
    """Settings as the front panel shows them; the instrument's own at power-on."""

    shape: str = "SIN"
    frequency_hz: float = 1e3
    open_vpp: float = 0.2  # into an open circuit: 100 mVpp into 50 ohm
    offset_v: float = 0.0
    unit: str = "VPP"
    load_ohm: float = 50.0
    on: bool = False

    @property
    def shown(self) -> float:
        """Part of the open-circuit voltage that the panel shows."""
        if self.load_ohm >= _INFINITE:
            return 1.0
        return self.load_ohm / (self.load_ohm + _OUTPUT_OHM)


class _RefusedError(Exception):
    """An entry for the error queue."""


class ScpiServer:
    """Serves a hub's carrier on a loopback port; channel 1 is wired to the amplifier.

    Args:
        hub: the bench.
        port: 0: any free one.
        allow_others: also serve clients of other users of this computer.
    """

    def __init__(self, hub: TwinHub, port: int = 0, *, allow_others: bool = False) -> None:
        self._hub = hub
        self._errors: deque[str] = deque(maxlen=20)
        self._channels = (_Channel(), _Channel())
        # header pattern: (answer to the question, what a parameter does)
        self._table: list[tuple[re.Pattern[str], _Ask | None, _Set | None]] = [
            (_header(pattern), ask, act)
            for pattern, ask, act in (
                ("FUNC[TION]", lambda c: c.shape, self._set_shape),
                ("FREQ[UENCY]", lambda c: _number(c.frequency_hz), self._set_frequency),
                ("VOLT[AGE]", self._amplitude, self._set_amplitude),
                ("VOLT[AGE]:UNIT", lambda c: c.unit, self._set_unit),
                ("VOLT[AGE]:OFFS[ET]", lambda c: _number(c.offset_v * c.shown), self._set_offset),
                ("OUTP[UT]", lambda c: str(int(c.on)), self._set_on),
                ("OUTP[UT]:LOAD", lambda c: _number(c.load_ohm), self._set_load),
            )
        ]
        self._server = LineServer(self, port, "twin generator", allow_others=allow_others)
        self.address = f"TCPIP::127.0.0.1::{self._server.port}::SOCKET"

    def close(self) -> None:
        """Stop serving."""
        self._server.close()

    def answer(self, line: str) -> bytes:
        """What the instrument sends for one line; commands are separated by semicolons."""
        replies = [self._one(part.strip().lstrip(":")) for part in line.split(";") if part.strip()]
        told = ";".join(reply for reply in replies if reply is not None)
        return told.encode("ascii") + b"\n" if told else b""

    def refuse_line(self, longest: int) -> bytes:
        """An entry for the error queue; such a line has no reply."""
        del longest
        self._errors.append(_TOO_LONG)
        return b""

    def fail(self) -> bytes:
        """The same for a defect of this program."""
        self._errors.append(_DEFECT)
        return b""

    def _one(self, command: str) -> str | None:
        try:
            return self._do(command.upper())
        except _RefusedError as error:
            self._errors.append(str(error))
        except (ValueError, OverflowError, LimitError):
            self._errors.append(_RANGE)
        return None

    def _do(self, command: str) -> str | None:
        header, _, parameter = command.partition(" ")
        if header == "*IDN?":
            return IDENTITY
        if header == "*OPC?":
            return "1"
        if header in {"*CLS", "*RST"}:
            self._errors.clear()
            if header == "*RST":
                self._channels = (_Channel(), _Channel())
                self._apply()
            return None
        if re.fullmatch(r"SYST(EM)?:ERR(OR)?(:NEXT)?\?", header):
            return self._errors.popleft() if self._errors else '+0,"No error"'
        asked = header.endswith("?")
        for pattern, ask, act in self._table:
            match = pattern.fullmatch(header.removesuffix("?"))
            if match is None:
                continue
            channel = self._channels[int(match["channel"] or 1) - 1]
            if asked and ask is not None:
                return ask(channel)
            if not asked and act is not None:
                act(channel, parameter.strip())
                self._apply()
                return None
        raise _RefusedError(_UNKNOWN)

    # ---- settings ------------------------------------------------------------------------------

    @staticmethod
    def _amplitude(channel: _Channel) -> str:
        vpp = channel.open_vpp * channel.shown
        rms = vpp / math.sqrt(8.0)
        if channel.unit == "VRMS":
            return _number(rms)
        if channel.unit == "DBM":
            return _number(10.0 * math.log10(1e3 * rms**2 / channel.load_ohm))
        return _number(vpp)

    @staticmethod
    def _set_shape(channel: _Channel, value: str) -> None:
        if value not in _SHAPES:
            raise _RefusedError(_KIND)
        channel.shape = value

    @staticmethod
    def _set_frequency(channel: _Channel, value: str) -> None:
        hz = float(value)
        if not 1e-6 <= hz <= _FASTEST_HZ:
            raise _RefusedError(_RANGE)
        channel.frequency_hz = hz

    @staticmethod
    def _set_amplitude(channel: _Channel, value: str) -> None:
        number = float(value)
        if channel.unit == "VRMS":
            number *= math.sqrt(8.0)
        elif channel.unit == "DBM":
            number = math.sqrt(8.0 * channel.load_ohm * 1e-3 * 10.0 ** (number / 10.0))
        open_vpp = number / channel.shown
        if not _LOWEST_VPP <= open_vpp <= _HIGHEST_VPP:
            raise _RefusedError(_RANGE)
        channel.open_vpp = open_vpp

    @staticmethod
    def _set_unit(channel: _Channel, value: str) -> None:
        if value not in _UNITS or (value == "DBM" and channel.load_ohm >= _INFINITE):
            raise _RefusedError(_KIND)
        channel.unit = value

    @staticmethod
    def _set_offset(channel: _Channel, value: str) -> None:
        offset_v = float(value) / channel.shown
        if not abs(offset_v) + 0.5 * channel.open_vpp <= 0.5 * _HIGHEST_VPP:
            raise _RefusedError(_RANGE)
        channel.offset_v = offset_v

    @staticmethod
    def _set_on(channel: _Channel, value: str) -> None:
        if value not in {"0", "1", "ON", "OFF"}:
            raise _RefusedError(_KIND)
        channel.on = value in {"1", "ON"}

    @staticmethod
    def _set_load(channel: _Channel, value: str) -> None:
        """What the panel shows changes; the voltage behind the 50 ohm stays."""
        ohm = _INFINITE if value in {"INF", "INFINITY"} else float(value)
        if not (1.0 <= ohm <= 10e3 or ohm == _INFINITE):
            raise _RefusedError(_RANGE)
        channel.load_ohm = ohm

    def _apply(self) -> None:
        """The amplifier's input is an open circuit to the instrument."""
        channel = self._channels[0]
        silent = not channel.on or channel.shape != "SIN"
        self._hub.carrier(channel.frequency_hz, 0.0 if silent else 0.5 * channel.open_vpp)


_Ask = Callable[[_Channel], str]
_Set = Callable[[_Channel, str], None]


def _number(value: float) -> str:
    return f"{value:+.15E}"


def _header(pattern: str) -> re.Pattern[str]:
    """`VOLT[AGE]:UNIT` with the channel at the first word, as `SOUR1:` or as a suffix."""
    first, colon, rest = (
        word.replace("[", "(?:").replace("]", ")?") for word in pattern.partition(":")
    )
    if pattern.startswith("OUTP"):
        return re.compile(rf"{first}(?P<channel>[12])?{colon}{rest}")
    return re.compile(rf"(?:SOUR(?:CE)?(?P<channel>[12])?:)?{first}{colon}{rest}")
