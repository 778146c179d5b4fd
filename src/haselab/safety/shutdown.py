"""Take a bench to 0 V and confirm it."""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from haselab.base import SafetyError, described
from haselab.rig import FunctionGenerator, HighVoltageSupply, ReportsOutput
from haselab.safety.instrument_state import (
    BackgroundCall,
    OutputState,
    discharged,
    has_own_connection,
    instrument_state,
    output_state,
)

if TYPE_CHECKING:
    from haselab.safety.guarded import GuardedRig

__all__ = ["ReadBack", "Shutdown"]

_READ_BACK_BLOCKS = 3  # 30 ms: the output has settled at 0 V, and queued values have passed
_LONGEST_S = 15.0  # a driver that has not returned by then is abandoned
_PATIENCE_S = 0.25  # wait for an instrument to confirm before a guardian is called


class ReadBack(NamedTuple):
    """What is known of the output at the end.

    Args:
        text: what was read back, for the record; or why that was not possible.
        at_zero: whether the bench was read back at 0 V.
    """

    text: str
    at_zero: bool


class Shutdown:
    """Takes a guarded rig to 0 V and reads it back.

    Args:
        rig: behind its safety chain.
    """

    def __init__(self, rig: GuardedRig) -> None:
        self._rig, self._plain = rig, rig.plain
        self._safety, self._bench = rig.safety, rig.bench
        self._limit_v = rig.safety.settings.residual_v

    def run(self) -> None:
        """Go to 0 V, stop sensing signal and camera; a step that fails does not stop the others.

        Instruments with their own connection are switched off in parallel, so that one that hangs
        does not delay the others. A driver that raises is called once more. If 0 V is not
        confirmed, the guardians are called; they have separate connections.
        """
        with contextlib.suppress(OSError):  # a failing interlock must not prevent 0 V
            if self._safety.gate.interlock.live:  # shorten the time until the guardians act
                self._safety.gate.interlock.lease(self._safety.settings.lease_s)
        self._wait_for_guardian()
        stopped: BaseException | None = None
        for act in self._shutdown_steps():
            for _ in range(2):
                try:
                    act()
                    break
                except Exception as error:
                    failed = described(error)
                except BaseException as error:
                    stopped = error
            else:
                failed = failed if stopped is None else described(stopped)
                self._ask_guardian(f"a driver failed during shutdown: {failed}")
        if stopped is not None:
            raise stopped

    def _shutdown_steps(self) -> list[Callable[[], None]]:
        """The steps in order, the output first; instruments with a connection run in threads."""
        self._bench.outdate()
        looks = not self._bench.found and self._safety.settings.read_back
        background, others = [], []
        for name, plain, guarded in (
            ("supply", self._plain.supply, self._rig.supply),
            ("generator", self._plain.generator, self._rig.generator),
        ):
            if guarded is not None and has_own_connection(plain):
                act = functools.partial(self._switch_off, name, guarded, plain, looks)
                background.append((BackgroundCall(act), name))
            elif guarded is not None:
                others.append(guarded.off)
        confirm = [self._confirm_output] if looks else []
        waits = [functools.partial(self._wait_for, *each) for each in background]
        return [
            self._rig.source.zero,
            *others,
            *confirm,
            self._safety.gate.behind(self._rig.camera).stop,
            self._rig.source.zero,  # again: a camera may have used the board meanwhile
            *others,
            *confirm,
            *waits,
            self._wait_for_guardian,
        ]

    def _switch_off(
        self, name: str, guarded: FunctionGenerator | HighVoltageSupply, plain: object, looks: bool
    ) -> None:
        """Switch one instrument off; if it does not confirm, call the guardian at once."""
        guarded.off()
        if looks:
            self._confirm(name, instrument_state(self._plain, plain, self._limit_v))

    def _confirm_output(self) -> None:
        """Read the source's own meter, unless it was found energised or unreachable before."""
        before = self._bench.found.get("output")
        if before is None or before.confirmed:
            self._confirm("output", output_state(self._plain, self._limit_v))

    def _wait_for(self, call: BackgroundCall, name: str) -> None:
        """Wait for one instrument; call the guardians early, and give up after `_LONGEST_S`."""
        if not call.done(_PATIENCE_S):
            self._ask_guardian(f"no reply within {_PATIENCE_S:g} s during shutdown")
        if call.done(_LONGEST_S):
            call.wait()
        else:
            self._confirm(
                name,
                OutputState(unreachable=f"{name}: off() has not returned within {_LONGEST_S:g} s"),
            )

    def _wait_for_guardian(self) -> None:
        """Wait until the guardian has acted: two readers on a serial port would mix up replies."""
        if self._bench.asked_guardian and self._safety.guardians is not None:
            self._safety.guardians.outcome()

    def _confirm(self, name: str, found: OutputState | None) -> None:
        """Keep the first fault of an instrument; call the guardian if it is not confirmed off."""
        if found is None:
            return
        with self._bench.turn:
            before = self._bench.found.get(name)
            if before is None or before.confirmed:
                self._bench.found[name] = found
        if not found.confirmed:
            self._ask_guardian(f"not confirmed at 0 V: {found.fault}")

    def _ask_guardian(self, reason: str) -> None:
        with self._bench.turn:
            self._bench.unconfirmed = self._bench.unconfirmed or reason
            if self._safety.guardians is None or self._bench.asked_guardian:
                return
            self._bench.asked_guardian = True
            self._safety.guardians.make_safe(reason)

    def read_back(self) -> ReadBack:
        """Check by meters, monitors and instrument states that the bench is at 0 V.

        Returns:
            What was read back; or why that was not possible, and what made the bench safe then.
        Raises:
            SafetyError: An output is above `residual_v`, or an instrument is on; or an instrument
                does not respond, and no guardian made it safe.
        """
        if not self._safety.settings.read_back:
            return ReadBack("0 V commanded; not read back", at_zero=False)
        self._bench.outdate()
        known = self._bench.found
        if "output" not in known:
            self._confirm_output()
            if not isinstance(self._plain.source, ReportsOutput):
                self._confirm("output", self._by_blocks())
        for name, line in (("supply", self._plain.supply), ("generator", self._plain.generator)):
            if line is not None and name not in known:
                self._confirm(name, instrument_state(self._plain, line, self._limit_v))
        found = next((each for each in known.values() if not each.confirmed), known["output"])
        if not found.confirmed:
            return ReadBack(self._unconfirmed(found), at_zero=False)
        if fault := discharged(self._plain, self._limit_v):
            reported = f"Switch the high voltage off by hand, and short it. {fault}"
            self._safety.trip(reported)
            raise SafetyError(reported)
        return ReadBack(f"output at 0 V; {found.voltage_v:.2g} V read back", at_zero=True)

    def _unconfirmed(self, found: OutputState) -> str:
        """Trip a bench that is not confirmed at 0 V; return what the guardians did, or raise."""
        fault = "this rig has no guardians"
        if self._safety.guardians is not None:
            fault = self._safety.guardians.outcome()
        if not fault and not found.energised:
            self._safety.trip(f"Not confirmed at 0 V; a guardian made it safe: {found.unreachable}")
            return f"0 V by the guardian; not read back ({found.unreachable})"
        from_blocks = not isinstance(self._plain.source, ReportsOutput)
        if self._plain.simulated and from_blocks and not found.energised:  # no voltage is possible
            return f"0 V commanded; not read back ({found.unreachable})"
        allowed = f" (limit {self._limit_v:g} V)" if found.energised else ""
        by = (
            f"; the guardians could not confirm 0 V either: {fault}"
            if fault
            else "; the guardian has acted"
        )
        reported = (
            f"Output {'not' if found.energised else 'not confirmed'} at 0 V: {found.fault}{allowed}"
            f"{by}. Switch the high voltage off by hand."
        )
        self._safety.trip(reported)
        raise SafetyError(reported)

    def _by_blocks(self) -> OutputState:
        """The output by the voltage monitor, for a source without a meter."""
        blocks = _READ_BACK_BLOCKS + self._rig.description.queued_blocks
        left_v = math.inf
        try:
            for _ in range(blocks):
                codes = self._plain.acquisition.read()
                self._bench.watch.check_form(codes, None)
                left_v = self._bench.watch.residual_v(codes)
                if left_v < self._limit_v:
                    return OutputState(voltage_v=left_v)
        except Exception as error:  # any failure: 0 V is not confirmed
            return OutputState(unreachable=described(error))
        return OutputState(energised=f"{left_v:.4g} V remain at the output", voltage_v=left_v)
