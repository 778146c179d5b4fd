"""The twin's sensing signal as a Keysight 33500B: SCPI lines on a TCP port.

Short and long headers, channel suffixes, headers relative to the one before, units; the error
queue with its 20 places; as few connections as its siblings take. What is not known here is error
-113, as on the instrument. `generator_state` has the settings and their sources.

No general simulator does this: pyvisa-sim answers inside the process of its client, so it has no
connection limit and no second program; its settings are texts that do not act on one another (an
amplitude does not follow the load). lewis serves a socket, but leaves parser, settings
and queue to be written, and its device would run in a loop of its own beside the bench's clock.
"""

from __future__ import annotations

import math
import re
import threading
import time
from collections import deque
from collections.abc import Callable

from haselab.base import LimitError
from haselab.rig.twin.serve.generator.state import (
    INFINITE_OHM,
    MODULATIONS,
    Channel,
    ConflictError,
    GeneratorFaults,
)
from haselab.rig.twin.serve.hub import TwinHub
from haselab.rig.twin.serve.lines import LineServer

__all__ = ["IDENTITY", "GeneratorFaults", "ScpiServer"]

IDENTITY = "Agilent Technologies,33522B,MY00000001,4.00-1.19-2.00-58-00"
_UNKNOWN = '-113,"Undefined header"'
_MISSING = '-109,"Missing parameter"'
_CONFLICT = '-221,"Settings conflict"'
_RANGE = '-222,"Data out of range"'
_KIND = '-224,"Illegal parameter value"'
_FULL = '-350,"Error queue overflow"'
_TOO_LONG = '-363,"Input buffer overrun"'
_DEFECT = '-310,"System error"'
_INDEFINITE = '-440,"Query UNTERMINATED after indefinite response"'
_QUEUE = 20
_FASTEST_HZ = {"33509B": 20e6, "33510B": 20e6, "33511B": 20e6, "33512B": 20e6}
_LOWEST_VPP = 2e-3  # into an open circuit
_HIGHEST_VPP = 20.0
_SHAPES = ("SIN", "SQU", "TRI", "RAMP", "PULS", "PRBS", "NOIS", "ARB", "DC")
_UNITS = ("VPP", "VRMS", "DBM")
_NUMBER = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:E[-+]?\d+)?|[-+]?INF|NAN) *([A-Z]*)")
_FACTORS = {"": 1.0, "U": 1e-6, "M": 1e-3, "K": 1e3}
_BASES = ("HZ", "VPP", "VRMS", "V", "DBM", "OHM", "S", "DEG", "PCT")
_ON = {"1": True, "ON": True, "0": False, "OFF": False}


class _RefusedError(Exception):
    """An entry for the error queue."""


