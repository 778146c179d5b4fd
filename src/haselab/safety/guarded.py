"""A rig behind its safety chain, which no call to a driver can bypass."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from haselab.base import DeviceError, InputError, SafetyError
from haselab.rig import Reopens, Rig
from haselab.safety.arming_text import arming_limits
from haselab.safety.gate import Gate
from haselab.safety.guarded_parts import (
    GuardedAcquisition,
    GuardedBench,
    GuardedController,
    GuardedGenerator,
    GuardedSource,
    GuardedStand,
    GuardedSupply,
)
from haselab.safety.instrument_state import instrument_states, output_state
from haselab.safety.shutdown import ReadBack, Shutdown
from haselab.safety.state_machine import LIVE, Safety, SafetySettings
from haselab.safety.watchdog.deadlines import Deadlines

__all__ = ["GuardedRig", "guard"]


@dataclasses.dataclass
class GuardedRig(Rig):
    """A rig whose instruments are all behind one safety chain.

    Args:
        plain: the rig behind it.
        bench: what its guarded parts share.
    """

    plain: Rig = dataclasses.field(kw_only=True)
    bench: GuardedBench = dataclasses.field(kw_only=True)

    @property
    def safety(self) -> Safety:
        """The safety chain."""
        return self.bench.safety

    @property
    def deadlines(self) -> Deadlines:
        """Deadlines of the current experiment."""
        return self.bench.deadlines

    def begin(self) -> None:
        """Begin an experiment: from here on blocks must follow without a gap.

        Raises:
            DeviceError: The generator or the supply does not respond.
        """
        for found in instrument_states(self.plain, self.safety.settings.residual_v):
            if found.unreachable:
                with self.bench.calling():
                    raise DeviceError(f"A link is lost: {found.unreachable}")
        self.bench.passed()
        self.deadlines.start()

    def limit_drive(self, limit_v: float = math.inf, source: str = "") -> None:
        """Check each drive also against plus and minus a voltage, until this is called again.

        Args:
            limit_v: largest drive in magnitude, in V; infinite: the limits of the rig apply again.
            source: of this limit, for error messages.
        """
        whole = limits = self.bench.whole or self.description.drive_limits
        if limit_v < limits.high:
            limits = dataclasses.replace(limits, high=limit_v, high_source=source)
        if -limit_v > limits.low:
            limits = dataclasses.replace(limits, low=-limit_v, low_source=source)
        self.bench.whole = None if limits == whole else whole
        about = dataclasses.replace(self.description, drive_limits=limits)
        self.description = self.plain.description = about  # both are asked

    def check_drive(self, drive_v: NDArray[np.float64]) -> None:
        """Refuse a whole drive before its first value is put out.

        Args:
            drive_v: one value per block, in V.
        Raises:
            LimitError: A value is outside the limits, or a rise is above the rate limit.
        """
        self.description.drive_limits.check(drive_v)
        before_v = self.bench.present_drive_v
        if np.isfinite(self.safety.settings.rate_limit_v_per_s):
            for value in drive_v:
                self.bench.check(float(value), before_v)
                before_v = float(value)

    def preload(self, drive_v: NDArray[np.float64]) -> None:
        """Queue the coming outputs in a source that can, so that a late computer is no fault.

        Args:
            drive_v: one value per block, in V.
        Raises:
            LimitError: See `check_drive`.
            SafetyError: The bench is not armed, and a value is not 0 V.
        """
        source = self.bench.preloads
        if source is None:
            return
        self.check_drive(drive_v)
        if np.any(drive_v) and not self.safety.live:
            raise self.safety.refusal()
        self.deadlines.start(source.preload(drive_v) * self.description.block_s)

    @property
    def missed_outputs(self) -> int:
        """Number of outputs since opening that were skipped because they came too late."""
        return self.bench.left_out

    @property
    def present_drive_v(self) -> float:
        """Drive during the last block; if the requested one was late, the one still in force."""
        return self.bench.present_drive_v if self.controller is None else self.controller.output_v

    def check_idle(self) -> None:
        """Check before energising that the link works and the monitor shows 0 V.

        Raises:
            DeviceError: No block arrived, or one that does not fit this rig.
            SafetyError: There is an output already.
        """
        if not self.safety.settings.read_back:
            return
        self.bench.passed()  # blocks before this one may have been skipped
        codes = self.acquisition.read()
        monitored = self.controller is None
        left_v = self.bench.watch.residual_v(codes) if monitored else self._metered_v()
        if not left_v < self.safety.settings.residual_v:
            raise self.safety.trip(
                f"Output of {left_v:.4g} V before anything was requested (limit "
                f"{self.safety.settings.residual_v:g} V). Check the amplifier and the monitor "
                "cables."
            )

    def _metered_v(self) -> float:
        """Output by the source's own meter, in V; a microcontroller's monitors show no DC level."""
        found = output_state(self.plain, self.safety.settings.residual_v)
        if found is None or found.unreachable:
            raise DeviceError(
                f"The output cannot be read: {found.unreachable if found else 'no meter'}"
            )
        return abs(found.voltage_v)

    def reopen(self) -> None:
        """Open the board again after another program has reset it; the output stays at 0 V.

        Nothing is energised: the latch and the guardians stay as they are. A board that cannot be
        opened again is left as it is.

        Raises:
            SafetyError: The bench is armed, or another program is making it safe.
            DeviceError: The board does not reply, or another program uses it.
        """
        if self.safety.stage in LIVE:
            raise SafetyError(f"The bench is {self.safety.stage.value}. Disarm it first.")
        board = self.plain.acquisition
        if isinstance(board, Reopens):
            board.reopen()
            self.bench.reopened()

    def safe(self) -> None:
        """Take the output to 0 V, stop sensing signal and camera, and read 0 V back.

        Raises:
            SafetyError: The output is not confirmed at 0 V. The bench is tripped: switch the high
                voltage off by hand.
        """
        try:
            self.command_zero()
        finally:
            self.read_back()

    def command_zero(self) -> None:
        """Take the bench to 0 V without reading it back: the first half of `safe`."""
        Shutdown(self).run()

    def unconfirmed(self) -> str:
        """Why the last shutdown is not known to have reached 0 V; empty if it did, or a guardian.

        Waits until the guardians that were called have answered.
        """
        if not (fault := self.bench.unconfirmed):
            return ""
        guardians = self.safety.guardians
        return fault if guardians is None or guardians.outcome() else ""

    def confirm_zero(self) -> None:
        """Read back, unless this was done since anything was last energised.

        Raises:
            SafetyError: See `read_back`.
        """
        self.bench.outdate()
        if "output" not in self.bench.found:
            self.read_back()

    def read_back(self) -> ReadBack:
        """Check that the bench is at 0 V; see `Shutdown.read_back`.

        Returns:
            What was read back, for the record.
        Raises:
            SafetyError: The output is not confirmed at 0 V.
        """
        return Shutdown(self).read_back()


def guard(
    rig: Rig,
    safety: Safety | None = None,
    *,
    clock: Callable[[], float] = time.monotonic,
) -> GuardedRig:
    """Put a safety chain in front of a rig.

    Args:
        rig: the bench. Its drivers are wrapped by a gate, in `rig` itself, unless they already
            are: from here on nothing energises it without a permission.
        safety: its chain; None makes one with the default limits.
        clock: monotonic, in s.
    Returns:
        The same bench, guarded: nothing is put out until the chain is armed.
    Raises:
        InputError: A driver lacks the methods that take it to 0 V.
    Example:
        >>> from haselab.rig.twin.twin_bench import make_twin
        >>> from haselab.rig.twin.config import twin_of_reading
        >>> rig = guard(make_twin(twin_of_reading("hz"), 1))
        >>> rig.safety.arm(rig.safety.request())
        >>> rig.source.write(0.5)
        >>> rig.safe()
        >>> rig.safety.end_run()
    """
    chain = safety if safety is not None else Safety(SafetySettings())
    gate = _put_gate(rig)
    bench = GuardedBench(rig, chain, clock)
    given = {field.name: getattr(rig, field.name) for field in dataclasses.fields(Rig)}
    acquisition = GuardedAcquisition(bench, rig.acquisition)
    given |= {
        "source": GuardedSource(bench, rig.source),
        "acquisition": acquisition,
        "generator": GuardedGenerator(bench, rig.generator),
        "stand": GuardedStand(bench, rig.stand, acquisition),
        "supply": None if rig.supply is None else GuardedSupply(bench, rig.supply),
        "controller": None if rig.controller is None else GuardedController(bench, rig.controller),
    }
    guarded = GuardedRig(**given, plain=rig, bench=bench)
    s = chain.settings
    own = rig.controller is not None
    limits = arming_limits(
        rig.description, s.current_limit_a, s.rate_limit_v_per_s, own_controller=own
    )
    if s.rating is None and s.real_time and not own:
        limits += " The electric field is not monitored: add [rating] to the rig file."
    chain.attach(gate, guarded.command_zero, limits, guarded.confirm_zero)
    return guarded


def _put_gate(rig: Rig) -> Gate:
    """Wrap all drivers of a rig and return their gate.

    Raises:
        InputError: A driver lacks the methods that take it to 0 V.
    """
    for name, driver, needed in (
        ("source", rig.source, ("write", "zero")),
        ("generator", rig.generator, ("sine", "off")),
        ("supply", rig.supply, ("set_voltage", "read_voltage", "off")),
    ):
        missing = [method for method in needed if not callable(getattr(driver, method, None))]
        if driver is not None and missing:
            raise InputError(
                f"The {name} has no method {missing[0]!r}, so it cannot be taken to 0 V. Give your "
                f"driver every method of its protocol in haselab.rig."
            )
    gate = rig.gate
    opened_behind = Gate.has_wrapped(rig.source)  # then camera and stand hold wrapped drivers
    if not isinstance(gate, Gate):
        gate = rig.gate = Gate.of(rig.source, rig.generator, rig.supply)
    rig.source = gate.instrument(rig.source)
    rig.acquisition = gate.instrument(rig.acquisition)
    rig.generator = gate.instrument(rig.generator)
    if rig.supply is not None:
        rig.supply = gate.instrument(rig.supply)
    if rig.controller is not None:
        rig.controller = gate.instrument(rig.controller)
    if not opened_behind:
        rig.camera = gate.companion(rig.camera)
        rig.stand = gate.companion(rig.stand)
    return gate
