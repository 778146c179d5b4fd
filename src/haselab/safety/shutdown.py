"""The way to 0 V, and the proof that it was reached."""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from haselab.base import SafetyError
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

__all__ = ["Shutdown"]

_READ_BACK_BLOCKS = 3  # 30 ms: the output has gone down, and what was queued has passed
_LONGEST_S = 15.0  # a driver that has not returned by then is left behind
_PATIENCE_S = 0.25  # with an instrument that does not say that it is off, where there is a guardian


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
        """0 V, no sensing signal, camera off; each act is tried whatever the others did.

        Instruments with a connection of their own are switched off at the same time, so that one
        that hangs does not delay the others. A driver that raises here is called once more. Where
        0 V is not confirmed, the guardians are asked; they have connections of their own.
        """
        with contextlib.suppress(OSError):  # an interlock that fails must not come before 0 V
            if self._safety.gate.interlock.live:  # from here on guardians need not wait for long
                self._safety.gate.interlock.lease(self._safety.settings.lease_s)
        self._hear_guardian()
        stopped: BaseException | None = None
        for act in self._to_rest():
            for _ in range(2):
                try:
                    act()
                    break
                except Exception as error:
                    failed = f"{type(error).__name__}: {error}"
                except BaseException as error:
                    stopped = error
            else:
                self._ask_guardian(
                    f"a driver failed on the way to 0 V: {failed if stopped is None else stopped}"
                )
        if stopped is not None:
            raise stopped

    def _to_rest(self) -> list[Callable[[], None]]:
        """What has to be done, the output first; the rest is under way by itself."""
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
            self._rig.source.zero,  # again: a camera may have used the board
            *others,
            *confirm,
            *waits,
            self._hear_guardian,
        ]

    def _switch_off(
        self, name: str, guarded: FunctionGenerator | HighVoltageSupply, plain: object, looks: bool
    ) -> None:
        """One instrument by its own line; where it does not confirm, the guardian knows at once."""
        guarded.off()
        if looks:
            self._confirm(name, instrument_state(self._plain, plain, self._limit_v))

    def _confirm_output(self) -> None:
        """By the source's own meter; one that was not found at rest is not asked again."""
        before = self._bench.found.get("output")
        if before is None or before.confirmed:
            self._confirm("output", output_state(self._plain, self._limit_v))

    def _wait_for(self, aside: BackgroundCall, name: str) -> None:
        """The guardians do not wait for an instrument that takes its time, and nobody for ever."""
        if not aside.done(_PATIENCE_S):
            self._ask_guardian(f"no answer within {_PATIENCE_S:g} s on the way to 0 V")
        if aside.done(_LONGEST_S):
            aside.wait()
        else:
            self._confirm(
                name, OutputState(silent=f"{name}: off() has not returned within {_LONGEST_S:g} s")
            )

    def _hear_guardian(self) -> None:
        """Wait until it has acted: two on one serial line would take each other's words."""
        if self._bench.asked_guardian and self._safety.guardians is not None:
            self._safety.guardians.outcome()

    def _confirm(self, name: str, found: OutputState | None) -> None:
        """Keep the first that is wrong, and ask the guardian where rest is not confirmed."""
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
            if self._safety.guardians is None or self._bench.asked_guardian:
                return
            self._bench.asked_guardian = True
            self._safety.guardians.make_safe(reason)

    def read_back(self) -> str:
        """Whether the bench is at 0 V, by its own monitors and words; for the record.

        Returns:
            What was read back; or why nothing could be, and who made the bench safe then.
        Raises:
            SafetyError: an output above `residual_v`, or an instrument that is on; or instruments
                that cannot be asked, and no guardian that made them safe.
        """
        if not self._safety.settings.read_back:
            return "0 V commanded; not read back"
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
            return self._unconfirmed(found)
        if fault := discharged(self._plain, self._limit_v):
            reported = f"{fault} Switch the high voltage off by hand, and short it."
            self._safety.trip(reported)
            raise SafetyError(reported)
        return f"output at 0 V; {found.voltage_v:.2g} V read back"

    def _unconfirmed(self, found: OutputState) -> str:
        """What became of a bench that is not known to be at rest."""
        fault = "this rig has no guardians"
        if self._safety.guardians is not None:
            fault = self._safety.guardians.outcome()
        if not fault and not found.left:
            self._safety.trip(f"Not confirmed at 0 V, made safe by the guardian: {found.silent}")
            return f"0 V by the guardian; not read back ({found.silent})"
        told_by_blocks = not isinstance(self._plain.source, ReportsOutput)
        if self._plain.simulated and told_by_blocks and not found.left:  # no voltage is possible
            return f"0 V commanded; not read back ({found.silent})"
        allowed = f" (limit {self._limit_v:g} V)" if found.left else ""
        by = (
            f"; the guardians could not confirm 0 V either: {fault}"
            if fault
            else "; the guardian has acted"
        )
        reported = (
            f"Output {'not' if found.left else 'not confirmed'} at 0 V: {found.fault}{allowed}"
            f"{by}. Switch the high voltage off by hand."
        )
        self._safety.trip(reported)
        raise SafetyError(reported)

    def _by_blocks(self) -> OutputState:
        """The output by the voltage monitor, where the source cannot be asked."""
        blocks = (
            _READ_BACK_BLOCKS
            + self._rig.description.switch_sample // self._rig.description.block_samples
        )
        left_v = math.inf
        try:
            for _ in range(blocks):
                codes = self._plain.acquisition.read()
                self._bench.watch.check_form(codes, None)
                left_v = self._bench.watch.residual_v(codes)
                if left_v < self._limit_v:
                    return OutputState(voltage_v=left_v)
        except Exception as error:  # whatever the device does now: it is not known to be safe
            return OutputState(silent=f"{type(error).__name__}: {error}")
        return OutputState(left=f"{left_v:.4g} V remain at the output", voltage_v=left_v)