class ScpiServer:
    """Serves a hub's carrier on a loopback port; channel 1 is wired to the amplifier.

    Args:
        hub: the bench.
        port: 0: any free one.
        allow_others: also serve clients of other users of this computer.
        faults: what is wrong with the generator.
    """

    def __init__(
        self,
        hub: TwinHub,
        port: int = 0,
        *,
        allow_others: bool = False,
        faults: GeneratorFaults | None = None,
    ) -> None:
        self._hub = hub
        self.faults = faults or GeneratorFaults()
        self.identity = IDENTITY.replace("33522B", self.faults.model)
        self._two = int(self.faults.model[4]) % 2 == 0
        self._fastest_hz = _FASTEST_HZ.get(self.faults.model, 30e6)
        self._lock = threading.RLock()
        self._errors: deque[str] = deque()
        self._reset()
        # header pattern: (answer to the question, what a parameter does)
        self._table = [(_header(pattern), ask, act) for pattern, ask, act in self._settings()]
        for line in self.faults.panel:
            self.answer(line)
        self._errors.clear()
        self._server = LineServer(
            self,
            port,
            "twin generator",
            allow_others=allow_others,
            most_clients=self.faults.connections,
        )
        self.address = f"TCPIP::127.0.0.1::{self._server.port}::SOCKET"

    def _settings(self) -> list[tuple[str, _Ask | None, _Set | None]]:
        """The headers that are known."""
        table: list[tuple[str, _Ask | None, _Set | None]] = [
            ("FUNC[TION]", lambda c: c.shape, self._set_shape),
            ("FREQ[UENCY]", lambda c: _number(c.frequency_hz), self._set_frequency),
            ("FREQ[UENCY]:MODE", lambda c: "SWE" if c.running == "SWE" else "CW", None),
            ("FREQ[UENCY]:START", lambda c: _number(c.sweep_start_hz), self._hold_start),
            ("FREQ[UENCY]:STOP", lambda c: _number(c.sweep_stop_hz), self._hold_stop),
            ("VOLT[AGE]", lambda c: _number(c.amplitude), self._set_amplitude),
            ("VOLT[AGE]:UNIT", lambda c: c.unit, self._set_unit),
            ("VOLT[AGE]:OFFS[ET]", lambda c: _number(c.offset_v * c.shown), self._set_offset),
            ("VOLT[AGE]:LIM[IT]:STAT[E]", lambda c: str(int(c.limited)), self._set_limited),
            ("VOLT[AGE]:LIM[IT]:HIGH", lambda c: _number(c.limit_high_v), self._set_high),
            ("VOLT[AGE]:LIM[IT]:LOW", lambda c: _number(c.limit_low_v), self._set_low),
            ("PHAS[E]", lambda c: c.rest.get("PHAS", _number(0.0)), self._told_again("PHAS")),
            ("BURS[T]:MODE", lambda c: c.burst_mode, self._set_burst_mode),
            ("BURS[T]:NCYC[LES]", lambda c: _number(c.burst_cycles), self._set_cycles),
            ("BURS[T]:INT[ERNAL]:PER[IOD]", lambda c: _number(c.burst_period_s), self._set_period),
            ("OUTP[UT]", lambda c: str(int(c.on)), self._set_on),
            ("OUTP[UT]:LOAD", lambda c: _number(c.load_ohm), self._set_load),
            ("OUTP[UT]:POL[ARITY]", lambda c: c.polarity, self._set_polarity),
            ("OUTP[UT]:MODE", lambda c: c.gating, self._set_gating),
            ("TRIG[GER]:SOUR[CE]", lambda c: c.trigger, self._set_trigger),
        ]
        for name, header in (("BURS", "BURS[T]"), ("SWE", "SWE[EP]"), ("FSK", "FSK[EY]"),
                             *((each, each) for each in MODULATIONS if each != "FSK")):  # fmt: skip
            table.append((f"{header}:STAT[E]", _runs(name), self._set_running(name)))
        if self._two:
            for name, header in (("FREQ", "FREQ[UENCY]"), ("VOLT", "VOLT[AGE]")):
                ask, act = self._coupled(name), self._couple(name)
                table.append((f"{header}:COUP[LE][:STAT[E]]", ask, act))
            table.append(("TRAC[K]", lambda _: self._tracking, self._set_track))
            table.append(("COMB[INE]:FEED", lambda c: c.combined, self._set_combined))
        return table

    def _reset(self) -> None:
        self._channels = [Channel(), Channel()]
        self._couplings = {"FREQ": False, "VOLT": False}
        self._tracking = "OFF"

    @property
    def refused(self) -> int:
        """Connections that were one too many."""
        return self._server.refused

    def close(self) -> None:
        """Stop serving."""
        self._server.close()

    def answer(self, line: str) -> bytes:
        """What the instrument sends for one line; commands are separated by semicolons."""
        if self.faults.answer_s:
            time.sleep(self.faults.answer_s)
        replies: list[str] = []
        path, indefinite = "", False
        with self._lock:
            for part in (each.strip() for each in line.upper().split(";")):
                if not part:
                    continue
                header = part.partition(" ")[0]
                whole = part if part[0] in ":*" else path + part
                if header[0] != "*":
                    absolute = whole.lstrip(":").partition(" ")[0]
                    path = absolute.rpartition(":")[0]
                    path = f"{path}:" if path else ""
                if indefinite and header.endswith("?"):
                    self._note(_INDEFINITE)
                    continue
                reply = self._one(whole.lstrip(":"))
                if reply is not None:
                    replies.append(reply)
                indefinite = indefinite or header == "*IDN?"
        return ";".join(replies).encode("ascii") + b"\n" if replies else b""

    def refuse_line(self, longest: int) -> bytes:
        """An entry for the error queue; such a line has no reply."""
        del longest
        self._note(_TOO_LONG)
        return b""

    def fail(self) -> bytes:
        """The same for a defect of this program."""
        self._note(_DEFECT)
        return b""

    def _note(self, error: str) -> None:
        """In a full queue the last entry says that more were lost."""
        if len(self._errors) >= _QUEUE:
            self._errors[-1] = _FULL
        else:
            self._errors.append(error)

    def _one(self, command: str) -> str | None:
        try:
            return self._do(command)
        except _RefusedError as error:
            self._note(str(error))
        except ConflictError:
            self._note(_CONFLICT)
            self._apply()
        except (ValueError, OverflowError, LimitError):
            self._note(_RANGE)
        return None

    def _do(self, command: str) -> str | None:
        header, _, parameter = command.partition(" ")
        if header == "*IDN?":
            return self.identity
        if header == "*OPC?":
            return "1"
        if header == "*CLS":
            self._errors.clear()
            return None
        if header == "*RST":  # the error queue stays
            time.sleep(self.faults.reset_s)
            self._reset()
            self._apply()
            return None
        if re.fullmatch(r"SYST(EM)?:ERR(OR)?(:NEXT)?\?", header):
            return self._errors.popleft() if self._errors else '+0,"No error"'
        return self._set_or_ask(header, parameter.strip())

    def _set_or_ask(self, header: str, parameter: str) -> str | None:
        asked = header.endswith("?")
        for pattern, ask, act in self._table:
            match = pattern.fullmatch(header.removesuffix("?"))
            if match is None:
                continue
            number = int(match["channel"] or 1)
            if number > (2 if self._two else 1):
                break
            channel = self._channels[number - 1]
            if asked and ask is not None:
                return ask(channel)
            if not asked and act is not None:
                if not parameter:
                    raise _RefusedError(_MISSING)
                try:
                    act(channel, parameter)
                finally:
                    self._copy(number)
                self._apply()
                return None
        raise _RefusedError(_UNKNOWN)

    def _copy(self, number: int) -> None:
        """What coupling and tracking carry over to the other channel."""
        source, other = self._channels[number - 1], self._channels[2 - number]
        if self._tracking != "OFF":
            self._channels[2 - number] = source.copied()
            return
        if self._couplings["FREQ"]:
            other.frequency_hz = source.frequency_hz
        if self._couplings["VOLT"]:
            other.open_vpp, other.offset_v = source.open_vpp, source.offset_v
            other.load_ohm, other.unit = source.load_ohm, source.unit

    def _apply(self) -> None:
        """The amplifier's input is an open circuit to the instrument."""
        sine = self._channels[0].output(self.faults.triggers)
        try:
            self._hub.carrier(sine.frequency_hz, sine.amplitude_v, sine.offset_v)
        except LimitError:
            self._hub.carrier(sine.frequency_hz, 0.0, sine.offset_v)
            raise

    # ---- settings ------------------------------------------------------------------------------

    @staticmethod
    def _set_shape(channel: Channel, value: str) -> None:
        short = {"SINUSOID": "SIN", "SQUARE": "SQU", "TRIANGLE": "TRI", "PULSE": "PULS",
                 "NOISE": "NOIS", "ARBITRARY": "ARB"}.get(value, value)  # fmt: skip
        channel.shape = _one_of(short, *_SHAPES)

    def _set_frequency(self, channel: Channel, value: str) -> None:
        number = _value(value)[0]
        channel.frequency_hz = min(max(number, 1e-6), self._fastest_hz)
        if number != channel.frequency_hz:
            raise _RefusedError(_RANGE)

    @staticmethod
    def _set_amplitude(channel: Channel, value: str) -> None:
        """Clipped to what the instrument can do; an offset that leaves no room is moved."""
        number, unit = _value(value)
        open_vpp = channel.open_of(number, unit if unit in _UNITS else channel.unit)
        channel.open_vpp = min(max(open_vpp, _LOWEST_VPP), _HIGHEST_VPP)
        if channel.open_vpp != open_vpp:
            raise _RefusedError(_RANGE)
        allowed_vpp = channel.within_limits(open_vpp, channel.offset_v)
        room_v = 0.5 * (_HIGHEST_VPP - open_vpp)
        if allowed_vpp < open_vpp or abs(channel.offset_v) > room_v:
            channel.open_vpp = allowed_vpp
            channel.offset_v = math.copysign(min(abs(channel.offset_v), room_v), channel.offset_v)
            raise ConflictError

    @staticmethod
    def _set_unit(channel: Channel, value: str) -> None:
        if _one_of(value, *_UNITS) == "DBM" and channel.load_ohm >= INFINITE_OHM:
            raise ConflictError
        channel.unit = value

    @staticmethod
    def _set_offset(channel: Channel, value: str) -> None:
        wanted_v = _value(value)[0] / channel.shown
        room_v = 0.5 * (_HIGHEST_VPP - channel.open_vpp)
        channel.offset_v = min(max(wanted_v, -room_v), room_v)
        if channel.offset_v != wanted_v:
            raise _RefusedError(_RANGE)
        if channel.within_limits(channel.open_vpp, wanted_v) < channel.open_vpp:
            channel.offset_v = 0.0
            raise ConflictError

    @staticmethod
    def _set_on(channel: Channel, value: str) -> None:
        channel.on = _switch(value)

    @staticmethod
    def _set_load(channel: Channel, value: str) -> None:
        """What the panel shows changes; the voltage behind the 50 ohm stays."""
        ohm = INFINITE_OHM if value in {"INF", "INFINITY"} else _value(value)[0]
        if not (1.0 <= ohm <= 10e3 or ohm == INFINITE_OHM):
            raise _RefusedError(_RANGE)
        if channel.limited:  # it does not know which load the limits are for
            raise ConflictError
        channel.load_ohm = ohm
        if ohm == INFINITE_OHM:
            channel.unit = "VPP" if channel.unit == "DBM" else channel.unit

    @staticmethod
    def _set_polarity(channel: Channel, value: str) -> None:
        channel.polarity = _one_of(value[:3], "NOR", "INV").replace("NOR", "NORM")

    @staticmethod
    def _set_gating(channel: Channel, value: str) -> None:
        channel.gating = _one_of(value[:3], "NOR", "GAT").replace("NOR", "NORM")

    @staticmethod
    def _set_trigger(channel: Channel, value: str) -> None:
        channel.trigger = _one_of(value[:3], "IMM", "EXT", "TIM", "BUS")

    @staticmethod
    def _set_burst_mode(channel: Channel, value: str) -> None:
        channel.burst_mode = _one_of(value[:3], "TRI", "GAT").replace("TRI", "TRIG")

    @staticmethod
    def _set_cycles(channel: Channel, value: str) -> None:
        channel.burst_cycles = math.inf if value.startswith("INF") else max(_value(value)[0], 1.0)

    @staticmethod
    def _set_period(channel: Channel, value: str) -> None:
        channel.burst_period_s = max(_value(value)[0], 1e-6)

    @staticmethod
    def _hold_start(channel: Channel, value: str) -> None:
        channel.sweep_start_hz = max(_value(value)[0], 1e-6)

    @staticmethod
    def _hold_stop(channel: Channel, value: str) -> None:
        channel.sweep_stop_hz = max(_value(value)[0], 1e-6)

    @staticmethod
    def _set_limited(channel: Channel, value: str) -> None:
        on = _switch(value)
        high_v = channel.shown * (channel.offset_v + 0.5 * channel.open_vpp)
        low_v = channel.shown * (channel.offset_v - 0.5 * channel.open_vpp)
        if on and not channel.limit_low_v <= low_v <= high_v <= channel.limit_high_v:
            raise ConflictError
        channel.limited = on

    @staticmethod
    def _set_high(channel: Channel, value: str) -> None:
        channel.limit_high_v = _value(value)[0]

    @staticmethod
    def _set_low(channel: Channel, value: str) -> None:
        channel.limit_low_v = _value(value)[0]

    @staticmethod
    def _told_again(name: str) -> _Set:
        def act(channel: Channel, value: str) -> None:
            channel.rest[name] = _number(_value(value)[0])

        return act

    @staticmethod
    def _set_running(name: str) -> _Set:
        return lambda channel, value: channel.start(name, _switch(value))

    # ---- both channels -------------------------------------------------------------------------

    def _coupled(self, name: str) -> _Ask:
        return lambda _: str(int(self._couplings[name]))

    def _couple(self, name: str) -> _Set:
        def act(channel: Channel, value: str) -> None:
            del channel
            self._couplings[name] = _switch(value)

        return act

    def _set_track(self, channel: Channel, value: str) -> None:
        del channel
        self._tracking = _one_of({"0": "OFF", "1": "ON"}.get(value, value[:3]), "ON", "OFF", "INV")
        if self._tracking != "OFF":  # p. 315
            self._couplings = {"FREQ": False, "VOLT": False}

    @staticmethod
    def _set_combined(channel: Channel, value: str) -> None:
        channel.combined = _one_of(value, "NONE", "CH1", "CH2")


