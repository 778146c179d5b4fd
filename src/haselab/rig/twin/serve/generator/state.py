"""The settings of an emulated Keysight 33522B, and their effect on its output.

Source: 33500 Series Operating and Service Guide (33500-90901): output termination p. 62, burst
p. 177, channel tracking p. 315, voltage limits p. 323, amplitude limits p. 215 (10 Vpp into 50 ohm,
20 Vpp into an open circuit). That a value out of range is clipped, with an error, is the rule of
its sibling E1441A (command reference, p. 99). What modulation leaves of the carrier is computed for
a detector that averages over many of its periods.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, field

__all__ = ["INFINITE_OHM", "MODULATIONS", "Channel", "ConflictError", "GeneratorFaults", "Sine"]

INFINITE_OHM = 9.9e37
MODULATIONS = ("AM", "FM", "PM", "FSK", "BPSK", "PWM", "SUM")
_OUTPUT_OHM = 50.0
_AVERAGED = 400  # phases of a modulating sine


class ConflictError(Exception):
    """A setting was changed, contrary to the request: `Settings conflict`."""


@dataclass(frozen=True)
class GeneratorFaults:
    """Faults of an emulated generator; none by default.

    Args:
        panel: SCPI lines that stand for what its last user has set.
        connections: data sockets that it takes at once; the EDU33210 series takes two.
        model: of the 33500B series.
        answer_s: delay of every answer, in s.
        reset_s: that `*RST` takes, in s.
        triggers: something at its trigger input triggers bursts and opens gates.
    """

    panel: tuple[str, ...] = ()
    connections: int = 2
    model: str = "33522B"
    answer_s: float = 0.0
    reset_s: float = 0.0
    triggers: bool = False


@dataclass(frozen=True)
class Sine:
    """Output into an open circuit.

    Args:
        frequency_hz: frequency, in Hz.
        amplitude_v: the carrier's amplitude that is left, in V.
        offset_v: direct voltage, in V.
    """

    frequency_hz: float
    amplitude_v: float
    offset_v: float = 0.0


@dataclass
class Channel:
    """Settings as the front panel shows them; the defaults are those of `*RST`."""

    shape: str = "SIN"
    frequency_hz: float = 1e3
    open_vpp: float = 0.2  # into an open circuit: 100 mVpp into 50 ohm
    offset_v: float = 0.0  # into an open circuit
    unit: str = "VPP"
    load_ohm: float = 50.0
    on: bool = False
    polarity: str = "NORM"
    gating: str = "NORM"
    running: str = ""  # one of "BURS", "SWE" and the modulations, or none
    burst_mode: str = "TRIG"
    burst_cycles: float = 1.0
    burst_period_s: float = 10e-3
    trigger: str = "IMM"
    sweep_start_hz: float = 100.0
    sweep_stop_hz: float = 1e3
    am_depth: float = 1.0
    fm_deviation_hz: float = 100.0
    pm_deviation_rad: float = math.pi
    modulating_hz: float = 10.0
    limited: bool = False
    limit_high_v: float = 10.0  # of what is shown
    limit_low_v: float = -10.0
    combined: str = "NONE"
    rest: dict[str, str] = field(default_factory=dict)  # settings that are only read back

    def copied(self) -> Channel:
        """Another channel with the same settings, as by tracking."""
        return copy.deepcopy(self)

    @property
    def shown(self) -> float:
        """Fraction of the open-circuit voltage that the panel shows."""
        if self.load_ohm >= INFINITE_OHM:
            return 1.0
        return self.load_ohm / (self.load_ohm + _OUTPUT_OHM)

    @property
    def amplitude(self) -> float:
        """In its unit."""
        vpp = self.open_vpp * self.shown
        if self.unit == "VRMS":
            return vpp / math.sqrt(8.0)
        if self.unit == "DBM":
            return 10.0 * math.log10(1e3 * vpp**2 / 8.0 / self.load_ohm)
        return vpp

    def open_of(self, number: float, unit: str) -> float:
        """Peak-to-peak voltage into an open circuit of an amplitude in a unit, in V."""
        if unit == "VRMS":
            number *= math.sqrt(8.0)
        elif unit == "DBM":
            number = math.sqrt(8.0 * self.load_ohm * 1e-3 * 10.0 ** (number / 10.0))
        return number / self.shown

    def within_limits(self, open_vpp: float, offset_v: float) -> float:
        """The amplitude that its voltage limits allow, in V into an open circuit."""
        if not self.limited:
            return open_vpp
        room_v = min(
            self.limit_high_v / self.shown - offset_v, offset_v - self.limit_low_v / self.shown
        )
        return min(open_vpp, 2.0 * max(room_v, 0.0))

    def start(self, what: str, on: bool) -> None:
        """Burst, sweep or a modulation on or off; only one of them runs.

        Raises:
            ConflictError: it does not go with the waveform, or another one is switched off by it.
        """
        if not on:
            self.running = "" if self.running == what else self.running
            return
        if what == "PWM" and self.shape != "PULS":
            raise ConflictError
        before, self.running = self.running, what
        if before not in {"", what}:
            raise ConflictError

    def output(self, triggers: bool) -> Sine:
        """Compute its output.

        Args:
            triggers: something is at the trigger input.
        """
        amplitude_v = 0.5 * self.open_vpp
        if not self.on or (self.gating == "GAT" and not triggers):
            return Sine(self.frequency_hz, 0.0)
        if self.shape != "SIN":
            return Sine(self.frequency_hz, 0.0, self.offset_v)
        if self.running == "SWE":
            middle_hz = 0.5 * (self.sweep_start_hz + self.sweep_stop_hz)
            return Sine(middle_hz, amplitude_v, self.offset_v)
        return Sine(self.frequency_hz, amplitude_v * self._left(triggers), self.offset_v)

    def _left(self, triggers: bool) -> float:
        """Fraction of the carrier that remains with burst or modulation."""
        if self.running == "BURS":
            return self._burst(triggers)
        if self.running == "AM":
            return 1.0 - 0.5 * min(self.am_depth, 1.0)
        if self.running == "FM":
            return _bessel(self.fm_deviation_hz / self.modulating_hz)
        if self.running == "PM":
            return _bessel(self.pm_deviation_rad)
        if self.running == "FSK":
            return 0.5
        return 0.0 if self.running == "BPSK" else 1.0

    def _burst(self, triggers: bool) -> float:
        if self.burst_mode == "GAT" or self.trigger == "EXT":
            return 1.0 if triggers else 0.0
        if self.trigger != "IMM":
            return 0.0
        if math.isinf(self.burst_cycles):
            return 1.0
        return min(1.0, self.burst_cycles / self.frequency_hz / self.burst_period_s)


def _bessel(depth: float) -> float:
    """Remaining carrier with phase modulation of +-depth: |J0|."""
    phases = (depth * math.sin(2.0 * math.pi * k / _AVERAGED) for k in range(_AVERAGED))
    return abs(sum(math.cos(phase) for phase in phases)) / _AVERAGED
