"""Whether the instruments of a bench are at rest, asked of themselves."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from haselab.rig import HighVoltageSupply, ReportsOutput, ReportsOutputState, Rig
from haselab.rig.drivers import quietly

__all__ = [
    "BackgroundCall",
    "OutputState",
    "discharged",
    "has_own_connection",
    "instrument_state",
    "instrument_states",
    "output_state",
]

_DISCHARGE_S = 3.0  # of a supply's own capacitor
_LOOK_S = 0.05
_TRIALS = 2  # a measurement that failed once may have met a busy computer


@dataclass(frozen=True)
class OutputState:
    """What an instrument was found at.

    Args:
        left: what is energised; empty if nothing is known to be.
        silent: why it could not be asked; empty if it could.
        voltage_v: measured after the amplifier; 0 V where that is not what was asked.
    """

    left: str = ""
    silent: str = ""
    voltage_v: float = 0.0

    @property
    def confirmed(self) -> bool:
        """It was asked, and is at rest."""
        return not (self.left or self.silent)

    @property
    def fault(self) -> str:
        """What is wrong; empty where rest is confirmed."""
        return self.left or self.silent


def has_own_connection(instrument: object) -> bool:
    """Whether an instrument has a connection of its own, so that it can be called at any time."""
    return isinstance(instrument, ReportsOutputState)


def output_state(rig: Rig, residual_v: float) -> OutputState | None:
    """Whether the drive output is at 0 V.

    Args:
        rig: not guarded.
        residual_v: after the amplifier, at which it counts as safe.
    Returns:
        What was found; None where the source cannot be asked.
    """
    source = rig.source
    if not isinstance(source, ReportsOutput):
        return None
    silent = ""
    for _ in range(_TRIALS):
        try:
            left_v = source.read_back() * rig.description.amplifier_gain
        except Exception as error:  # whatever the driver does: the bench is not known to be safe
            silent = f"{type(error).__name__}: {error}"
            continue
        if abs(left_v) < residual_v:
            return OutputState(voltage_v=left_v)
        return OutputState(left=f"{left_v:.4g} V remain at the output", voltage_v=left_v)
    return OutputState(silent=silent)


def instrument_states(rig: Rig, residual_v: float) -> list[OutputState]:
    """Whether generator and supply are off, by their own words.

    Args:
        rig: not guarded.
        residual_v: of the supply, in V, where it has no switch to ask for.
    """
    reported = (instrument_state(rig, line, residual_v) for line in (rig.generator, rig.supply))
    return [found for found in reported if found is not None]


def instrument_state(rig: Rig, instrument: object, residual_v: float) -> OutputState | None:
    """Whether one of them is off.

    Args:
        rig: not guarded.
        instrument: its generator or its supply.
        residual_v: of the supply, in V, where it has no switch to ask for.
    Returns:
        What was found; None where it cannot be asked.
    """
    supply = rig.supply
    if supply is not None and instrument is supply:
        return _asked("the supply", lambda: _supply_off(supply, residual_v))
    if instrument is rig.generator and isinstance(instrument, ReportsOutputState):
        return _asked("the generator", instrument.is_off)
    return None


def _supply_off(supply: HighVoltageSupply, residual_v: float) -> bool:
    if isinstance(supply, ReportsOutputState):
        return supply.is_off()
    return abs(supply.read_voltage()) < residual_v


def discharged(rig: Rig, residual_v: float) -> str:
    """Wait for a supply that was switched off to run down.

    Args:
        rig: not guarded.
        residual_v: at which it has, where the supply has no `tolerance_v` of its own meter.
    Returns:
        What is wrong after `_DISCHARGE_S`; empty where it has run down, or there is no supply.
    """
    if rig.supply is None:
        return ""
    limit_v = float(getattr(rig.supply, "tolerance_v", residual_v))
    end_s = time.monotonic() + _DISCHARGE_S
    while True:
        try:
            left_v = rig.supply.read_voltage()
        except Exception as error:
            return f"The supply cannot be asked for what is left ({type(error).__name__}: {error})."
        if abs(left_v) <= limit_v:
            return ""
        if time.monotonic() >= end_s:
            return (
                f"The supply shows {left_v:.4g} V {_DISCHARGE_S:g} s after it was switched off "
                f"(limit {limit_v:g} V)."
            )
        time.sleep(_LOOK_S)


def _asked(name: str, is_off: Callable[[], bool]) -> OutputState:
    try:
        return OutputState() if is_off() else OutputState(left=f"{name} is on")
    except Exception as error:
        return OutputState(silent=f"{name} cannot be asked ({type(error).__name__}: {error})")


class BackgroundCall:
    """An act in a thread of its own, tried twice: an instrument that hangs keeps no other one.

    Args:
        act: a call to an instrument that has a connection of its own.
    """

    def __init__(self, act: Callable[[], None]) -> None:
        self._act = act
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="to rest", daemon=True)
        try:
            self._thread.start()
        except RuntimeError:  # no thread can be had: then here and now
            self._run()

    def _run(self) -> None:
        for _ in range(2):
            self._error = quietly(self._act)
            if self._error is None:
                return

    def done(self, within_s: float) -> bool:
        """Whether it is done within this time."""
        if self._thread.ident is not None:
            self._thread.join(within_s)
        return not self._thread.is_alive()

    def wait(self) -> None:
        """Until it is done.

        Raises:
            Exception: what the driver raised, against its contract.
        """
        if self._thread.ident is not None:
            self._thread.join()
        if self._error is not None:
            raise self._error