_Ask = Callable[[Channel], str]
_Set = Callable[[Channel, str], None]


def _runs(name: str) -> _Ask:
    return lambda channel: str(int(channel.running == name))


def _one_of(value: str, *allowed: str) -> str:
    if value not in allowed:
        raise _RefusedError(_KIND)
    return value


def _switch(value: str) -> bool:
    if value not in _ON:
        raise _RefusedError(_KIND)
    return _ON[value]


def _value(text: str) -> tuple[float, str]:
    """A finite number, and the unit that it was given in."""
    match = _NUMBER.fullmatch(text)
    if match is None or not math.isfinite(float(match[1])):
        raise _RefusedError(_KIND if match is None else _RANGE)
    suffix = match[2]
    for base in (*_BASES, ""):
        prefix = suffix.removesuffix(base) if base else suffix
        if suffix.endswith(base) and prefix in _FACTORS:
            mega = prefix == "M" and base == "HZ"  # MHZ is the only mega of SCPI beside MOHM
            return float(match[1]) * (1e6 if mega else _FACTORS[prefix]), base
    raise _RefusedError('-131,"Invalid suffix"')


def _number(value: float) -> str:
    return f"{INFINITE_OHM if math.isinf(value) else value:+.15E}"


def _header(pattern: str) -> re.Pattern[str]:
    """`VOLT[AGE]:UNIT` with the channel at the first word, as `SOUR1:` or as a suffix."""
    first, colon, rest = (
        word.replace("[", "(?:").replace("]", ")?") for word in pattern.partition(":")
    )
    if pattern.startswith(("OUTP", "TRIG")):
        return re.compile(rf"{first}(?P<channel>[12])?{colon}{rest}")
    return re.compile(rf"(?:SOUR(?:CE)?(?P<channel>[12])?:)?{first}{colon}{rest}")
