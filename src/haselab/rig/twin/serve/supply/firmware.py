"""The firmware of a single-channel Peta-Pico-Voltron supply, including its known defects.

Written from the published Arduino code (version 8 and the switchboard's fork of it, version 1;
files `SerialComm`, `Functions` and the main loop) and petapicovoltron.com, "Direct communication
with the HVPS". What a driver must not rely on:

- The optocoupler at the output follows the switching mode only while the switch source is the
  firmware's own (0). The mode is stored and echoed all the same.
- A change of the switch source leaves the optocoupler as it is.
- After the waveform mode the regulator keeps the last point of the waveform as its set point while
  the mode is 0, whatever `SVset` says, until `SSwMode` is sent a second time.
- With a number of cycles stored, the button starts them again although the mode is 0.
- A set point beyond the highest voltage, or a negative one, becomes the highest voltage.
- Without its power jack, or with its main switch off, it echoes everything and gives no voltage.
- Commands are recognised by their first letters; the buffer is not cleared after a command, so an
  empty line repeats the last one; after 19 characters without an end of line it starts again.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass

__all__ = ["ERROR", "SupplyFaults", "SupplyFirmware"]

ERROR = "Err"
_BUFFER = 19  # characters of a command
_ADC_TOP, _ADC_LEAST = 1023, 5  # ten bits; a smaller reading counts as 0 V
_OFF, _DC, _SWITCHING, _WAVEFORM = range(4)  # SwMode
_OWN, _EXTERNAL, _BUTTON = range(3)  # SwSrc
_REGULATED, _EXTERNAL_V, _OPEN_LOOP = range(3)  # VMode
_STORED = ("vset", "source", "mode", "vmode", "frequency_hz", "latch", "cycles")


@dataclass(frozen=True)
class SupplyFaults:
    """Faults of an emulated supply; none by default.

    Args:
        left_by: commands that another program had sent before.
        stored_set_v: set point in its EEPROM, taken over at power-on, in V.
        stored_source: switch source in its EEPROM.
        stored_mode: switching mode in its EEPROM; `Conf` writes 1, at 0 V.
        stored_voltage_mode: voltage mode in its EEPROM.
        stored_cycles: number of cycles in its EEPROM.
        jack_used: it takes its power from the jack (`QPowJack`).
        jack_in: the power jack is plugged in (`QJack`).
        enabled: its main switch is on; this cannot be queried.
        button_down: the button is pressed.
        external_high: level at the input of the external switch source.
        external_v: what the input of the external set point asks for, in V.
        version: what it answers to `QVer`.
        relays_open: a switchboard, whose relays are between it and the output.
        reach_v: highest voltage, in V.
        stale: replies to another program that still arrive after opening.
        fragment: what another program has written without an end of line.
        debug: it sends a line of its regulator's values before every answer.
        meter_error_v: of `QVnow`, in V.
        decay_s: time constant of the converter's voltage when the set point is lowered, in s.
        stuck_v: the converter does not go below this voltage, in V.
    """

    left_by: tuple[str, ...] = ()
    stored_set_v: int = 0
    stored_source: int = _OWN
    stored_mode: int = _DC
    stored_voltage_mode: int = _REGULATED
    stored_cycles: int = 0
    jack_used: bool = True
    jack_in: bool = True
    enabled: bool = True
    button_down: bool = False
    external_high: bool = False
    external_v: float = 0.0
    version: str = "slave 8"
    relays_open: bool = False
    reach_v: int = 5000
    stale: bytes = b""
    fragment: bytes = b""
    debug: bool = False
    meter_error_v: float = 0.0
    decay_s: float = 0.05
    stuck_v: float = 0.0


class SupplyFirmware:
    """Interpreter of its commands, with the state of converter and output switch.

    Args:
        name: what it answers to `QName`.
        faults: what is wrong with it.
    """

    def __init__(self, name: str, faults: SupplyFaults) -> None:
        self.name = name
        self.faults = faults
        self.jack_in, self.enabled = faults.jack_in, faults.enabled
        self.power_jack = int(faults.jack_used)
        self.reach_v = faults.reach_v
        self._eeprom: dict[str, float] = {
            "vset": faults.stored_set_v,
            "source": faults.stored_source,
            "mode": faults.stored_mode,
            "vmode": faults.stored_voltage_mode,
            "frequency_hz": 1.0,
            "latch": 0,
            "cycles": faults.stored_cycles,
        }
        self._button = faults.button_down
        self.power_on()
        self._fill(faults.fragment)

    def power_on(self) -> None:
        """Start at power-on with the stored settings."""
        self._buffer, self._end = bytearray(_BUFFER + 1), 0
        stored = {key: self._eeprom[key] for key in _STORED}
        self.vset = int(stored["vset"])
        self.source = int(stored["source"]) if stored["source"] <= _BUTTON else _OWN
        self.mode = int(stored["mode"]) if stored["mode"] <= _WAVEFORM else _OFF
        self.vmode = int(stored["vmode"]) if stored["vmode"] <= _OPEN_LOOP else _REGULATED
        self.frequency_hz = float(stored["frequency_hz"])
        self.latch, self.cycles = int(stored["latch"]), int(stored["cycles"])
        self.mode_before = _OFF
        self.debug = self.faults.debug
        self._points: list[int] = []
        self._waveform_v = 0
        self._follows = False  # the interrupt of the external source; `setup` does not attach it
        self.closed = self.source == _OWN and self.mode != _OFF
        self._loop()

    # ---- what it does to the outside -----------------------------------------------------------

    @property
    def converter_v(self) -> float:
        """Set point of the converter, in V."""
        if not (self.enabled and (not self.power_jack or self.jack_in)):
            return 0.0
        if self.vmode in (_REGULATED, _OPEN_LOOP):
            waveform = self.mode == _WAVEFORM
            if self.vmode == _REGULATED and self.mode == _OFF and self.mode_before == _WAVEFORM:
                waveform = True
            return float(self._waveform_v if waveform else self.vset)
        return self.faults.external_v

    def press(self, down: bool) -> None:
        """The button."""
        before, self._button = self._button, down
        if self.source == _BUTTON and self.latch and down and not before:
            self.closed = not self.closed
        self._loop()

    def external(self, high: bool) -> None:
        """Level at the input of the external switch source: it follows each change."""
        if self.source == _EXTERNAL and self._follows:
            self.closed = high

    def _loop(self) -> None:
        """`switching()`, which the main loop calls all the time."""
        if self.source == _BUTTON:
            if not self.latch:
                self.closed = self._button
        elif self.mode == _OFF and self.cycles > 0 and self._button:
            self.mode = self.mode_before if self.mode_before >= _SWITCHING else _SWITCHING
            self.closed = True  # half of the time

    def meter_v(self, voltage_v: float) -> int:
        """Reading of a voltage by the converter's divider and the 10-bit ADC."""
        share = (voltage_v + self.faults.meter_error_v) / self.reach_v
        code = min(max(round(_ADC_TOP * share), 0), _ADC_TOP)
        return 0 if code < _ADC_LEAST else int(code / _ADC_TOP * self.reach_v + 0.5)

    # ---- the serial line -----------------------------------------------------------------------

    def take(self, data: bytes) -> Iterator[str]:
        """The commands that these bytes complete, as they stand in its buffer."""
        for byte in data:
            if byte != 0x0D:
                self._fill(bytes([byte]))
                continue
            self._end = 0
            yield bytes(self._buffer).partition(b"\0")[0].decode("latin-1")

    def _fill(self, data: bytes) -> None:
        for byte in data:
            self._buffer[self._end] = byte
            self._end += 1
            self._buffer[self._end] = 0
            if self._end >= _BUFFER:
                self._end = 0

    def answer(self, command: str, now_v: float) -> str:
        """Execute a command.

        Args:
            command: without its end.
            now_v: voltage of the converter, in V.
        """
        reported = ERROR
        for word, act in self._commands(now_v):
            if command.startswith(word):
                reported = act(command[len(word) :])
                break
        self._loop()
        return reported

    def _commands(self, now_v: float) -> list[tuple[str, Callable[[str], str]]]:
        """In the order in which it compares them."""
        return [
            ("QJack", lambda _: str(int(self.jack_in))),
            ("SPowJack", lambda p: self._keep("power_jack", _byte(p))),
            ("QPowJack", lambda _: str(self.power_jack)),
            ("QVmax", lambda _: str(self.reach_v)),
            ("Conf", self._configure),
            ("SVset", self._set_voltage),
            ("QVset", lambda _: str(self.vset)),
            ("QVnow", lambda _: str(self.meter_v(now_v))),
            ("SSwSrc", self._set_source),
            ("QSwSrc", lambda _: str(self.source)),
            ("SSwMode", self._set_mode),
            ("QSwMode", lambda _: str(self.mode)),
            ("SVMode", lambda p: self._keep("vmode", _byte(p))),
            ("QVMode", lambda _: str(self.vmode)),
            ("SLatchMode", lambda p: self._keep("latch", int(_byte(p) != 0))),
            ("QLatchMode", lambda _: str(self.latch)),
            ("SF", self._set_frequency),
            ("QF", lambda _: f"{self.frequency_hz:.4f}"),
            ("SCycle", lambda p: self._keep("cycles", _word(p))),
            ("QCycle", lambda _: f"0/{self.cycles}"),
            ("SP", self._set_point),
            ("QPtot", lambda _: str(len(self._points))),
            ("QName", lambda _: self.name),
            ("Save", self._save),
            ("QVe", lambda _: self.faults.version),
            ("Debug", lambda _: self._keep("debug", int(not self.debug))),
            ("QMem", lambda _: self._memory()),
        ]

    def _keep(self, what: str, value: int) -> str:
        setattr(self, what, value)
        return str(value)

    def _set_voltage(self, parameter: str) -> str:
        return self._keep("vset", min(_word(parameter), self.reach_v))

    def _set_source(self, parameter: str) -> str:
        """The pin of the optocoupler stays as it is."""
        self.source = _byte(parameter)
        if self.source == _OWN and self.mode == _SWITCHING:
            self.closed = True  # the timer runs again
        self._follows = self.source == _EXTERNAL
        return str(self.source)

    def _set_mode(self, parameter: str) -> str:
        self.mode_before, self.mode = self.mode, _byte(parameter)
        if self.mode == _WAVEFORM:
            self._waveform_v = round(max(self._points, default=0) / 255 * self.vset)
        if self.source == _OWN:
            self.closed = self.mode != _OFF
        return str(self.mode)

    def _set_frequency(self, parameter: str) -> str:
        match = re.match(r"\s*[-+]?\d*\.?\d*", parameter)
        text = match[0].strip() if match else ""
        value = float(text) if re.search(r"\d", text) else 0.0
        self.frequency_hz = min(max(value, 0.001), 5000.0)
        return f"{self.frequency_hz:.4f}"

    def _set_point(self, parameter: str) -> str:
        if "X" in parameter[:2]:
            self._points = []
            return "0"
        self._points.append(_byte(parameter))
        return f"{len(self._points)},{self._points[-1]}"

    def _configure(self, parameter: str) -> str:
        """Factory settings: in the mode DC, at 0 V."""
        self.reach_v = _word(parameter)
        self.vset, self.source, self.mode, self.vmode = 0, _OWN, _DC, _REGULATED
        self._save("")
        return str(self.reach_v)

    def _save(self, parameter: str) -> str:
        del parameter
        self._eeprom = {key: getattr(self, key) for key in _STORED}
        return "1"

    def _memory(self) -> str:
        m = self._eeprom
        return (
            f"{m['vset']:.0f},{m['frequency_hz']:.4f},{m['source']:.0f},{m['mode']:.0f},"
            f"{m['vmode']:.0f},0.230,2.200,0.0040,0.0000,1.0503,0.0000,{m['cycles']:.0f},"
            f"{m['latch']:.0f}"
        )

    def debug_line(self, now_v: float) -> str:
        """What it sends on its own once `Debug` is on."""
        return f"{self.meter_v(now_v)}, {self.vset}, 0"


def _integer(text: str) -> int:
    """`atoi` of a processor whose integers have 16 bits."""
    match = re.match(r"\s*([-+]?)(\d+)", text)
    if match is None:
        return 0
    value = 0
    for digit in match[2]:
        value = (10 * value + int(digit)) % 0x10000
    value = -value if match[1] == "-" else value
    return (value + 0x8000) % 0x10000 - 0x8000


def _word(text: str) -> int:
    return _integer(text) % 0x10000


def _byte(text: str) -> int:
    return _integer(text) % 0x100
