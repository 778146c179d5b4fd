"""Query the instruments of a bench: are they off?"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from haselab.base import described
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

_DISCHARGE_S = 3.0  # longest discharge of a supply's output capacitor
_LOOK_S = 0.05
_TRIALS = 2  # one failure may be due to a busy computer


@dataclass(frozen=True)
class OutputState:
    """What was found out about the output of an instrument.

    Args:
        energised: what is energised; empty if nothing is known to be.
        unreachable: why the instrument could not be queried; empty if it could.
        voltage_v: measured at the amplifier's output; 0 V if it was not measured.
    """

    energised: str = ""
    unreachable: str = ""
    voltage_v: float = 0.0

    @property
    def confirmed(self) -> bool:
        """Whether the instrument was queried and is off."""
        return not (self.energised or self.unreachable)

    @property
    def fault(self) -> str:
        """What is wrong; empty if the instrument is confirmed off."""
        return self.energised or self.unreachable


def has_own_connection(instrument: object) -> bool:
    """Whether an instrument has its own connection, so that it can be called at any time."""
    return isinstance(instrument, ReportsOutputState)


def output_state(rig: Rig, residual_v: float) -> OutputState | None:
    """Whether the drive output is at 0 V.

    Args:
        rig: not guarded.
        residual_v: voltage at the amplifier's output below which it counts as safe.
    Returns:
        What was found; None if the source cannot report its output.
    """
    source = rig.source
    if not isinstance(source, ReportsOutput):
        return None
    silent = ""
    for _ in range(_TRIALS):
        try:
            left_v = source.read_back() * rig.description.amplifier_gain
        except Exception as error:  # whatever the driver does: the bench is not known to be safe
            silent = described(error)
            continue
        if abs(left_v) < residual_v:
            return OutputState(voltage_v=left_v)
        return OutputState(energised=f"{left_v:.4g} V remain at the output", voltage_v=left_v)
    return OutputState(unreachable=silent)


def instrument_states(rig: Rig, residual_v: float) -> list[OutputState]:
    """Whether generator and supply report that they are off.

    Args:
        rig: not guarded.
        residual_v: voltage below which a supply without an output switch counts as off, in V.
    """
    reported = (instrument_state(rig, line, residual_v) for line in (rig.generator, rig.supply))
    return [found for found in reported if found is not None]


def instrument_state(rig: Rig, instrument: object, residual_v: float) -> OutputState | None:
    """Whether generator or supply reports that it is off.

    Args:
        rig: not guarded.
        instrument: its generator or its supply.
        residual_v: voltage below which a supply without an output switch counts as off, in V.
    Returns:
        What was found; None if it cannot report its output.
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
    """Wait until a supply that was switched off has discharged.

    Args:
        rig: not guarded.
        residual_v: voltage at which it has, if the supply states no `tolerance_v` of its meter.
    Returns:
        The fault after `_DISCHARGE_S`; empty if it has discharged, or there is no supply.
    """
    if rig.supply is None:
        return ""
    limit_v = float(getattr(rig.supply, "tolerance_v", residual_v))
    end_s = time.monotonic() + _DISCHARGE_S
    while True:
        try:
            left_v = rig.supply.read_voltage()
        except Exception as error:
            return f"The supply's voltage cannot be read ({described(error)})."
        if abs(left_v) <= limit_v:
            return ""
        if time.monotonic() >= end_s:
            return (
                f"The supply still shows {left_v:.4g} V, {_DISCHARGE_S:g} s after it was switched "
                f"off (limit {limit_v:g} V)."
            )
        time.sleep(_LOOK_S)


def _asked(name: str, is_off: Callable[[], bool]) -> OutputState:
    try:
        return OutputState() if is_off() else OutputState(energised=f"{name} is on")
    except Exception as error:
        return OutputState(unreachable=f"{name} does not respond ({described(error)})")


class BackgroundCall:
    """A call in its own thread, tried twice, so that one that hangs does not delay the others.

    Args:
        act: a call to an instrument that has its own connection.
    """

    def __init__(self, act: Callable[[], None]) -> None:
        self._act = act
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="to rest", daemon=True)
        try:
            self._thread.start()
        except RuntimeError:  # no thread available: call it directly
            self._run()

    def _run(self) -> None:
        for _ in range(2):
            self._error = quietly(self._act)
            if self._error is None:
                return

    def done(self, within_s: float) -> bool:
        """Whether the call ends within this time."""
        if self._thread.ident is not None:
            self._thread.join(within_s)
        return not self._thread.is_alive()

    def wait(self) -> None:
        """Wait until the call has ended.

        Raises:
            Exception: The driver raised it, against its contract.
        """
        if self._thread.ident is not None:
            self._thread.join()
        if self._error is not None:
            raise self._error
